"""What a dynamic model shows at one instant: Gaussians, and how their pixels become colours."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor, nn

from splashbench.render import rasterize
from splashbench.scene import Camera


@dataclass
class Splats:
    """N Gaussians as a camera is to see them: means [N, 3], factors [N, 3, 3] of the covariances B B^T, scene units.

    opacities: [N] in [0, 1]; colors: [N, C], of any meaning (`DynamicModel.image`). penalty: a scalar that a fit adds
    to its loss, or None. rows: int64 [N], which of the model's Gaussians these are; None for all of them in order.
    """

    means: Tensor
    factors: Tensor
    opacities: Tensor
    colors: Tensor
    penalty: Tensor | None = None
    rows: Tensor | None = None


class DynamicModel(nn.Module, ABC):
    """A scene of Gaussians in motion. Times run from 0 to 1 over the recording.

    backdrop: colour [3] in [0, 1] that lies behind everything; None for black.
    """

    backdrop: Tensor | None = None

    @property
    def device(self) -> torch.device:
        """Where the model's tables lie."""
        return next(self.parameters()).device

    def _apply(self, fn: Callable[[Tensor], Tensor], recurse: bool = True) -> DynamicModel:
        # What moves a model to a device moves its parameters and buffers alone; the backdrop is neither.
        super()._apply(fn, recurse)
        if self.backdrop is not None:
            self.backdrop = fn(self.backdrop)
        return self

    def at(self, time: float) -> Any:
        """What all views of one instant share, such as a network's output; it is handed to `splats`."""
        return time

    def means(self, time: float) -> Tensor:
        """Where all Gaussians of the model are at `time`, seen or not: [N, 3], scene units."""
        return torch.as_tensor(self.at(time).means)

    @abstractmethod
    def splats(self, state: Any, camera: Camera) -> Splats:
        """The Gaussians at the instant of `state` (see `at`) as `camera` is to see them; those it leaves out are none
        that could be seen."""

    def image(self, rendered: Tensor, camera: Camera, time: float) -> Tensor:
        """Colours [H, W, 3] of what was rasterized [H, W, C]; as it is, unless a network decodes it."""
        return rendered

    def channels_behind(self, backdrop: Tensor) -> Tensor:
        """What is to be rasterized behind all Gaussians, [C], so that `image` makes the colour `backdrop` [3] of it."""
        return backdrop

    def colors(self, splats: Splats) -> Tensor:
        """sRGB [N, 3] of single Gaussians, for viewers; where pixels are decoded together, nearly theirs."""
        return splats.colors

    def view(self, splats: Splats, camera: Camera, time: float) -> Tensor:
        """The image [H, W, 3] of `splats` over the backdrop; not clipped."""
        behind = None if self.backdrop is None else self.channels_behind(self.backdrop)
        rendered, _ = rasterize(
            splats.means, splats.factors, splats.opacities, splats.colors, camera, background=behind
        )
        return self.image(rendered, camera, time)


def rotation_matrices(quaternions: Tensor) -> Tensor:
    """Rotations [N, 3, 3] of quaternions [N, 4] (w x y z), normalised here."""
    return unit_quaternion_matrices(nn.functional.normalize(quaternions, dim=1))


def unit_quaternion_matrices(quaternions: Tensor) -> Tensor:
    """Matrices [N, 3, 3] of quaternions [N, 4] (w x y z) that are taken to be unit ones; of others, no rotations."""
    w, x, y, z = quaternions.unbind(1)
    rows = (
        1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y),
        2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x),
        2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y),
    )  # fmt: skip
    return torch.stack(rows, dim=1).view(-1, 3, 3)


def ellipsoids(log_scales: Tensor, quaternions: Tensor) -> Tensor:
    """Factors [N, 3, 3] of Gaussians with axes exp(log_scales) [N, 3], turned by `quaternions` [N, 4]."""
    return rotation_matrices(quaternions) * torch.exp(log_scales)[:, None]

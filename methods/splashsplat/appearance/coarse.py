"""Training targets at half their size: what large photographs teach first, at a quarter of the pixels.

Scaffold-GS and its kin begin with small images, too. Not in the paper, whose images are as they are.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import numpy as np
import torch
from torch import Tensor
from torch.nn.functional import pad

from splashbench.scene.camera import Camera

from ..kernel.window_loss import WindowPhotograph
from .photographs import read_now
from .targets import TrainingTarget, windowed


def with_half_size(
    targets: list[TrainingTarget],
    backgrounds: Mapping[str, np.ndarray],
    walls: Mapping[str, np.ndarray | None],
) -> None:
    """Give each target its `coarse` one, in place.

    backgrounds: float32 [H, W, 3] or [3] by view; walls: float32 [H, W] or None by view; of whole images, which the
    targets' windows are parts of and begin at even pixels of. They are halved once each, and shared.
    """
    behind = {name: _halved(torch.from_numpy(image)) for name, image in backgrounds.items()}
    before = {name: None if wall is None else _halved(torch.from_numpy(wall)) for name, wall in walls.items()}
    for target in targets:
        name = target.camera.name
        target.coarse = half_size(target, behind[name], before[name])


def set_half_backgrounds(targets: list[TrainingTarget], backgrounds: Mapping[str, np.ndarray]) -> None:
    """Put others behind the `coarse` ones of `targets` where these have one, in place; see `with_half_size`."""
    behind = {name: _halved(torch.from_numpy(image)) for name, image in backgrounds.items()}
    for target in targets:
        if target.coarse is not None:
            x, y = target.corner
            corner = (x // 2, y // 2)
            target.coarse.background = windowed(behind[target.camera.name], corner, target.coarse.camera)


def half_size(target: TrainingTarget, background: Tensor, wall: Tensor | None) -> TrainingTarget:
    """`target` with pixels twice as wide and high; a coarse pixel is liquid where half of it or more is.

    background, wall: of the whole image at that size, or [3] and None.
    """
    photograph, camera = read_now(target.photograph), _half(target.camera)
    rows, columns = photograph.mask.shape
    top, left = photograph.top % 2, photograph.left % 2
    # Coarse pixels begin at even ones of the window; what is added at the edges repeats them, and is no liquid.
    edges = (left, (left + columns) % 2, top, (top + rows) % 2)
    image = _mean(_padded(photograph.image.to(torch.float32), edges))
    covered = _mean(pad(photograph.mask.to(torch.float32), edges)[..., None])[..., 0]
    x, y = (at // 2 for at in target.corner)
    window = slice(y, y + camera.height), slice(x, x + camera.width)
    return replace(
        target,
        camera=camera,
        photograph=WindowPhotograph(
            image.round().to(torch.uint8).contiguous(),
            (covered >= 0.5).contiguous(),
            top=photograph.top // 2,
            left=photograph.left // 2,
        ),
        background=background if background.ndim == 1 else background[window],
        area=target.area / 4,
        wall=None if wall is None else wall[window],
    )


def _half(camera: Camera) -> Camera:
    """`camera` with pixels twice as large; an odd last row or column becomes a whole one."""
    K = np.diag([0.5, 0.5, 1.0]) @ camera.K
    return replace(camera, width=(camera.width + 1) // 2, height=(camera.height + 1) // 2, K=K)


def _halved(image: Tensor) -> Tensor:
    """`image` [h, w] or [h, w, c] at half its size; a colour [c] as it is."""
    if image.ndim == 1:
        return image
    channels = image if image.ndim == 3 else image[..., None]
    halved = _mean(_padded(channels, (0, image.shape[1] % 2, 0, image.shape[0] % 2)))
    return halved if image.ndim == 3 else halved[..., 0]


def _padded(image: Tensor, edges: tuple[int, int, int, int]) -> Tensor:
    """`image` [h, w, c] with its edges repeated: left, right, top, bottom."""
    return pad(image.permute(2, 0, 1)[None], edges, mode="replicate")[0].permute(1, 2, 0)


def _mean(image: Tensor) -> Tensor:
    """Means [h / 2, w / 2, c] of the blocks of 2x2 pixels of `image` [h, w, c], both even."""
    height, width, channels = image.shape
    return image.reshape(height // 2, 2, width // 2, 2, channels).mean(dim=(1, 3)).contiguous()

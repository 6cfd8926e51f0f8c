"""Scaffold-GS anchors: a feature per anchor, decoded into K Gaussians for the view at hand.

With anchor position a, log-scales l [6], offsets o [K, 3], feature f [32], view direction d (Lu et al. 2024, Sec. 3.2):

    opacity  = tanh(MLP([f, d])), drawn where positive
    scale    = exp(l[3:6]) * sigmoid(MLP([f, d])),  rotation = quaternion of the same MLP
    colour   = sigmoid(MLP([f, d]))
    mean     = a + o * exp(l[0:3])

Two departures on request. With `base_color` the first three feature channels are added to the colour's logits and start
at the point's own colour, so that hundreds of iterations suffice instead of tens of thousands. Without
`view_dependent_shape` opacity and shape see no view direction.

On the CPU a compiled kernel computes this (kernel/decode.py), on other devices torch.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import nn

from splashbench.gaussians.anchor_seeds import AnchorSeed
from splashbench.gaussians.dynamic_model import rotation_matrices
from splashbench.scene import Camera

from .kernel.decode import Heads, Tables, decode

FEATURES = 32
HIDDEN = 32
# A Gaussian is drawn up to so many standard deviations from its mean, and linearised: seen from the side it may reach
# further. Pixels beside the image that count as within.
_REACH, _MARGIN = 5.0, 4.0
# Parameters with a row per anchor; the heads are shared.
PER_ANCHOR = ("features", "offsets", "log_scales")


@dataclass(frozen=True)
class StaticAnchorSpec:
    """What kind of model: children per anchor K, and the two departures that the module names."""

    children: int
    view_dependent_shape: bool = False
    base_color: bool = True


class DecodedGaussians(NamedTuple):
    """All children of N anchors, M = N K, as seen from one point; child c of anchor i is row i K + c.

    means [M, 3], factors [M, 3, 3] (covariances B B^T), opacities [M] (0 or less: not drawn), colors [M, 3], scales
    [M, 3]; scene units.
    """

    means: torch.Tensor
    factors: torch.Tensor
    opacities: torch.Tensor
    colors: torch.Tensor
    scales: torch.Tensor


def head(inputs: int, outputs: int) -> nn.Sequential:
    """A network with one hidden layer, shared by all anchors."""
    return nn.Sequential(nn.Linear(inputs, HIDDEN), nn.ReLU(), nn.Linear(HIDDEN, outputs))


class Anchors(nn.Module):
    """The tables of N anchors with K children each, in space or in space-time (D dimensions)."""

    positions: torch.Tensor

    def __init__(self, n: int, children: int, dimensions: int) -> None:
        super().__init__()
        self.register_buffer("positions", torch.zeros(n, dimensions))
        self.features = nn.Parameter(torch.zeros(n, FEATURES))
        self.offsets = nn.Parameter(torch.zeros(n, children, dimensions))
        self.log_scales = nn.Parameter(torch.zeros(n, 2 * dimensions))

    def __len__(self) -> int:
        return len(self.positions)


class AnchorModel(Anchors):
    """N static anchors with K children each; parameters in scene units."""

    def __init__(self, n: int, variant: StaticAnchorSpec) -> None:
        super().__init__(n, variant.children, 3)
        self.variant = variant
        self.opacity_head = head(FEATURES + 3, variant.children)
        self.shape_head = head(FEATURES + 3, 7 * variant.children)
        self.color_head = head(FEATURES + 3, 3 * variant.children)

    @classmethod
    def from_seed(cls, seed: AnchorSeed, variant: StaticAnchorSpec, spread: bool = True) -> AnchorModel:
        """A model about to be fitted; random numbers come from torch's generator.

        With `spread` features start at random and children apart, else both at zero as published.
        """
        model = cls(len(seed.positions), variant)
        spacing = torch.as_tensor(seed.spacing)
        with torch.no_grad():
            model.positions.copy_(torch.as_tensor(seed.positions))
            if spread:
                model.features.normal_(std=0.1)
            if variant.base_color:
                model.features[:, :3] = torch.logit(torch.as_tensor(seed.colors).clamp(0.02, 0.98))
            model.offsets.copy_(first_offsets(len(model), variant.children, 3, spread))
            model.log_scales.copy_(spacing.log()[:, None].expand(-1, 6))
            last = {name: getattr(model, name)[-1] for name in ("opacity_head", "shape_head", "color_head")}
            for layer in last.values():
                layer.weight.mul_(0.3)
                layer.bias.zero_()
            last["opacity_head"].bias.fill_(math.atanh(0.6))
            # Children that tile the anchor's cell: full spacing divided among them; quaternion near the identity.
            shape = last["shape_head"].bias.view(variant.children, 7)
            shape[:, :3] = 0.5
            shape[:, 3] = 1.0
        return model

    def decode(self, eye: NDArray, rows: torch.Tensor | None = None) -> DecodedGaussians:
        """The Gaussians as seen from `eye` [3]. rows: int64 [n], ascending, the anchors that are decoded; all by
        default."""
        if self.positions.device.type != "cpu":
            return self.decode_by_torch(eye, rows)
        heads = (self.opacity_head, self.shape_head, self.color_head)
        found = decode(
            Tables(self.features, self.offsets, self.log_scales, self.positions),
            Heads(
                tuple(parameter for part in heads for parameter in part.parameters()),
                self.variant.view_dependent_shape,
                self.variant.base_color,
            ),
            torch.tensor(eye, dtype=torch.float32),
            rows,
        )
        return DecodedGaussians(*[children.flatten(0, 1) for children in found])

    def decode_by_torch(self, eye: NDArray, rows: torch.Tensor | None = None) -> DecodedGaussians:
        """The same on any device: the definition."""
        tables = (self.positions, self.features, self.offsets, self.log_scales)
        positions, features, offsets, log_scales = (t if rows is None else t.index_select(0, rows) for t in tables)
        n, k = offsets.shape[:2]
        eye_at = torch.tensor(eye, dtype=positions.dtype, device=positions.device)
        direction = nn.functional.normalize(positions - eye_at, dim=1)
        seen = torch.cat([features, direction], dim=1)
        blind = seen if self.variant.view_dependent_shape else torch.cat([features, 0 * direction], dim=1)
        opacity = torch.tanh(self.opacity_head(blind)).view(n * k)
        shape = self.shape_head(blind).view(n, k, 7)
        scales = (torch.exp(log_scales[:, None, 3:]) * torch.sigmoid(shape[..., :3])).view(n * k, 3)
        factors = rotation_matrices(shape[..., 3:].reshape(n * k, 4)) * scales[:, None]
        logits = self.color_head(seen).view(n, k, 3)
        if self.variant.base_color:
            logits = logits + features[:, None, :3]
        means = positions[:, None] + offsets * torch.exp(log_scales[:, None, :3])
        return DecodedGaussians(means.view(n * k, 3), factors, opacity, torch.sigmoid(logits).view(n * k, 3), scales)

    @torch.no_grad()
    def in_view(self, camera: Camera) -> torch.Tensor:
        """Which anchors may show in `camera`, int64 [n], ascending: the prefilter of Scaffold-GS.

        It keeps whatever reaches within the pyramid of view, and some that does not; and what is no number, which the
        loss shows then.
        """
        place = self.positions @ _to(camera.w2c[:3, :3].T, self.positions) + _to(camera.w2c[:3, 3], self.positions)
        extents = self.log_scales.exp()
        reach = (self.offsets.abs().amax(dim=1) * extents[:, :3]).norm(dim=1) + _REACH * extents[:, 3:].amax(dim=1)
        beside = place[:, 2] < -reach
        for plane in _sides(camera):
            beside |= place @ _to(plane, self.positions) < -reach
        return (~beside).nonzero()[:, 0]


def _to(values: NDArray, like: torch.Tensor) -> torch.Tensor:
    return torch.as_tensor(np.ascontiguousarray(values), dtype=like.dtype, device=like.device)


def _sides(camera: Camera) -> NDArray[np.float64]:
    """Normals [4, 3] of the sides of the pyramid of view, which point inwards, in the camera's frame; a few pixels are
    added on each side, as Gaussians are drawn a little larger than they are."""
    left, top, right, bottom = -_MARGIN, -_MARGIN, camera.width + _MARGIN, camera.height + _MARGIN
    edges = np.array([[1, 0, -left], [-1, 0, right], [0, 1, -top], [0, -1, bottom]], dtype=np.float64) @ camera.K
    return edges / np.linalg.norm(edges, axis=1, keepdims=True)


def first_offsets(n: int, children: int, dimensions: int, spread: bool) -> torch.Tensor:
    """Offsets [n, children, dimensions] of new anchors: random within the anchor's cell where `spread`, else zero."""
    if not spread:
        return torch.zeros(n, children, dimensions)
    return torch.rand(n, children, dimensions) * 1.4 - 0.7


#: Steps in which these tables are stored, in the units of their exponent or sigmoid. Steps are powers of two, so that
#: rounding once more changes nothing.
STORED_STEPS = {"features": 2.0**-6, "offsets": 2.0**-7, "log_scales": 2.0**-6}


@torch.no_grad()
def round_to_stored(model: AnchorModel) -> AnchorModel:
    """`model` with its tables rounded, in place, to the steps in which they are stored."""
    for name, step in STORED_STEPS.items():
        table = getattr(model, name)
        table.copy_(torch.round(table / step).clamp(-32767, 32767) * step)
    return model


def to_arrays(model: AnchorModel) -> dict[str, np.ndarray]:
    """Every parameter and buffer by name; the tables of `STORED_STEPS` as whole numbers of steps, int16."""
    arrays = {name: tensor.detach().numpy() for name, tensor in model.state_dict().items()}
    whole = {name: np.rint(arrays[name] / step).astype(np.int16) for name, step in STORED_STEPS.items()}
    return arrays | {
        name: steps.astype(np.int8) if np.abs(steps).max(initial=0) < 128 else steps for name, steps in whole.items()
    }


def from_arrays(model: AnchorModel, arrays: Mapping[str, np.ndarray]) -> AnchorModel:
    """`model` with what `to_arrays` gave, or with tables as floats. Raises RuntimeError where they do not fit it."""
    floats = {
        name: array.astype(np.float32) * np.float32(STORED_STEPS[name] if array.dtype.kind == "i" else 1)
        if name in STORED_STEPS
        else array
        for name, array in arrays.items()
    }
    model.load_state_dict({name: torch.as_tensor(array) for name, array in floats.items()})
    return model

"""What of a transparent container lies before the liquid: its edges and highlights, as Gaussians that stand still.

The background is an image behind the liquid. An edge of the glass between camera and liquid is not in it, and carriers
cannot draw it: they are in the liquid, a wall's thickness behind, and move. These Gaussians are where photographs say,
drawn together with the carriers' by depth, and no liquid: they have no part in its opacity. Not in the paper.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, fields

import numpy as np
import torch
from torch import Tensor
from torch.nn.functional import normalize

from splashbench.gaussians.adam import Adam
from splashbench.gaussians.dynamic_model import ellipsoids

from ..carriers.subframe import Track

# Where they begin: about carriers this near to the surface, this far from them; and how large; transport voxels.
_NEAR, _SPREAD, _EXTENT = 1.5, 2.0, 0.7
# Logit of their opacity at the start.
_OPACITY = -2.5
# Learning rates: of positions in transport voxels, and of the other tables.
_POSITION_RATE = 0.06
_RATES = {"log_scales": 0.03, "quaternions": 0.03, "opacities": 0.06, "colors": 0.06, "slopes": 0.03}


@dataclass(frozen=True)
class Splats:
    """n Gaussians as one camera sees them: means [n, 3], factors [n, 3, 3] of their covariances (scene units),
    opacities [n], colors [n, 3] in [0, 1]."""

    means: Tensor
    factors: Tensor
    opacities: Tensor
    colors: Tensor


@dataclass
class Glass:
    """n Gaussians that stand still.

    positions: [n, 3] scene units. log_scales: [n, 3], of their axes in scene units. quaternions: [n, 4] (w x y z).
    opacities: [n] logits. colors: [n, 3] logits; slopes: [n, 3, 3], by how much these rise along the viewing direction
    (x, y, z by channel).
    """

    positions: Tensor
    log_scales: Tensor
    quaternions: Tensor
    opacities: Tensor
    colors: Tensor
    slopes: Tensor

    def __len__(self) -> int:
        return len(self.positions)

    @property
    def tables(self) -> dict[str, Tensor]:
        """All of the above by name."""
        return {field.name: getattr(self, field.name) for field in fields(self)}

    def seen(self, eye: Tensor) -> Splats:
        """As a camera at `eye` [3] sees them; differentiable."""
        directions = normalize(self.positions.detach() - eye, dim=1)
        colors = torch.sigmoid(self.colors + (self.slopes * directions[:, :, None]).sum(dim=1))
        factors = ellipsoids(self.log_scales, self.quaternions)
        return Splats(self.positions, factors, torch.sigmoid(self.opacities), colors)

    def to(self, device: str) -> Glass:
        """A copy on `device`."""
        return Glass(**{name: table.detach().to(device, copy=True) for name, table in self.tables.items()})

    @torch.no_grad()
    def kept(self, least_opacity: float) -> Glass:
        """A copy, without those that are more transparent than `least_opacity`."""
        rows = (torch.sigmoid(self.opacities) >= least_opacity).nonzero()[:, 0]
        return Glass(**{name: table.detach().index_select(0, rows) for name, table in self.tables.items()})

    @classmethod
    def of_tables(cls, tables: Mapping[str, np.ndarray]) -> Glass:
        """The Gaussians of arrays by name. Raises ValueError where they do not fit together."""
        found = {field.name: torch.from_numpy(tables[field.name].astype(np.float32)) for field in fields(cls)}
        n = len(found["positions"])
        shapes = {"positions": (n, 3), "log_scales": (n, 3), "quaternions": (n, 4), "opacities": (n,)}
        for name, shape in (shapes | {"colors": (n, 3), "slopes": (n, 3, 3)}).items():
            if tuple(found[name].shape) != shape:
                raise ValueError(f"{name} is {list(found[name].shape)}, not {list(shape)}")
        return cls(**found)


def glass_before(track: Track, count: int, seed: int) -> Glass | None:
    """`count` faint grey Gaussians about the surface of the liquid of all frames; None where there is none.

    The same for the same seed.
    """
    surface = np.flatnonzero(np.abs(track.carriers.phi) < _NEAR)
    if count == 0 or len(surface) == 0:
        return None
    rng = np.random.default_rng([seed, 5])
    rows = rng.choice(surface, count, replace=len(surface) < count)
    places = track.carriers.positions[rows] + _SPREAD * rng.normal(size=(count, 3))
    turns = torch.zeros(count, 4)
    turns[:, 0] = 1
    return Glass(
        positions=torch.from_numpy(track.grid.to_scene(places).astype(np.float32)),
        log_scales=torch.full((count, 3), math.log(_EXTENT * track.grid.voxel)),
        quaternions=turns,
        opacities=torch.full((count,), _OPACITY),
        colors=torch.zeros(count, 3),
        slopes=torch.zeros(count, 3, 3),
    )


class GlassFit:
    """`glass` while it is fitted, in place. voxel: of transport, scene units."""

    def __init__(self, glass: Glass, voxel: float) -> None:
        self.glass = glass
        self.parameters = [table.requires_grad_() for table in glass.tables.values()]
        rates = {"positions": _POSITION_RATE * voxel, **_RATES}
        groups = [{"params": [table], "lr": rates[name], "rate": rates[name]} for name, table in glass.tables.items()]
        self._adam = Adam(groups)

    def step(self, gradients: list[Tensor], factor: float) -> None:
        """Descend along the `gradients` of the parameters; `factor` scales the rates."""
        for parameter, gradient in zip(self.parameters, gradients):
            parameter.grad = gradient
        for group in self._adam.param_groups:
            group["lr"] = group["rate"] * factor
        self._adam.step()

    def done(self) -> None:
        """End the fit."""
        for parameter in self.parameters:
            parameter.requires_grad_(False)
            parameter.grad = None

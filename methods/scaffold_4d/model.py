"""4D-Scaffold-GS: anchors in space-time, a feature each, decoded into K Gaussians that move and fade (Cho et al. 2024).

With anchor (a, t), scales s = exp(log-scales) [8], offsets o [K, 4], feature f [32] and view direction d, at time tau:

    t_k   = t + o_t s[3]                                 when child k shows
    mean  = a + o_xyz s[0:3] + v (t_k - tau)             v = v_max tanh(MLP(f)): the velocity is -v
    scale = s[4:7] sigmoid(MLP(f)),  rotation = quaternion of the same MLP
    sigma = (ELU(MLP(f)) + 1) / s[7]                     the inverse of how long it shows, same MLP
    alpha = rho exp(-|(t_k - tau) sigma|^beta)           rho = tanh(MLP(f)), drawn where positive
    color = sigmoid(MLP([f, d]))

Published is s[7] = 1 and v_max = 1 in the scene's units per second; here the eighth scale, which the published code
leaves unused, is how long an anchor's Gaussians show. With `base_color` the first three feature channels are added to
the colour's logits, as in static anchors.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from torch import Tensor, nn

from splashbench.errors import SplashbenchError
from splashbench.files import read_npz
from splashbench.gaussians.dynamic_model import DynamicModel, Splats, rotation_matrices
from splashbench.gaussians.initialization import StartingPoints
from splashbench.render.constants import MIN_ALPHA
from splashbench.scene import Camera

from ..scaffold_gs.model import FEATURES, PER_ANCHOR, Anchors, first_offsets, head

#: Tables with a row per anchor.
ROWS = ("positions", *PER_ANCHOR)
# Channels of the shape head, per child: scales, inverse duration, quaternion.
_SHAPE = 8
_VOLUME_WEIGHT = 0.01
#: Children that an anchor of a file may have.
MAX_CHILDREN = 1024


@dataclass(frozen=True)
class SpacetimeAnchorSpec:
    """What kind of model. children: K. beta: of the fading in time. fastest: v_max, scene units per recording."""

    children: int = 10
    beta: float = 4.0
    fastest: float = 1.0
    base_color: bool = False


def stored_children(path: Path) -> int:
    """Children per anchor of the tables in `path`. Raises SplashbenchError naming it where they make no sense."""
    children = read_npz(path, {"offsets": 3})["offsets"].shape[1]
    if not 1 <= children <= MAX_CHILDREN:
        raise SplashbenchError(f"{path}: {children} Gaussians per anchor make no sense; make the model again")
    return int(children)


@dataclass
class AnchorInstant:
    """The n anchors that show at an instant, by number, and their children, M = n K.

    anchors: [n]; features: [n, F], theirs. means [M, 3], factors [M, 3, 3], opacities [M]; fading [M] is alpha / rho,
    sigma [M] per recording. peaks: [N, K], rho of all anchors without gradient. penalty: for the fit.
    """

    anchors: Tensor
    features: Tensor
    means: Tensor
    factors: Tensor
    opacities: Tensor
    fading: Tensor
    sigma: Tensor
    peaks: Tensor
    penalty: Tensor


@dataclass
class AnchorSplats(Splats):
    """Splats with the state that they come from."""

    state: AnchorInstant | None = None


class SpacetimeAnchors(Anchors, DynamicModel):
    """N anchors (x y z t) with K children each; lengths in scene units, times in recordings."""

    beta: Tensor
    fastest: Tensor
    base_color: Tensor
    unit: Tensor

    def __init__(self, n: int, variant: SpacetimeAnchorSpec) -> None:
        super().__init__(n, variant.children, 4)
        k = variant.children
        self.register_buffer("beta", torch.tensor(variant.beta))
        self.register_buffer("fastest", torch.tensor(variant.fastest))
        self.register_buffer("base_color", torch.tensor(variant.base_color))
        # Scene units in which volumes are penalised.
        self.register_buffer("unit", torch.ones(()))
        self.opacity_head = head(FEATURES, k)
        self.shape_head = head(FEATURES, _SHAPE * k)
        self.flow_head = head(FEATURES, 3 * k)
        self.color_head = head(FEATURES + 3, 3 * k)

    @classmethod
    def from_start(
        cls,
        start: StartingPoints,
        variant: SpacetimeAnchorSpec,
        opacity: float,
        duration: float,
        times: np.ndarray,
        spread: bool = True,
        unit: float | None = None,
    ) -> SpacetimeAnchors:
        """A model about to be fitted; random numbers come from torch's generator.

        duration: how long what comes from the hull shows, recordings. times: [frames] in [0, 1]. Static points last
        all the recording long. spread: features start at random and children apart, else both at zero as published.
        unit: of length, scene units, in which volumes are penalised; None for the points' median spacing.
        """
        model = cls(len(start), variant)
        k, static = variant.children, torch.from_numpy(start.frame < 0)
        point_times = torch.from_numpy(np.asarray(times, np.float32))[torch.from_numpy(start.frame.clip(min=0))]
        model.backdrop = start.backdrop_tensor()
        with torch.no_grad():
            model.positions[:, :3] = torch.from_numpy(start.positions)
            model.positions[:, 3] = torch.where(static, 0.5, point_times)
            model.unit.fill_(float(np.median(start.spacing)) if unit is None else unit)
            if spread:
                model.features.normal_(std=0.1)
            if variant.base_color:
                model.features[:, :3] = torch.logit(torch.from_numpy(start.colors).clamp(0.02, 0.98))
            model.offsets.copy_(first_offsets(len(start), k, 4, spread))
            model.log_scales.copy_(torch.from_numpy(start.spacing).log()[:, None].expand(-1, 8))
            step = 1 / max(1, len(times) - 1)
            model.log_scales[:, 3] = torch.where(static, math.log(0.5), math.log(step / 2))
            model.log_scales[:, 7] = torch.where(static, math.log(2.0), math.log(duration))
            for part in (model.opacity_head, model.shape_head, model.flow_head, model.color_head):
                part[2].weight.mul_(0.3)
                part[2].bias.zero_()
            model.flow_head[2].weight.zero_()
            model.opacity_head[2].bias.fill_(math.atanh(opacity))
            # Children that tile the anchor's cell; quaternions near the identity.
            shape = model.shape_head[2].bias.view(k, _SHAPE)
            shape[:, :3] = 0.5
            shape[:, 4] = 1.0
        return model

    def _fading(self, raw: Tensor, scales: Tensor, since: Tensor) -> tuple[Tensor, Tensor]:
        """Fading and sigma [n, K] of the shape head's raw values [n, K]."""
        sigma = (nn.functional.elu(raw) + 1) / scales[:, 7:8]
        return torch.exp(-((since * sigma).abs() ** float(self.beta))), sigma

    @torch.no_grad()
    def _shown(self, time: float) -> tuple[Tensor, Tensor]:
        """Anchors [n] with a child that is drawn at `time`, and rho [N, K] of all."""
        peaks = torch.tanh(self.opacity_head(self.features))
        hidden, last = self.shape_head[:2](self.features), self.shape_head[2]
        raw = nn.functional.linear(hidden, last.weight[3::_SHAPE], last.bias[3::_SHAPE])
        scales = torch.exp(self.log_scales)
        fading, _ = self._fading(raw, scales, _since(self.positions, self.offsets, scales, time))
        # With a margin: what is left out here is fainter than what the renderer leaves out.
        return torch.nonzero((peaks * fading >= 0.9 * MIN_ALPHA).any(dim=1))[:, 0], peaks

    def at(self, time: float) -> AnchorInstant:
        anchors, peaks = self._shown(time)
        n, k = len(anchors), self.offsets.shape[1]
        # Picked once for all views: the gradient of a pick is a table of all anchors.
        positions, features, offsets, log_scales = (
            table.index_select(0, anchors) for table in (self.positions, self.features, self.offsets, self.log_scales)
        )
        scales = torch.exp(log_scales)
        since = _since(positions, offsets, scales, time)
        shape = self.shape_head(features).view(n, k, _SHAPE)
        fading, sigma = self._fading(shape[..., 3], scales, since)
        opacities = (torch.tanh(self.opacity_head(features)) * fading).view(-1)
        axes = (scales[:, None, 4:7] * torch.sigmoid(shape[..., :3])).view(-1, 3)
        drawn = opacities.detach() >= MIN_ALPHA
        volumes = (axes / self.unit).prod(dim=1) * drawn
        return AnchorInstant(
            anchors=anchors,
            features=features,
            means=self._moved(positions, features, offsets, scales, since),
            factors=rotation_matrices(shape[..., 4:].reshape(-1, 4)) * axes[:, None],
            opacities=opacities,
            fading=fading.view(-1),
            sigma=sigma.view(-1),
            peaks=peaks,
            penalty=_VOLUME_WEIGHT * volumes.sum() / drawn.sum().clamp(min=1),
        )

    def _moved(self, positions: Tensor, features: Tensor, offsets: Tensor, scales: Tensor, since: Tensor) -> Tensor:
        """Means [n K, 3] of the children of anchors, given rows of the tables and `_since` of them."""
        flow = self.fastest * torch.tanh(self.flow_head(features)).view(*since.shape, 3)
        still = positions[:, None, :3] + offsets[..., :3] * scales[:, None, :3]
        return (still + flow * since[..., None]).view(-1, 3)

    def means(self, time: float) -> Tensor:
        scales = torch.exp(self.log_scales)
        since = _since(self.positions, self.offsets, scales, time)
        return self._moved(self.positions, self.features, self.offsets, scales, since)

    def splats(self, state: AnchorInstant, camera: Camera) -> AnchorSplats:
        n, k = len(state.anchors), self.offsets.shape[1]
        eye = torch.tensor(camera.center, dtype=torch.float32, device=self.device)
        directions = nn.functional.normalize(self.positions[state.anchors, :3] - eye, dim=1)
        logits = self.color_head(torch.cat([state.features, directions], dim=1)).view(n, k, 3)
        if self.base_color:
            logits = logits + state.features[:, None, :3]
        colors = torch.sigmoid(logits).view(-1, 3)
        rows = (state.anchors[:, None] * k + torch.arange(k, device=self.device)).view(-1)
        return AnchorSplats(state.means, state.factors, state.opacities, colors, state.penalty, rows, state)


def _since(positions: Tensor, offsets: Tensor, scales: Tensor, time: float) -> Tensor:
    """t_k - tau [n, K]: how long after `time` a child shows most; rows of the tables, scales [n, 8]."""
    return positions[:, 3:] + offsets[..., 3] * scales[:, 3:4] - time

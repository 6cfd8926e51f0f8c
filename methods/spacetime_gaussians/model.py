"""Gaussians with a time of their own (Li et al. 2024, Eq. 6-10).

With d = t - tau, cut off from the gradient in motion, rotation and features:

    mean = x + b1 d + b2 d^2 + b3 d^3,  rotation = normalise(q + w d),  opacity = sigmoid(o) exp(-(d / e^s)^2)

Lite has a colour per Gaussian. Full splats nine channels, a base colour, a feature seen from everywhere and d times a
feature of the time, and decodes them with the pixel's ray: sigmoid(base + W2 relu(W1 [f, f_t d, ray])).
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor, nn

from splashbench.gaussians.dynamic_model import DynamicModel, Splats, rotation_matrices
from splashbench.gaussians.initialization import StartingPoints
from splashbench.render.constants import MIN_ALPHA
from splashbench.scene import Camera

#: Tables with a row per Gaussian; "features" and "time_features" are of the full model alone.
LITE_ROWS = (
    "positions", "motions", "log_scales", "quaternions", "spins", "opacity_logits", "times", "log_widths", "base",
)  # fmt: skip
FULL_ROWS = (*LITE_ROWS, "features", "time_features")


class VisibleGaussians(NamedTuple):
    """The n Gaussians that show at an instant: rows [n], which; means [n, 3], factors [n, 3, 3], opacities [n],
    channels [n, C]."""

    rows: Tensor
    means: Tensor
    factors: Tensor
    opacities: Tensor
    channels: Tensor


class SpacetimeModel(DynamicModel):
    """N Gaussians; times and widths in recordings, positions in scene units."""

    def __init__(self, n: int, full: bool) -> None:
        super().__init__()
        self.full = full
        self.positions = nn.Parameter(torch.zeros(n, 3))
        self.motions = nn.Parameter(torch.zeros(n, 3, 3))  # by power of d, then axis
        self.log_scales = nn.Parameter(torch.zeros(n, 3))
        self.quaternions = nn.Parameter(torch.tensor([1.0, 0, 0, 0]).repeat(n, 1))
        self.spins = nn.Parameter(torch.zeros(n, 4))
        self.opacity_logits = nn.Parameter(torch.zeros(n))
        self.times = nn.Parameter(torch.zeros(n))
        self.log_widths = nn.Parameter(torch.zeros(n))
        self.base = nn.Parameter(torch.zeros(n, 3))
        if full:
            self.features = nn.Parameter(torch.zeros(n, 3))
            self.time_features = nn.Parameter(torch.zeros(n, 3))
            self.decoder = nn.Sequential(nn.Linear(12, 6, bias=False), nn.ReLU(), nn.Linear(6, 3, bias=False))

    @property
    def rows(self) -> tuple[str, ...]:
        """The tables with a row per Gaussian."""
        return FULL_ROWS if self.full else LITE_ROWS

    @classmethod
    def from_start(
        cls, start: StartingPoints, full: bool, opacity: float, log_width: float, times: np.ndarray
    ) -> SpacetimeModel:
        """A model about to be fitted; times: [frames] in [0, 1]. Static points last all the recording long."""
        model = cls(len(start), full)
        colors, static = torch.from_numpy(start.colors), torch.from_numpy(start.frame < 0)
        point_times = torch.from_numpy(np.asarray(times, np.float32))[torch.from_numpy(start.frame.clip(min=0))]
        model.backdrop = start.backdrop_tensor()
        with torch.no_grad():
            model.positions.copy_(torch.from_numpy(start.positions))
            model.log_scales.copy_(torch.from_numpy(start.spacing).log()[:, None].expand(-1, 3))
            model.opacity_logits.fill_(float(torch.logit(torch.tensor(opacity))))
            model.times.copy_(torch.where(static, 0.5, point_times))
            model.log_widths.copy_(torch.where(static, 0.0, log_width))
            model.base.copy_(torch.logit(colors.clamp(0.01, 0.99)) if full else colors)
            if full:
                model.features.copy_(colors)
                model.decoder[2].weight.zero_()  # the fit begins with the points' own colours
        return model

    def _shown(self, time: float) -> Tensor:
        """Which Gaussians [n] are drawn at `time`."""
        with torch.no_grad():
            opacities = _opacities(self.opacity_logits, time - self.times, self.log_widths)
            # With a margin: what is left out is fainter than what the renderer leaves out. What is no number stays.
            return torch.nonzero(~(opacities < 0.9 * MIN_ALPHA))[:, 0]

    def at(self, time: float) -> VisibleGaussians:
        shown = self._shown(time)
        table = {name: self.get_parameter(name).index_select(0, shown) for name in self.rows}
        since = time - table["times"]
        cut = since.detach()[:, None]
        factors = rotation_matrices(table["quaternions"] + table["spins"] * cut)
        channels = [table["base"]]
        if self.full:
            channels += [table["features"], table["time_features"] * cut]
        return VisibleGaussians(
            rows=shown,
            means=_moved(table["positions"], table["motions"], cut),
            factors=factors * torch.exp(table["log_scales"])[:, None],
            opacities=_opacities(table["opacity_logits"], since, table["log_widths"]),
            channels=torch.cat(channels, dim=1),
        )

    def means(self, time: float) -> Tensor:
        return _moved(self.positions, self.motions, (time - self.times.detach())[:, None])

    def splats(self, state: VisibleGaussians, camera: Camera) -> Splats:
        return Splats(state.means, state.factors, state.opacities, state.channels, rows=state.rows)

    def colors(self, splats: Splats) -> Tensor:
        # Of the full model's channels the features are left out, which only the pixel's ray decodes.
        return torch.sigmoid(splats.colors[:, :3]) if self.full else splats.colors

    def image(self, rendered: Tensor, camera: Camera, time: float) -> Tensor:
        return torch.sigmoid(self.decoded(rendered, camera)) if self.full else rendered

    def channels_behind(self, backdrop: Tensor) -> Tensor:
        if not self.full:
            return backdrop
        # With the features at nought the decoder leaves the logits as they are. .001 is a quarter of a grey level.
        return torch.cat([torch.logit(backdrop.clamp(0.001, 0.999)), backdrop.new_zeros(6)])

    def decoded(self, rendered: Tensor, camera: Camera) -> Tensor:
        """Logits [H, W, 3] of the full model's channels [H, W, 9]."""
        base, features, timed = rendered.split(3, dim=2)
        return base + self.decoder(torch.cat([features, timed, rays_on(camera, rendered.device)], dim=2))


def _opacities(logits: Tensor, since: Tensor, log_widths: Tensor) -> Tensor:
    """Opacities [n], `since` [n] recordings after Gaussians show most."""
    return torch.sigmoid(logits) * torch.exp(-((since / torch.exp(log_widths)) ** 2))


def _moved(positions: Tensor, motions: Tensor, since: Tensor) -> Tensor:
    """Positions [n, 3] after `since` [n, 1] along the cubics of `motions` [n, 3, 3]."""
    first, second, third = motions.unbind(1)
    return positions + since * (first + since * (second + since * third))


def rays(camera: Camera) -> np.ndarray:
    """Origin and unit direction of every pixel's ray, scene units: float32 [H, W, 6]."""
    right, down, forward = camera.w2c[:3, :3]
    u = (np.arange(camera.width) + 0.5 - camera.K[0, 2]) / camera.K[0, 0]
    v = (np.arange(camera.height) + 0.5 - camera.K[1, 2]) / camera.K[1, 1]
    directions = (v[:, None] * down + forward)[:, None] + u[None, :, None] * right
    lengths = np.sqrt(np.square(v)[:, None] + np.square(u) + 1)[..., None]
    table = np.empty((camera.height, camera.width, 6), np.float32)
    table[..., :3] = camera.center
    np.divide(directions, lengths, out=table[..., 3:], casting="same_kind")
    return table


def rays_on(camera: Camera, device: torch.device) -> Tensor:
    """`rays` on `device`; worked out there unless it is the CPU, since a step's images would wait for them."""
    return torch.from_numpy(rays(camera)) if device.type == "cpu" else _rays_by_torch(camera, device)


def _rays_by_torch(camera: Camera, device: torch.device) -> Tensor:
    w2c, center = (torch.tensor(a, dtype=torch.float32, device=device) for a in (camera.w2c, camera.center))
    right, down, forward = w2c[:3, :3]
    columns, lines = (torch.arange(n, device=device) + 0.5 for n in (camera.width, camera.height))
    u, v = (
        (columns - float(camera.K[0, 2])) / float(camera.K[0, 0]),
        (lines - float(camera.K[1, 2])) / float(camera.K[1, 1]),
    )
    directions = (v[:, None] * down + forward)[:, None] + u[None, :, None] * right
    directions = directions / torch.sqrt(v.square()[:, None] + u.square() + 1)[..., None]
    return torch.cat([center.expand_as(directions), directions], dim=2)

"""Decoding carriers into Gaussians (paper, "Decoding Carriers into Gaussians", Eqs. child_position and sdf_opacity).

Heads shared by all carriers and frames turn a carrier's feature f into K children in its frame A = F diag(s). Offset,
scale and opacity come from linear heads, colour from a two-layer perceptron that also sees the viewing direction. Of
transparent liquid a further linear head says how much of what lies behind it shows through, which is not in the paper.
`Decoder.forward` is the definition, in plain torch; `Decoder.decode` computes the same, on the CPU by the kernel of
splashbench_methods.splashsplat.kernel.decode, which has the bounded scale residual alone.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Literal

import torch
from torch import Tensor, nn

from ..carriers.subframe import CarrierState
from ..kernel.decode import Heads, Instant, decode
from . import losses

# Where the children start, in units of the offset bound: half a unit to either side, one unit apart as in the
# supplement.
_START_DIRECTIONS = ((1, 0, 0), (-1, 0, 0), (0, 1, 0), (0, -1, 0), (0, 0, 1), (0, 0, -1))
_START_DISTANCE = 0.5
# The logit of every Gaussian's transmittance at the start.
_START_TRANSMITTANCE = -1.0


#: r of the scales s exp(eta_s r): the head's answer, "linear" as in the paper, or "bounded" to within 2 and -2
ScaleResidual = Literal["bounded", "linear"]


@dataclass(frozen=True)
class DecoderSettings:
    """offset_bound is beta, scale_range eta_s, opacity_slope kappa_alpha, opacity_band tau_alpha (transport voxels).
    transmission: what lies behind the liquid shows through it."""

    feature_size: int = 32
    children: int = 2
    color_width: int = 64
    offset_bound: float = 1.0
    scale_range: float = 0.5
    opacity_slope: float = 2.0
    opacity_band: float = 3.0
    opacity_bias: float = 1.0
    scale_residual: ScaleResidual = "bounded"
    transmission: bool = False


@dataclass
class Children:
    """n carriers' K children: means [n, K, 3], factors [n, K, 3, 3] of their covariances B B^T (scene units), opacities
    [n, K], colors [n, K, 3] in [0, 1], offsets [n, K, 3] in carrier units.

    transmittances: [n, K] in [0, 1], the share of what a Gaussian shows that is the background behind it, and not its
    color; None where it shows its color alone. Opacities are those of both.
    """

    means: Tensor
    factors: Tensor
    opacities: Tensor
    colors: Tensor
    offsets: Tensor
    transmittances: Tensor | None = None

    def to(self, device: str) -> Children:
        """The same on `device`."""
        return Children(
            self.means.to(device),
            self.factors.to(device),
            self.opacities.to(device),
            self.colors.to(device),
            self.offsets.to(device),
            None if self.transmittances is None else self.transmittances.to(device),
        )


@dataclass
class ColorCells:
    """Cells of space whose carriers should agree in colour.

    of_carriers: int64 [n], numbered from 0 without gaps. sizes: float [cells], carriers in each.
    """

    of_carriers: Tensor
    sizes: Tensor


@dataclass
class Penalties:
    """What the objective says of the children themselves, scalars: `losses.covariance_loss` in squared scene units,
    `separation_loss` and `color_loss`."""

    covariance: Tensor
    separation: Tensor
    color: Tensor


def penalties(children: Children, cells: ColorCells) -> Penalties:
    """The penalties on children, in plain torch; zero without any."""
    if len(children.means) == 0:
        none = children.means.sum()
        return Penalties(none, none, none)
    return Penalties(
        losses.covariance_loss(children.factors, voxel=1.0),
        losses.separation_loss(children.offsets),
        losses.color_loss(children.colors, cells.of_carriers, cells.sizes),
    )


class Decoder(nn.Module):
    """The heads g_o, g_s, g_alpha (linear) and g_c (two layers); where liquid is transparent, one more (linear)."""

    def __init__(self, settings: DecoderSettings) -> None:
        super().__init__()
        self.settings = settings
        size, k = settings.feature_size, settings.children
        self.offset = nn.Linear(size, 3 * k)
        self.scale = nn.Linear(size, 3 * k)
        self.opacity = nn.Linear(size, k)
        self.color_hidden = nn.Linear(size + 3, settings.color_width)
        self.color_out = nn.Linear(settings.color_width, 3 * k)
        if settings.transmission:
            self.transmittance = nn.Linear(size, k)
        with torch.no_grad():
            for head in self.linear_heads:
                head.weight.mul_(0.3)  # children start alike, near the values the biases give
            self.scale.bias.zero_()
            self.opacity.bias.fill_(settings.opacity_bias)
            starts = torch.tensor([_START_DIRECTIONS[i % 6] for i in range(k)], dtype=torch.float32)
            starts = starts * (_START_DISTANCE if k > 1 else 0.0) / settings.offset_bound
            self.offset.bias.copy_(torch.atanh(starts.clamp(-0.99, 0.99)).reshape(-1))
            if settings.transmission:
                self.transmittance.bias.fill_(_START_TRANSMITTANCE)

    @property
    def linear_heads(self) -> list[nn.Linear]:
        """All but that of the color."""
        heads = [self.offset, self.scale, self.opacity]
        return [*heads, self.transmittance] if self.settings.transmission else heads

    def offsets(self, features: Tensor) -> Tensor:
        """o = beta tanh(g_o(f)), [n, K, 3]."""
        raw = self.offset(features).view(len(features), self.settings.children, 3)
        return self.settings.offset_bound * torch.tanh(raw)

    def transmittances(self, features: Tensor) -> Tensor | None:
        """The share of what lies behind n carriers' children that shows through them, [n, K]; None for opaque ones."""
        return torch.sigmoid(self.transmittance(features)) if self.settings.transmission else None

    def forward(self, features: Tensor, log_scales: Tensor, state: CarrierState, eye: Tensor) -> Children:
        """Children of n carriers seen from `eye` [3].

        features: [n, feature_size]; log_scales: [n, 3], log of s in scene units.
        """
        s = self.settings
        n, k = len(features), s.children
        base = torch.exp(log_scales)
        offsets = self.offsets(features)
        local = (base[:, None] * offsets).transpose(1, 2)  # diag(s) o, [n, 3, K]
        means = state.positions[:, None] + torch.bmm(state.deformation, local).transpose(1, 2)
        # Sigma = B B^T with B = F diag(g) / sqrt(K). An unbounded exponent may let single Gaussians grow over the whole
        # image.
        residual = self.scale(features).view(n, k, 3)
        if s.scale_residual == "bounded":
            residual = 2 * torch.tanh(0.5 * residual)
        extent = base[:, None] * torch.exp(s.scale_range * residual) / math.sqrt(k)
        factors = state.deformation[:, None] * extent[:, :, None, :]
        fade = torch.sigmoid(s.opacity_slope * (s.opacity_band - state.phi.abs()))
        if state.visibility is not None:
            fade = fade * state.visibility
        opacities = torch.sigmoid(self.opacity(features)) * fade[:, None]
        direction = nn.functional.normalize(state.positions - eye, dim=1)
        hidden = torch.relu(self.color_hidden(torch.cat([features, direction], dim=1)))
        colors = torch.sigmoid(self.color_out(hidden)).view(n, k, 3)
        return Children(means, factors, opacities, colors, offsets, self.transmittances(features))

    def decode(
        self,
        features: Tensor,
        log_scales: Tensor,
        rows: Tensor | None,
        state: CarrierState,
        eye: Tensor,
        cells: ColorCells | None = None,
    ) -> tuple[Children, Penalties | None]:
        """Children of the carriers `rows` (int64 [n], ascending; None for all) of the tables, as `forward` has them,
        and with `cells` also the penalties on them. With `rows` the gradients of the tables are sparse."""
        tables = (features, log_scales)
        compiled = self.settings.scale_residual == "bounded"
        if compiled and all(table.device.type == "cpu" and table.dtype == torch.float32 for table in tables):
            groups = () if cells is None else (cells.of_carriers, len(cells.sizes))
            instant = Instant(state.positions, state.deformation, state.phi, eye, state.visibility, *groups)
            means, factors, opacities, colors, offsets, terms = decode(self.heads(), *tables, instant, rows)
            # The kernel knows nothing of these: one more layer, and of transparent liquid alone.
            shown_through = None
            if self.settings.transmission:
                own = features if rows is None else nn.functional.embedding(rows, features, sparse=True)
                shown_through = self.transmittances(own)
            children = Children(means, factors, opacities, colors, offsets, shown_through)
            return children, None if terms is None else Penalties(*terms.unbind())
        if rows is not None:
            features, log_scales = (nn.functional.embedding(rows, table, sparse=True) for table in tables)
        result = self(features, log_scales, state, eye)
        return result, None if cells is None else penalties(result, cells)

    def heads(self) -> Heads:
        """The heads as the kernel takes them."""
        s = self.settings
        return Heads(
            offset=(self.offset.weight, self.offset.bias),
            scale=(self.scale.weight, self.scale.bias),
            opacity=(self.opacity.weight, self.opacity.bias),
            hidden=(self.color_hidden.weight, self.color_hidden.bias),
            color=(self.color_out.weight, self.color_out.bias),
            offset_bound=s.offset_bound,
            scale_range=s.scale_range,
            opacity_slope=s.opacity_slope,
            opacity_band=s.opacity_band,
            separation_margin=losses.SEPARATION_MARGIN,
        )

    def mean_opacity(self, features: Tensor) -> Tensor:
        """Learned opacity of each carrier, the mean over its children without the fade by phi: [n]."""
        return torch.sigmoid(self.opacity(features)).mean(dim=1)


def initial_log_scale(base_scale: float, voxel: float) -> float:
    """log of s for carriers whose extent is `base_scale` transport voxels of size `voxel` (scene units)."""
    return math.log(base_scale * voxel)

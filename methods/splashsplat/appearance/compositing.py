"""Liquid over its background: the image of a window, and the opacity of the liquid alone (Eq. rendering).

Liquid lies in front of the background, is drawn together with it by depth, is cut by a container's near wall, or stands
behind a container's glass. Of transparent liquid the background shows through.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from torch import Tensor

from splashbench.gaussians.devices import CPU
from splashbench.native import memory
from splashbench.render import Frozen, compositing_weights, rasterize
from splashbench.scene.camera import Camera

from .decoder import Children
from .glass import Splats


@dataclass(frozen=True)
class _Gaussians:
    """n Gaussians: means [n, 3], factors [n, 3, 3], opacities [n], colors [n, 3], and what shows through them [n], see
    `Children.transmittances`."""

    means: Tensor
    factors: Tensor
    opacities: Tensor
    colors: Tensor
    transmittances: Tensor | None

    @classmethod
    def of(cls, children: Children) -> _Gaussians:
        """Of all carriers, in their order."""
        shown_through = children.transmittances
        return cls(
            children.means.flatten(0, 1),
            children.factors.flatten(0, 1),
            children.opacities.flatten(),
            children.colors.flatten(0, 1),
            None if shown_through is None else shown_through.flatten(),
        )

    @property
    def shapes(self) -> tuple[Tensor, Tensor, Tensor]:
        return self.means, self.factors, self.opacities

    @property
    def tables(self) -> list[Tensor]:
        """All there are, for `of_tables`."""
        tables = [*self.shapes, self.colors]
        return tables if self.transmittances is None else [*tables, self.transmittances]

    @classmethod
    def of_tables(cls, tables: Sequence[Tensor]) -> _Gaussians:
        means, factors, opacities, colors, *shown_through = tables
        return cls(means, factors, opacities, colors, shown_through[0] if shown_through else None)

    @property
    def channels(self) -> Tensor:
        """What they add to a pixel for each unit of their compositing weight: colour, and where there is transmission
        the share of the background, [n, 3 or 4]."""
        if self.transmittances is None:
            return self.colors
        shown_through = self.transmittances[:, None]
        return torch.cat([(1 - shown_through) * self.colors, shown_through], 1)

    def drawn(self, camera: Camera, background: Tensor, alone: bool = False) -> tuple[Tensor, Tensor]:
        """Over the `background`; image [h, w, 3] and opacity [h, w]. alone: it shows through them, and not beside."""
        if self.transmittances is None:
            return _rasterized(*self.shapes, self.colors, camera, None if alone else background)
        beside = background.new_tensor([0, 0, 0, 0 if alone else 1])
        drawn, alpha = _rasterized(*self.shapes, self.channels, camera, beside)
        return _before(drawn, background), alpha


def _rasterized(
    means: Tensor, factors: Tensor, opacities: Tensor, colors: Tensor, camera: Camera, background: Tensor | None
) -> tuple[Tensor, Tensor]:
    image: Tensor
    alpha: Tensor
    image, alpha = rasterize(means, factors, opacities, colors, camera, background=background)
    return image, alpha


def _before(drawn: Tensor, background: Tensor) -> Tensor:
    """`drawn` [h, w, 4 or more], its fourth channel the share of the `background` [h, w, 3] or [3], with that share."""
    return drawn[..., :3] + drawn[..., 3:4] * background


def composite(
    children: Children,
    camera: Camera,
    background: Tensor,
    frozen: Frozen | None = None,
    modes: np.ndarray | None = None,
    wall: Tensor | None = None,
    in_front: Tensor | None = None,
    glass: Splats | None = None,
) -> tuple[Tensor, Tensor]:
    """Liquid and background: rgb [h, w, 3], and the opacity [h, w] of the liquid alone.

    background: [h, w, 3] or [3], behind everything. frozen: the background's Gaussians for this camera, which are drawn
    in one order of depth with the liquid's (Eq. rendering); without them the liquid lies in front. modes: the tiles
    in which colours are needed, for the former. wall: [h, w], share of each pixel in which a container's near wall,
    which the background shows, lies before the liquid; in_front: bool [n], carriers that lie before it all the same.
    glass: Gaussians that are no liquid, drawn in one order of depth with the liquid's.
    Only one of frozen, wall and glass, and no frozen ones with transmittances. The opacity is "obtained by rasterizing
    G^fg alone" (supplement).

    Of transparent liquid, with w_i the compositing weights, c_i the colours, tau_i the transmittances and B the
    background,

        rgb = sum_i w_i ((1 - tau_i) c_i + tau_i B) + (1 - sum_i w_i) B,   opacity = sum_i w_i

    so that the liquid covers what its outline does, and shows what is behind it. Not in the paper.
    """
    liquid = _Gaussians.of(children)
    image: Tensor
    alpha: Tensor
    if glass is not None:
        assert frozen is None
        assert wall is None
        image, alpha = _with_glass(liquid, camera, background, glass)
    elif frozen is None and wall is not None:
        image, alpha = _behind_wall(liquid, camera, background, wall, in_front)
    elif frozen is None:
        image, alpha = liquid.drawn(camera, background)
    else:
        assert liquid.transmittances is None
        image, _ = rasterize(*liquid.shapes, liquid.colors, camera, background=background, frozen=frozen, modes=modes)
        _, alpha = rasterize(*liquid.shapes, None, camera)
    return image, alpha


def _with_glass(liquid: _Gaussians, camera: Camera, background: Tensor, glass: Splats) -> tuple[Tensor, Tensor]:
    """`composite` where glass stands before the liquid: its share of each pixel is a channel of its own."""
    theirs = glass.means, glass.factors, glass.opacities
    means, factors, opacities = (torch.cat(pair) for pair in zip(liquid.shapes, theirs))
    shown = liquid.channels
    others = torch.cat([glass.colors, glass.colors.new_zeros(len(glass.colors), shown.shape[1] - 3)], 1)
    parts = [torch.cat([c, c.new_full((len(c), 1), is_liquid)], 1) for c, is_liquid in ((shown, 1), (others, 0))]
    if liquid.transmittances is None:
        behind = torch.cat([background, background.new_zeros(*background.shape[:-1], 1)], -1)
    else:
        behind = background.new_tensor([0, 0, 0, 1, 0])
    drawn, _ = _rasterized(means, factors, opacities, torch.cat(parts), camera, behind)
    image = drawn[..., :3] if liquid.transmittances is None else _before(drawn, background)
    return image, drawn[..., -1]


def _behind_wall(
    liquid: _Gaussians, camera: Camera, background: Tensor, wall: Tensor, in_front: Tensor | None
) -> tuple[Tensor, Tensor]:
    """`composite` where a wall cuts the liquid, except for the carriers `in_front` of it."""
    if in_front is None or not bool(in_front.any()):
        return _cut(*liquid.drawn(camera, background), background, wall)
    # Children of one carrier follow each other.
    drawn_last = in_front.repeat_interleave(len(liquid.colors) // len(in_front))
    first, last = ((~drawn_last).nonzero()[:, 0], drawn_last.nonzero()[:, 0])
    parts = _Parts.apply(first, last, *liquid.tables)
    half = len(parts) // 2
    below, above = _Gaussians.of_tables(parts[:half]), _Gaussians.of_tables(parts[half:])
    image, alpha = _cut(*below.drawn(camera, background), background, wall)
    over, opacity = above.drawn(camera, background, alone=True)
    if image.device.type != CPU:
        return over + (1 - opacity[..., None]) * image, opacity + (1 - opacity) * alpha
    composited: tuple[Tensor, Tensor] = _Over.apply(over, opacity, image, alpha)
    return composited


class _Parts(torch.autograd.Function):
    """The rows `first` and the rows `last` (int64) of each table, of which every row is in one of them."""

    @staticmethod
    def forward(ctx: Any, first: Tensor, last: Tensor, *tables: Tensor) -> tuple[Tensor, ...]:
        ctx.save_for_backward(first, last)
        return tuple(table.index_select(0, rows) for rows in (first, last) for table in tables)

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx: Any, *by_part: Tensor) -> tuple[Tensor | None, ...]:
        first, last = ctx.saved_tensors
        half = len(by_part) // 2
        gradients = []
        for of_first, of_last in zip(by_part[:half], by_part[half:]):
            gradient = of_first.new_empty(len(first) + len(last), *of_first.shape[1:])
            gradients.append(gradient.index_copy_(0, first, of_first).index_copy_(0, last, of_last))
        return None, None, *gradients


class _Over(torch.autograd.Function):
    """`over` [h, w, 3] of the opacity [h, w] before an `image` and its opacity `alpha`, in their place and on the CPU:
    over + (1 - opacity) * image, and the same of opacities. What little is drawn alone is touched: images are large."""

    @staticmethod
    def forward(ctx: Any, over: Tensor, opacity: Tensor, image: Tensor, alpha: Tensor) -> tuple[Tensor, Tensor]:
        pixels = opacity.flatten().nonzero()[:, 0]
        share, below, below_alpha = (_at(pixels, values) for values in (opacity, image, alpha))
        clear = 1 - share
        ctx.save_for_backward(pixels, clear, below, below_alpha)
        image.view(-1, 3).index_copy_(0, pixels, _at(pixels, over) + clear[:, None] * below)
        alpha.view(-1).index_copy_(0, pixels, share + clear * below_alpha)
        ctx.mark_dirty(image, alpha)
        return image, alpha

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx: Any, by_image: Tensor, by_alpha: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        pixels, clear, below, below_alpha = ctx.saved_tensors
        here, here_alpha = _at(pixels, by_image), _at(pixels, by_alpha)
        by_below, by_below_alpha = _unset(by_image).copy_(by_image), _unset(by_alpha).copy_(by_alpha)
        by_below.view(-1, 3).index_copy_(0, pixels, clear[:, None] * here)
        by_below_alpha.view(-1).index_copy_(0, pixels, clear * here_alpha)
        # Where nothing is drawn there is nothing that this could move.
        by_opacity = _unset(by_alpha).zero_()
        changes = here_alpha - here_alpha * below_alpha - (here * below).sum(dim=1)
        by_opacity.view(-1).index_copy_(0, pixels, changes)
        return by_image, by_opacity, by_below, by_below_alpha


def _at(pixels: Tensor, values: Tensor) -> Tensor:
    """`values` [h, w, ...] at `pixels` (int64 [n], in the order of rows)."""
    return values.flatten(0, 1).index_select(0, pixels)


def _cut(image: Tensor, alpha: Tensor, background: Tensor, wall: Tensor) -> tuple[Tensor, Tensor]:
    """`image` [h, w, 3] and its opacity `alpha` [h, w] where a wall stands before the share `wall` [h, w] of each
    pixel, which the `background` [h, w, 3] or [3] shows."""
    if image.device.type != CPU:
        return image + wall[..., None] * (background - image), alpha * (1 - wall)
    cut: tuple[Tensor, Tensor] = _Cut.apply(image, alpha, background, wall)
    return cut


class _Cut(torch.autograd.Function):
    """`_cut` on the CPU, in memory that is used again: these images are large, and torch would make six of them."""

    @staticmethod
    def forward(ctx: Any, image: Tensor, alpha: Tensor, background: Tensor, wall: Tensor) -> tuple[Tensor, Tensor]:
        ctx.save_for_backward(wall)
        shown = _unset(image)
        torch.sub(background, image, out=shown).mul_(wall[..., None]).add_(image)
        return shown, torch.sub(1, wall, out=_unset(alpha)).mul_(alpha)

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx: Any, by_shown: Tensor, by_opacity: Tensor) -> tuple[Tensor, Tensor, None, None]:
        (wall,) = ctx.saved_tensors
        hidden = torch.mul(by_shown, wall[..., None], out=_unset(by_shown))
        by_image = torch.sub(by_shown, hidden, out=hidden)
        return by_image, torch.sub(1, wall, out=_unset(by_opacity)).mul_(by_opacity), None, None


def _unset(like: Tensor) -> Tensor:
    """Contiguous memory of its shape, float32, not initialised."""
    return torch.from_numpy(memory.empty(tuple(like.shape)))


def shares(
    children: Children,
    camera: Camera,
    frozen: Frozen | None = None,
    wall: Tensor | None = None,
    in_front: Tensor | None = None,
    glass: Splats | None = None,
) -> Tensor:
    """Pixels of the image of `composite` that each of n carriers makes up, float32 [n], on the CPU: the derivative of a
    channel, summed over pixels, by its Gaussians' colours. Arguments as there."""
    shapes = children.means.flatten(0, 1), children.factors.flatten(0, 1), children.opacities.flatten()

    def of(part: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        means, factors, opacities = (values[part] for values in shapes)
        return means, factors, opacities

    if glass is not None:
        theirs = glass.means, glass.factors, glass.opacities
        means, factors, opacities = (torch.cat(pair) for pair in zip(shapes, theirs))
        found = compositing_weights(means, factors, opacities, camera)[: len(shapes[2])]
    elif wall is None or in_front is None or not bool(in_front.any()):
        found = compositing_weights(*shapes, camera, counts=None if wall is None else 1 - wall, frozen=frozen)
    else:
        first = in_front.repeat_interleave(children.opacities.shape[1])
        _, opacity = rasterize(*of(first), None, camera)
        found = np.empty(len(first), dtype=np.float32)
        found[first.numpy()] = compositing_weights(*of(first), camera)
        found[~first.numpy()] = compositing_weights(*of(~first), camera, counts=(1 - wall) * (1 - opacity))
    return torch.from_numpy(found).reshape(children.opacities.shape).sum(dim=1)

"""Training targets at half and a quarter of their size: what large photographs teach first, with fewer pixels.

Scaffold-GS and its kin begin with small images, too. Not in the paper, whose images are as they are.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from functools import partial

import numpy as np
import torch
from torch import Tensor
from torch.nn.functional import pad

from splashbench.gaussians.devices import CPU
from splashbench.parallel import each

from ..kernel.window_loss import WindowPhotograph
from .first_look import FirstLook
from .photographs import Deferred, Photograph, Shelf, packed, read_now
from .targets import TrainingTarget, Views, windowed

#: How often photographs are halved. Windows begin at pixels that this leaves whole.
HALVINGS = 2
# Photographs that are read before what was seen in them is added up.
_AT_ONCE = 16


def with_smaller(
    targets: list[TrainingTarget],
    backgrounds: Mapping[str, np.ndarray],
    walls: Mapping[str, np.ndarray | None],
    first: FirstLook | None = None,
) -> None:
    """Give each target its `coarse` one of half the size, and that one its own, in place.

    backgrounds: float32 [H, W, 3] or [3] by view; walls: float32 [H, W] or None by view; of whole images, which the
    targets' windows are parts of. They are halved once each, and shared. Of photographs the larger ones are kept, as
    far as there is room; smaller ones are made of these whenever they are to teach. first: has a look at the large ones
    as they are read for that, where given.
    """
    behind = {name: torch.from_numpy(image) for name, image in backgrounds.items()}
    before = {name: None if wall is None else torch.from_numpy(wall) for name, wall in walls.items()}
    for number in range(HALVINGS):
        behind = {name: _halved(image) for name, image in behind.items()}
        before = {name: None if wall is None else _halved(wall) for name, wall in before.items()}
        if number == 0:
            _halve(targets, behind, before, Shelf(), first)
        else:
            _halve(targets, behind, before, Shelf(0), None)
        targets = [target.coarse for target in targets if target.coarse is not None]


def _halve(
    targets: list[TrainingTarget],
    behind: Mapping[str, Tensor],
    before: Mapping[str, Tensor | None],
    shelf: Shelf,
    first: FirstLook | None,
) -> None:
    """Give each target its `coarse` one, in place. behind, before: of whole images of its size. first: see
    `with_smaller`."""

    def halve(target: TrainingTarget) -> tuple[np.ndarray, np.ndarray] | None:
        photograph: Photograph = Deferred(partial(_read_halved, target.photograph))
        seen = None
        if first is not None or not shelf.full:
            large = read_now(target.photograph)
            seen = None if first is None else first.at(target, large)
            photograph = photograph if shelf.full else packed(shelf.keep(halved_photograph(large)))
        name = target.camera.name
        target.coarse = half_size(target, photograph, behind[name], before[name])
        return seen

    # Most of the time goes into reading photographs. What is seen in them is added up in their order, a few at a time.
    for start in range(0, len(targets), _AT_ONCE):
        for seen in each(halve, targets[start : start + _AT_ONCE]):
            if first is not None and seen is not None:
                first.add(seen)


def set_smaller_backgrounds(targets: list[TrainingTarget], views: Views, device: str = CPU) -> None:
    """Put others behind the smaller ones of `targets` where these have some, in place, on `device`."""
    for name, image in views:
        behind, smaller = (
            torch.from_numpy(image).to(device),
            [target for target in targets if target.camera.name == name],
        )
        while smaller := [target.coarse for target in smaller if target.coarse is not None]:
            behind = _halved(behind)
            for target in smaller:
                target.background = windowed(behind, target.corner, target.camera)


def half_size(
    target: TrainingTarget, photograph: Photograph, background: Tensor, wall: Tensor | None
) -> TrainingTarget:
    """`target` with pixels twice as wide and high.

    photograph: of that size, see `halved_photograph`. background, wall: of the whole image at that size, or [3] and
    None.
    """
    camera = target.camera.binned(2)
    x, y = (at // 2 for at in target.corner)
    window = slice(y, y + camera.height), slice(x, x + camera.width)
    return replace(
        target,
        camera=camera,
        photograph=photograph,
        background=background if background.ndim == 1 else background[window],
        area=target.area / 4,
        corner=(x, y),
        coarse=None,
        wall=None if wall is None else wall[window],
    )


def _read_halved(photograph: Photograph) -> WindowPhotograph:
    return halved_photograph(read_now(photograph))


def halved_photograph(photograph: WindowPhotograph) -> WindowPhotograph:
    """`photograph` with pixels twice as wide and high; a coarse pixel is liquid where half of it or more is."""
    rows, columns = photograph.mask.shape
    top, left = photograph.top % 2, photograph.left % 2
    # Coarse pixels begin at even ones of the window; what is added at the edges repeats them, and is no liquid.
    added = (top, (top + rows) % 2), (left, (left + columns) % 2)
    image = np.pad(photograph.image.numpy(), (*added, (0, 0)), mode="edge").astype(np.uint16)
    sums = image[0::2, 0::2] + image[0::2, 1::2] + image[1::2, 0::2] + image[1::2, 1::2]
    # A quarter, rounded; halves to the even number.
    means = (sums + 1 + (sums >> 2 & 1)) >> 2
    mask = np.pad(photograph.mask.numpy(), added).astype(np.uint8)
    covered = mask[0::2, 0::2] + mask[0::2, 1::2] + mask[1::2, 0::2] + mask[1::2, 1::2]
    return WindowPhotograph(
        torch.from_numpy(means.astype(np.uint8)),
        torch.from_numpy(covered >= 2),
        top=photograph.top // 2,
        left=photograph.left // 2,
    )


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

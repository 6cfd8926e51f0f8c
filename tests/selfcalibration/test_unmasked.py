"""Liquid that no mask shows, found by what changes in photographs."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from splashbench.scene import Camera
from splashbench.selfcalibration import hardly_masked
from splashbench.selfcalibration.unmasked import outlines_by_change, unconfirmed

from .test_outlines import agreement, eroded, footage, splash

#: Of the five cameras.
SOME = ("1", "4")
Mask = NDArray[np.bool_]


def none(name: str, t: int, mask: Mask) -> Mask:
    return np.zeros_like(mask)


def specks(name: str, t: int, mask: Mask) -> Mask:
    """A few pixels within the liquid."""
    only = np.zeros_like(mask)
    rows, columns = np.nonzero(mask)
    only[rows[::200], columns[::200]] = True
    return only


def dry(name: str, t: int) -> Mask:
    return np.zeros((160, 240), bool)


def later(name: str, t: int) -> Mask:
    """Liquid that comes after a quarter of the recording."""
    return splash(name, t) if t >= 5 else dry(name, t)


@pytest.mark.parametrize("masks", [none, specks])
def test_liquid_without_masks_is_found(cameras: dict[str, Camera], masks: Callable[[str, int, Mask], Mask]) -> None:
    scene: Any = footage(cameras, masks)
    assert hardly_masked(scene)
    found = outlines_by_change(scene, SOME)
    assert found.keys() == set(SOME)
    scene.train = SOME
    before, after = agreement(scene, found)
    assert before < 0.02
    assert after > 0.8
    assert {outline.line for outline in found.values()} == {
        "masks show next to no liquid; it is taken from what changes in its photographs"
    }


def test_frames_before_the_liquid_have_none(cameras: dict[str, Camera]) -> None:
    found = outlines_by_change(footage(cameras, none, later), SOME)
    for name in SOME:
        assert sum(int(found[name].masks[t].sum()) for t in range(5)) == 0
        assert all(found[name].masks[t].any() for t in range(5, 20))


def test_nothing_is_found_where_nothing_changes(cameras: dict[str, Camera]) -> None:
    assert outlines_by_change(footage(cameras, none, dry), SOME) == {}


def test_masks_that_show_the_liquid_stay(cameras: dict[str, Camera]) -> None:
    for masks in (lambda name, t, mask: mask, eroded):
        scene = footage(cameras, masks)
        assert not hardly_masked(scene)
        assert outlines_by_change(scene, SOME) == {}


def test_masks_elsewhere_stay(cameras: dict[str, Camera]) -> None:
    """Pixels that do not change are not what the photographs show a part of."""

    def beside(name: str, t: int, mask: Mask) -> Mask:
        only = np.zeros_like(mask)
        only[2:5, 2:5] = True
        return only

    assert outlines_by_change(footage(cameras, beside), SOME) == {}


def test_a_flash_is_no_liquid(cameras: dict[str, Camera]) -> None:
    """Photographs that change all over tell nothing."""
    scene: Any = footage(cameras, none, dry)
    steady = scene.image
    scene.image = lambda name, t: np.clip(steady(name, t).astype(int) + 12 * (t % 7), 0, 255).astype(np.uint8)
    assert outlines_by_change(scene, SOME) == {}


def test_one_camera_without_masks_is_left_to_the_others(cameras: dict[str, Camera]) -> None:
    assert not hardly_masked(footage(cameras, lambda name, t, mask: mask & (name != "2")))
    assert hardly_masked(footage(cameras, lambda name, t, mask: mask & (name in "12")))


def test_a_shadow_is_no_liquid(cameras: dict[str, Camera]) -> None:
    """One that moves over the table, beside the liquid."""
    scene: Any = footage(cameras, none)
    lit = scene.image

    def shadowed(name: str, t: int) -> NDArray[np.uint8]:
        image = lit(name, t).copy()
        left = 10 + 2 * t
        image[130:150, left : left + 30] = np.rint(0.6 * image[130:150, left : left + 30])
        return image

    scene.image = shadowed
    found = outlines_by_change(scene, SOME)
    scene.train = SOME
    _, after = agreement(scene, found)
    assert after > 0.8
    taken = np.mean([found[name].masks[t][133:147, 13 + 2 * t : 37 + 2 * t].mean() for name in SOME for t in range(20)])
    assert taken < 0.02


def test_right_masks_of_a_single_droplet_stay_though_somebody_walks_past(cameras: dict[str, Camera]) -> None:
    """By its colour photographs confirm the masks; not in every view, where it is as small as this."""

    def droplet(name: str, t: int) -> Mask:
        mask = dry(name, t)
        mask[20 + 3 * t : 23 + 3 * t, 100:104] = True
        return mask

    scene: Any = footage(cameras, liquid=droplet)
    scene.train = SOME[:1]
    empty = scene.image

    def walked_past(name: str, t: int) -> NDArray[np.uint8]:
        image = empty(name, t).copy()
        image[20:150, 8 * t : 8 * t + 40] = np.where(
            droplet(name, t)[20:150, 8 * t : 8 * t + 40, None], image[20:150, 8 * t : 8 * t + 40], (130, 90, 50)
        )
        return image

    scene.image = walked_past
    assert hardly_masked(scene)
    assert unconfirmed(scene) == []


def test_masks_that_are_specks_of_the_liquid_or_empty_are_not_confirmed(cameras: dict[str, Camera]) -> None:
    for masks in (none, specks):
        scene: Any = footage(cameras, masks)
        scene.train = SOME
        assert unconfirmed(scene) == list(SOME)

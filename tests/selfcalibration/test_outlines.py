"""Masks against photographs: what is wrong is found and mended, what is right or cannot be told stays as it is."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from types import SimpleNamespace
from typing import Any

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from splashbench.scene import Camera
from splashbench.selfcalibration.outlines import Outlines, PackedMasks, Sample, examined, noise_of

from .conftest import NAMES, photograph

FRAMES = 20
LIQUID = np.array([60, 110, 190])

Masks = Callable[[str, int, NDArray[np.bool_]], NDArray[np.bool_]]


def spray(name: str, t: int) -> NDArray[np.bool_]:
    """A hundred droplets of a pixel or two, bool [160, 240]."""
    mask = np.zeros((160, 240), np.uint8)
    rng = np.random.default_rng(100 * t + int(name))
    for u, v in rng.uniform([70, 40], [170, 130], (100, 2)):
        cv2.circle(mask, (round(u), round(v)), 1, 1, -1)
    return mask.astype(bool)


def splash(name: str, t: int) -> NDArray[np.bool_]:
    """A blob and a jet that sway, and droplets, bool [160, 240]."""
    mask = np.zeros((160, 240), np.uint8)
    x = 120 + 18 * np.sin(0.5 * t + int(name))
    cv2.ellipse(mask, (round(x), 100), (26, 14), 10 * np.sin(t), 0, 360, 1, -1)
    cv2.line(mask, (round(x), 100), (125, 30), 1, 7)
    rng = np.random.default_rng(100 * t + int(name))
    for u, v in rng.uniform([70, 50], [170, 130], (6, 2)):
        cv2.circle(mask, (round(u), round(v)), 3, 1, -1)
    return mask.astype(bool)


def footage(
    cameras: dict[str, Camera],
    masks: Masks = lambda name, t, mask: mask,
    liquid: Callable[[str, int], NDArray[np.bool_]] = splash,
    blur: float = 0.0,
    noise: float = 2.0,
) -> Any:
    """A scene of five cameras that see `liquid`, told `masks` of its true ones. blur: of photographs, in pixels. noise:
    of theirs, in levels."""
    still = {name: photograph(camera).astype(float) for name, camera in cameras.items()}

    def image(name: str, t: int) -> NDArray[np.uint8]:
        rng = np.random.default_rng(1000 * t + int(name))
        # Edges are mixed, and every pixel is noisy.
        share = cv2.GaussianBlur(liquid(name, t).astype(float), (0, 0), 0.6)[..., None]
        color = LIQUID + 6 * rng.normal(size=(160, 240, 1))
        seen = still[name] + share * (color - still[name]) + noise * rng.normal(size=(160, 240, 3))
        seen = cv2.GaussianBlur(seen, (0, 0), blur) if blur else seen
        return np.clip(np.rint(seen), 0, 255).astype(np.uint8)

    return SimpleNamespace(
        train=NAMES, cameras=cameras, n_frames=FRAMES, image=image, mask=lambda n, t: masks(n, t, liquid(n, t))
    )


def disc(pixels: int) -> NDArray[np.uint8]:
    return cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * pixels + 1, 2 * pixels + 1))


def eroded(name: str, t: int, mask: NDArray[np.bool_]) -> NDArray[np.bool_]:
    return cv2.erode(mask.astype(np.uint8), disc(3)).astype(bool)


def grown(name: str, t: int, mask: NDArray[np.bool_]) -> NDArray[np.bool_]:
    return cv2.dilate(mask.astype(np.uint8), disc(4)).astype(bool)


def one_mirrored(name: str, t: int, mask: NDArray[np.bool_]) -> NDArray[np.bool_]:
    return mask[:, ::-1] if name == "3" and 5 <= t < 10 else mask


def some_empty(name: str, t: int, mask: NDArray[np.bool_]) -> NDArray[np.bool_]:
    return mask & (name != "2" or t % 5 > 0)


def agreement(scene: Any, found: Mapping[str, Outlines]) -> tuple[float, float]:
    """IoU with the truth of the masks as told, and with those that were found in their places."""
    both = np.zeros((2, 2))
    for name in scene.train:
        for t in range(FRAMES):
            true, told = splash(name, t), scene.mask(name, t)
            right = found[name].masks[t] if name in found and t in found[name].masks else told
            both += [[(true & m).sum(), (true | m).sum()] for m in (told, right)]
    before, after = both[:, 0] / both[:, 1]
    return float(before), float(after)


def test_right_masks_stay(cameras: dict[str, Camera]) -> None:
    assert examined(footage(cameras), NAMES).outlines == {}


@pytest.mark.parametrize("told", [lambda name, t, mask: mask, grown], ids=["right", "grown"])
@pytest.mark.parametrize("noise", [20, 40])
def test_noisy_photographs_have_no_say(cameras: dict[str, Camera], told: Masks, noise: float) -> None:
    found = examined(footage(cameras, told, noise=noise), NAMES)
    assert (found.outlines, found.untrusted) == ({}, ())
    assert found.noisy == {name: pytest.approx(noise, rel=0.1) for name in NAMES}


def test_one_noisy_camera_leaves_the_others_their_say(cameras: dict[str, Camera]) -> None:
    quiet, loud = (footage(cameras, grown, noise=noise) for noise in (2, 30))
    quiet.image = (lambda of_all: lambda name, t: (loud.image if name == "2" else of_all)(name, t))(quiet.image)
    found = examined(quiet, NAMES)
    assert found.outlines.keys() == set(NAMES) - {"2"}
    assert found.noisy.keys() == {"2"}


@pytest.mark.parametrize("noise", [0, 3, 15, 40])
def test_noise_is_measured_and_what_else_changes_is_not(noise: float) -> None:
    rng = np.random.default_rng(8)
    scene = np.kron(rng.integers(60, 180, (15, 20, 3)), np.ones((8, 8, 1)))
    frames = [scene + light + rng.normal(scale=max(noise, 1e-9), size=scene.shape) for light in (0, 25, -20, 10)]
    frames[2][:60, :90] += 50  # something large passes
    images = np.clip(np.rint(np.stack(frames)), 0, 255).astype(np.uint8)
    nowhere = np.zeros(images.shape[:3], bool)
    assert noise_of(Sample((0, 1, 2, 3), images, nowhere)) == pytest.approx(noise, rel=0.1, abs=0.5)
    assert noise_of(Sample((0,), images[:1], nowhere[:1])) == 0
    assert noise_of(Sample((0, 1), images[:2, :, :1], nowhere[:2, :, :1])) == 0
    # Liquid that fills most of the picture is no noise, whatever it does there.
    filled = nowhere.copy()
    filled[:, 10:] = True
    images[filled] = rng.integers(0, 256, images[filled].shape)
    assert noise_of(Sample((0, 1, 2, 3), images, filled)) == pytest.approx(noise, rel=0.15, abs=0.5)
    assert noise_of(Sample((0, 1, 2, 3), images, ~nowhere)) == 0


@pytest.mark.parametrize(("masks", "beyond"), [(eroded, -2), (grown, 4)], ids=["eroded", "grown"])
def test_masks_that_end_elsewhere_are_replaced(cameras: dict[str, Camera], masks: Masks, beyond: float) -> None:
    scene = footage(cameras, masks)
    found = examined(scene, NAMES).outlines
    assert found.keys() == set(NAMES)
    before, after = agreement(scene, found)
    assert before < 0.6
    assert after > 0.85
    for outline in found.values():
        assert len(outline.masks.bits) == FRAMES
        assert outline.beyond == pytest.approx(beyond, abs=1)
        side = "end" if beyond < 0 else "reach"
        assert outline.line.startswith(f"masks {side} {abs(outline.beyond):.1f} px ")


def test_single_masks_that_show_something_else_are_replaced(cameras: dict[str, Camera]) -> None:
    scene = footage(cameras, one_mirrored)
    found = examined(scene, NAMES).outlines
    assert found.keys() == {"3"}
    assert sorted(found["3"].masks.bits) == [5, 6, 7, 8, 9]
    assert found["3"].line == (
        "5 of 20 masks are not what its photographs show (timesteps 5, 6, 7, 8, 9); replaced by what these show"
    )
    before, after = agreement(scene, found)
    assert (before < 0.97, after > 0.97) == (True, True)


def test_empty_masks_of_frames_with_liquid_are_replaced(cameras: dict[str, Camera]) -> None:
    found = examined(footage(cameras, some_empty), NAMES).outlines
    assert found.keys() == {"2"}
    assert sorted(found["2"].masks.bits) == [0, 5, 10, 15]


def test_cameras_that_are_not_named_stay(cameras: dict[str, Camera]) -> None:
    assert examined(footage(cameras, eroded), ("1", "4")).outlines.keys() == {"1", "4"}
    assert examined(footage(cameras, eroded), ()).outlines == {}


@pytest.mark.slow
def test_where_photographs_show_no_liquid_masks_stay(cameras: dict[str, Camera]) -> None:
    """Liquid that looks like what is behind it."""
    still = {name: photograph(camera) for name, camera in cameras.items()}
    for masks in (eroded, grown, one_mirrored):
        scene = footage(cameras, masks)
        scene.image = lambda name, t: still[name]
        assert examined(scene, NAMES).outlines == {}


def test_photographs_that_are_less_sharp_than_masks_have_no_say(cameras: dict[str, Camera]) -> None:
    assert examined(footage(cameras, liquid=spray), NAMES).outlines == {}
    assert examined(footage(cameras, liquid=spray, blur=2.5), NAMES).outlines == {}


@pytest.mark.parametrize("fill", [False, True], ids=["empty", "full"])
def test_masks_that_are_all_alike_do_no_harm(cameras: dict[str, Camera], fill: bool) -> None:
    scene = footage(cameras, lambda name, t, mask: np.full_like(mask, fill))
    assert examined(scene, NAMES).outlines == {}


def test_a_single_frame_does_no_harm(cameras: dict[str, Camera]) -> None:
    scene = footage(cameras)
    scene.n_frames = 1
    assert examined(scene, NAMES).outlines == {}


def test_large_photographs_are_looked_at_small_and_their_masks_are_whole(cameras: dict[str, Camera]) -> None:
    small = footage(cameras, grown)
    large = {
        name: Camera(name, 720, 480, np.diag([3, 3, 1.0]) @ camera.K, camera.w2c) for name, camera in cameras.items()
    }
    scene = SimpleNamespace(
        train=NAMES,
        cameras=large,
        n_frames=FRAMES,
        image=lambda n, t: cv2.resize(small.image(n, t), (720, 480), interpolation=cv2.INTER_CUBIC),
        mask=lambda n, t: small.mask(n, t).repeat(3, 0).repeat(3, 1),
    )
    found = examined(scene, ("1",)).outlines
    assert found.keys() == {"1"}
    assert found["1"].masks.shape == (480, 720)
    assert found["1"].beyond == pytest.approx(12, abs=3)
    true = splash("1", 3).repeat(3, 0).repeat(3, 1)
    said = found["1"].masks[3]
    assert (said & true).sum() / (said | true).sum() > 0.85


def test_packed_masks_are_the_masks() -> None:
    rng = np.random.default_rng(0)
    masks = {t: rng.random((7, 13)) < 0.5 for t in (2, 5)}
    packed = PackedMasks.of((7, 13), masks.items())
    assert (2 in packed, 3 in packed) == (True, False)
    for t, mask in masks.items():
        np.testing.assert_array_equal(packed[t], mask)
    assert packed.digest != PackedMasks.of((7, 13), [(2, masks[2])]).digest

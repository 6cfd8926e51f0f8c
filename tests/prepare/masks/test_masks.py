"""Liquid masks: against the background under noise, shadow and changing exposure; from a folder; and judging them."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest

from splashbench.errors import SplashbenchError
from splashbench.files import write_png
from splashbench.prepare.calibration.lens import Lens
from splashbench.prepare.calibration.undistort import Undistorter
from splashbench.prepare.container import container_masks
from splashbench.prepare.crop import PixelBox
from splashbench.prepare.masks.background import BackgroundMasks, EmptyScene, segment
from splashbench.prepare.masks.provider import FolderMasks, mask_health

WIDTH, HEIGHT = 240, 160


def scenery(rng: np.random.Generator) -> np.ndarray:
    """A mottled tabletop [H, W, 3]."""
    coarse = rng.uniform(0.6, 1.0, (10, 15, 1)).astype(np.float32)
    shade = cv2.resize(coarse, (WIDTH, HEIGHT), interpolation=cv2.INTER_CUBIC)[..., None]
    return shade * np.array([150.0, 130.0, 105.0])


def recorded(scene: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    return np.clip(scene + rng.normal(0, 2.0, scene.shape), 0, 255).round().astype(np.uint8)


def blob(radius: float, x: float, y: float) -> np.ndarray:
    """Coverage [H, W] of a disc with an antialiased edge."""
    rows, columns = np.mgrid[0:HEIGHT, 0:WIDTH] + 0.5
    return np.clip(radius - np.hypot(columns - x, rows - y) + 0.5, 0, 1)


def intersection_over_union(a: np.ndarray, b: np.ndarray) -> float:
    return float((a & b).sum() / (a | b).sum())


def fitted(empty: np.ndarray, rng: np.random.Generator) -> EmptyScene:
    frames = [recorded(empty, rng) for _ in range(15)]
    return EmptyScene.fit(lambda: frames, 15)


@pytest.mark.parametrize(
    "liquid", [(60, 90, 190), (200, 60, 50), (235, 235, 235), (35, 30, 25), (60, 150, 70)], ids=str
)
def test_liquid_of_any_colour_is_found_despite_noise_shadow_and_exposure(liquid: tuple[int, int, int]) -> None:
    rng = np.random.default_rng(1)
    empty = scenery(rng)
    background = fitted(empty, rng)
    lit = empty * (1 - 0.4 * cv2.GaussianBlur(blob(22, 175, 60), (0, 0), 4))[..., None]  # a shadow, 40% darker
    coverage = blob(25, 90, 90)
    coverage = np.maximum(coverage, blob(3, 60, 30))  # a droplet
    frame = (lit * (1 - coverage[..., None]) + np.array(liquid) * coverage[..., None]) * 0.93  # exposure has changed
    mask = segment(*background.compare(recorded(frame, rng)))
    assert intersection_over_union(mask, coverage > 0.5) > 0.95
    assert not mask[35:85, 150:200].any()


def test_an_empty_frame_has_an_empty_mask() -> None:
    rng = np.random.default_rng(2)
    empty = scenery(rng)
    background = fitted(empty, rng)
    for _ in range(5):
        assert not segment(*background.compare(recorded(empty, rng))).any()


@pytest.mark.parametrize("gain", [(1.3, 1.3, 1.3), (0.85, 1.0, 1.15)], ids=["brighter", "another white balance"])
def test_a_change_of_the_whole_picture_is_no_liquid(gain: tuple[float, float, float]) -> None:
    """Beyond what a shadow or a reflection explains: the camera has set its exposure or white balance anew."""
    rng = np.random.default_rng(5)
    empty = scenery(rng)
    background = fitted(empty, rng)
    coverage = blob(25, 90, 90)
    frame = (empty * (1 - coverage[..., None]) + np.array([60, 90, 190]) * coverage[..., None]) * gain
    assert intersection_over_union(segment(*background.compare(recorded(frame, rng))), coverage > 0.5) > 0.95
    assert not segment(*background.compare(recorded(empty * gain, rng))).any()


def test_a_thin_stream_keeps_its_width() -> None:
    rng = np.random.default_rng(3)
    empty = scenery(rng)
    background = fitted(empty, rng)
    columns = np.arange(WIDTH) + 0.5
    coverage = np.clip(3.0 - np.abs(columns - 120.0) + 0.5, 0, 1)[None].repeat(HEIGHT, 0)  # six pixels wide
    soft = cv2.GaussianBlur(coverage, (0, 0), 0.8)[..., None]  # the lens and the codec blur it
    frame = empty * (1 - soft) + np.array([70, 100, 190]) * soft
    mask = segment(*background.compare(recorded(frame, rng)))
    assert 5.5 <= mask.sum() / HEIGHT <= 6.6


def test_background_needs_frames_without_liquid() -> None:
    rng = np.random.default_rng(4)

    def read(camera: str, indices):
        return ((index, recorded(scenery(rng), rng)) for index in indices)

    provider = BackgroundMasks(read, {"3": [0, 1]}, {"3": "cameras/3/pour/GX010003.MP4"})
    with pytest.raises(SplashbenchError, match=r"GX010003\.MP4: 2 frames before the liquid comes"):
        list(provider.masks("3", [10, 11]))


def test_folder_masks_missing_files_mean_no_liquid(tmp_path: Path) -> None:
    mask = np.zeros((HEIGHT, WIDTH), np.uint8)
    mask[20:30, 40:60] = 255
    write_png(tmp_path / "1" / "000012.png", mask)
    provider = FolderMasks(tmp_path, {"1": (WIDTH, HEIGHT), "2": (WIDTH, HEIGHT)})
    found = dict(provider.masks("1", [10, 12]))
    assert not found[10].any()
    np.testing.assert_array_equal(found[12], mask > 0)
    with pytest.raises(SplashbenchError, match="no mask for any of the 2 source frames of camera 2"):
        list(provider.masks("2", [10, 12]))
    with pytest.raises(SplashbenchError, match=r"000012\.png is 240x160, the recording is 480x270"):
        list(FolderMasks(tmp_path, {"1": (480, 270)}).masks("1", [12]))


def test_health_tells_empty_flooded_and_flickering_masks() -> None:
    health = mask_health([0, 0, 50, 60, 5, 70, 0, 80, 9000, 90], 10_000)
    assert health.empty == [0, 1, 6]
    assert health.flooded == [8]
    assert health.flickering == [4, 6]
    assert health.failed == [4, 6, 8]
    assert mask_health([0, 10, 20], 10_000).failed == []


def lens(k1: float) -> Lens:
    K = np.array([[200.0, 0.0, 121.0], [0.0, 200.0, 79.0], [0.0, 0.0, 1.0]])
    return Lens(WIDTH, HEIGHT, K, np.array([k1, 0.02, 0.0005, -0.0005, 0.0]))


def test_undistorted_image_is_what_a_pinhole_sees() -> None:
    """A smooth picture of the direction of view, taken through the lens, must come out as the pinhole's own picture."""

    def picture(rays: np.ndarray) -> np.ndarray:
        return 128 + 60 * np.stack([np.sin(25 * rays[:, 0]), np.cos(22 * rays[:, 1]), np.sin(18 * rays.sum(1))], axis=1)

    barrel = lens(-0.2)
    rows, columns = np.mgrid[0:HEIGHT, 0:WIDTH]
    pixels = np.stack([columns + 0.5, rows + 0.5], axis=-1).reshape(-1, 2)
    raw = picture(barrel.normalise(pixels)).round().astype(np.uint8).reshape(HEIGHT, WIDTH, 3)
    expected = picture((pixels - barrel.K[:2, 2]) / [200.0, 200.0]).reshape(HEIGHT, WIDTH, 3)
    undistorter = Undistorter(barrel)
    assert undistorter.source_share() == 1.0
    assert np.abs(undistorter.image(raw)[2:-2, 2:-2] - expected[2:-2, 2:-2]).max() < 2.5


def test_undistorted_mask_has_its_outline_in_the_right_place() -> None:
    barrel = lens(-0.2)
    rows, columns = np.mgrid[0:HEIGHT, 0:WIDTH]
    pixels = np.stack([columns + 0.5, rows + 0.5], axis=-1).reshape(-1, 2)

    def disc(rays: np.ndarray) -> np.ndarray:
        return (np.hypot(rays[:, 0] - 0.25, rays[:, 1] - 0.1) < 0.15).reshape(HEIGHT, WIDTH)

    mask = Undistorter(barrel).mask(disc(barrel.normalise(pixels)))
    truth = disc((pixels - barrel.K[:2, 2]) / [200.0, 200.0])
    assert intersection_over_union(mask, truth) > 0.97
    assert abs(int(mask.sum()) - int(truth.sum())) < 0.005 * truth.sum()


def test_pincushion_corners_have_no_source_and_no_mask() -> None:
    undistorter = Undistorter(lens(0.3))
    assert undistorter.source_share() < 0.99
    assert undistorter.source_share(PixelBox(90, 60, 150, 100)) == 1.0
    mask = undistorter.mask(np.ones((HEIGHT, WIDTH), bool))
    image = undistorter.image(np.full((HEIGHT, WIDTH, 3), 200, np.uint8))
    assert not mask[0, 0]
    assert not image[0, 0].any()


def test_container_masks_are_undistorted(tmp_path: Path) -> None:
    K = np.array([[80.0, 0, 50], [0, 80.0, 40], [0, 0, 1]])
    undistorter = Undistorter(Lens(100, 80, K, np.zeros(5)))
    raw = np.zeros((80, 100), np.uint8)
    raw[20:60, 30:70] = 255
    write_png(tmp_path / "1.png", raw)
    found = container_masks(tmp_path, {"1": undistorter, "2": undistorter})
    assert set(found) == {"1"}
    assert (found["1"] == (raw > 0)).all()
    assert container_masks(None, {"1": undistorter}) == {}

"""The smallest length that cameras can show: what makes it longer, and that it is found in the footage."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter

from splashbench.observe import Silhouettes, sequence_bounds
from splashbench.observe.observable import Observable, _softness, observable
from splashbench.scene import Scene
from splashbench.scene.scene import TrainingScene


def measured(scene: TrainingScene) -> Observable:
    silhouettes = Silhouettes(scene)
    return observable(scene, silhouettes, sequence_bounds(silhouettes), None)


@pytest.fixture
def scene(balls: Scene) -> TrainingScene:
    return balls.training()


def test_masks_of_one_liquid_agree(scene: TrainingScene) -> None:
    found = measured(scene)
    assert found.disagreement < 0.4
    assert 30 < found.angle <= 90
    camera = scene.cameras[scene.train[0]]
    assert found.pixel == pytest.approx(np.linalg.norm(camera.center) / camera.K[0, 0], rel=0.5)
    assert found.length == pytest.approx(found.pixel * found.pixels)


def test_clocks_that_are_off_make_outlines_disagree(scene: TrainingScene, monkeypatch: pytest.MonkeyPatch) -> None:
    before = measured(scene)
    seen, late = scene.mask, scene.train[::2]
    monkeypatch.setattr(
        scene, "mask", lambda name, t: seen(name, min(t + 1, scene.n_frames - 1) if name in late else t)
    )
    after = measured(scene)
    assert after.disagreement > before.disagreement + 0.5
    assert after.pixels > before.pixels


def test_blurred_photographs_have_wide_edges(scene: TrainingScene, monkeypatch: pytest.MonkeyPatch) -> None:
    sharp, seen = measured(scene), scene.image
    assert sharp.edge is not None
    widths = [sharp.edge]
    for sigma in (1.0, 2.0):
        monkeypatch.setattr(
            scene, "image", lambda name, t, s=sigma: gaussian_filter(seen(name, t), (s, s, 0), mode="nearest")
        )
        found = measured(scene)
        assert found.edge is not None
        widths.append(found.edge)
    assert widths == sorted(widths)
    assert widths[-1] > widths[0] + 1


@pytest.mark.parametrize("sigma", [1.0, 1.5, 2.0])
def test_the_width_of_a_blurred_step_is_that_of_the_gaussian(sigma: float) -> None:
    image = np.zeros((60, 80, 3), dtype=np.uint8)
    image[:, 40:] = 200
    blurred = gaussian_filter(image.astype(float), (0, sigma, 0)).round().astype(np.uint8)
    mask = image[..., 0] > 0
    # The steepest step of a Gaussian edge is its contrast divided by sigma sqrt(2 pi).
    assert np.median(_softness(blurred, mask)) == pytest.approx(sigma * np.sqrt(2 * np.pi), rel=0.15)
    assert len(_softness(np.full_like(image, 90), mask)) == 0


def test_views_that_hardly_differ_see_no_depth() -> None:
    apart = Observable(pixel=1.0, edge=1.0, disagreement=0.0, angle=90.0)
    together = Observable(pixel=1.0, edge=1.0, disagreement=0.0, angle=10.0)
    assert apart.pixels == pytest.approx(1)
    assert together.pixels == pytest.approx(1 / np.sin(np.radians(10)))
    assert Observable(1.0, None, 0.5, 90.0).pixels == pytest.approx(2**0.5)

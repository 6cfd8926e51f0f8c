"""A training scene with smaller photographs: cameras, photographs and masks of the same views."""

import numpy as np
import pytest

from splashbench.errors import SplashbenchError
from splashbench.scene import Scene, TrainingScene
from splashbench.scene.small_scene import SmallScene, smaller
from splashbench.synth.balls import write_balls_scene


@pytest.fixture(scope="module")
def scene(tmp_path_factory: pytest.TempPathFactory) -> Scene:
    """Its sides are no multiples of 4."""
    return write_balls_scene(tmp_path_factory.mktemp("odd") / "scene", size=(98, 65), n_frames=2)


def test_pixels_are_means_of_squares_and_wet_where_half_is(scene: Scene) -> None:
    training = scene.training()
    small = SmallScene(training, dict.fromkeys(training.train, 4))
    image, mask = small.image("1", 1), small.mask("1", 1)
    assert image.shape == (17, 25, 3)
    assert mask.shape == (17, 25)
    squares = training.image("1", 1)[:64, :96].reshape(16, 4, 24, 4, 3).mean(axis=(1, 3))
    assert np.abs(image[:16, :24] - squares).max() <= 0.51
    # At the edges there is less of a square.
    rest = training.image("1", 1)[64:, :96].reshape(24, 4, 3).mean(axis=1)
    assert np.abs(image[16, :24] - rest).max() <= 0.51
    shares = training.mask("1", 1)[:64, :96].reshape(16, 4, 24, 4).mean(axis=(1, 3))
    np.testing.assert_array_equal(mask[:16, :24], shares >= 0.5)
    assert 0 < mask.sum() < mask.size


def test_points_project_to_the_same_place(scene: Scene) -> None:
    training = scene.training()
    small = SmallScene(training, dict.fromkeys(training.train, 4))
    points = np.random.default_rng(0).uniform(-0.3, 0.3, (20, 3))
    for name, camera in training.cameras.items():
        (large, depth), (found, other) = camera.project(points), small.cameras[name].project(points)
        np.testing.assert_allclose(found * 4, large)
        np.testing.assert_allclose(other, depth)
        assert (small.cameras[name].height, small.cameras[name].width) == small.image(name, 0).shape[:2]


def test_each_photograph_is_read_once(scene: Scene, monkeypatch: pytest.MonkeyPatch) -> None:
    training, read = scene.training(), []
    whole = training.image
    monkeypatch.setattr(training, "image", lambda *which: read.append(which) or whole(*which))
    small = SmallScene(training, dict.fromkeys(training.train, 2))
    first = small.image("1", 0)
    first[:] = 0  # nobody else's
    assert small.image("1", 0).any()
    assert read == [("1", 0)]


def test_small_photographs_stay_and_test_views_are_not_read(scene: Scene) -> None:
    training = scene.training()
    assert smaller(training, 50) is training
    small = smaller(training, 49)
    assert small is not training
    assert small.cameras["1"].width == 49
    assert small.variation != training.variation
    with pytest.raises(SplashbenchError, match="no training view"):
        small.image(training.test[0], 0)


def test_masks_found_elsewhere_count(scene: Scene) -> None:
    """What is made smaller are the masks of the scene that was given, not those of its folder."""

    class Wet(TrainingScene):
        def mask(self, camera: str, t: int) -> np.ndarray:
            return np.ones((65, 98), bool)

    assert SmallScene(Wet(scene), dict.fromkeys(scene.train, 4)).mask("1", 0).all()


def test_container_masks_shrink_too_where_there_are_some(scene: Scene, monkeypatch: pytest.MonkeyPatch) -> None:
    training = scene.training()
    monkeypatch.setattr(training, "container_mask", lambda name: np.arange(98) < np.full((65, 1), 48))
    found = SmallScene(training, dict.fromkeys(training.train, 4)).container_mask("1")
    np.testing.assert_array_equal(found, np.broadcast_to(np.arange(25) < 12, (17, 25)))
    monkeypatch.setattr(training, "container_mask", lambda name: None)
    assert SmallScene(training, dict.fromkeys(training.train, 4)).container_mask("1") is None


def test_a_camera_that_is_small_already_stays_as_it_is(scene: Scene) -> None:
    training = scene.training()
    camera = training.cameras["2"]
    training.cameras["2"] = camera.binned(8)
    small = smaller(training, 40)
    assert small.cameras["1"].width == 49
    assert small.cameras["2"].width == 13

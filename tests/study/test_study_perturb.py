"""Worse masks: the paper's figures are met, parts only go missing, and test views stay as they are."""

from pathlib import Path

import numpy as np
import pytest

from splashbench.errors import SplashbenchError
from splashbench.scene import Scene
from splashbench.scene.inspection import check_scene
from splashbench.study.perturbations.masks import EmptyMasks, MissingParts, empty_masks, missing_parts, without_part
from splashbench.study.scenes import changed_scene, changes
from splashbench.study.spec import StudyVariant
from splashbench.study.view_subsets import azimuths, nested_views

RAW = StudyVariant(
    name="raw",
    perturbation=(MissingParts(kind="missing_parts", target_iou=0.845), EmptyMasks(kind="empty_masks", share=0.086)),
)


def test_raw_masks_have_the_figures_of_the_paper() -> None:
    wet = np.ones((5, 500), bool)
    rng = np.random.default_rng(0)
    kept = missing_parts(0.845)(wet, rng) * empty_masks(0.086)(wet, rng)
    assert (kept == 0).mean() == pytest.approx(0.086, abs=1e-3)
    assert kept.mean() == pytest.approx(0.772, abs=0.01)
    assert np.median(kept) == pytest.approx(0.967, abs=0.005)


@pytest.mark.parametrize("target", [0.3, 0.6, 0.845, 0.96, 0.99, 1.0])
def test_parts_go_missing_down_to_the_iou_asked_for(target: float) -> None:
    wet = np.zeros((4, 300), bool)
    wet[:, 40:] = True
    kept = missing_parts(target)(wet, np.random.default_rng(3))
    assert kept[wet].mean() == pytest.approx(target, abs=0.002)
    assert kept.min() >= 0
    assert kept.max() <= 1
    assert (kept[~wet] == 1).all()


def test_a_hard_frame_is_hard_in_several_views_and_for_a_while() -> None:
    kept = empty_masks(0.5)(np.ones((20, 400), bool), np.random.default_rng(1))
    views = np.corrcoef(kept)
    assert views[~np.eye(20, dtype=bool)].mean() > 0.15
    later = np.mean([np.corrcoef(row[:-1], row[1:])[0, 1] for row in kept])
    assert later > 0.5


def test_the_lower_part_of_a_mask_goes_first() -> None:
    mask = np.zeros((10, 10), bool)
    mask[2:8, 3:7] = True
    left = without_part(mask, 0.5, np.array([0.0, 1.0]))
    assert left[2:5, 3:7].all()
    assert left.sum() == 12
    assert not without_part(mask, 0.0, np.array([0.0, 1.0])).any()


def test_a_copy_differs_in_its_training_masks_alone(balls: Scene, tmp_path: Path) -> None:
    copy = changed_scene(balls, RAW, 1, tmp_path)
    assert check_scene(copy.directory) == []
    assert (copy.name, copy.train, copy.test) == (balls.name, balls.train, balls.test)
    assert copy.digest != balls.digest
    kept = []
    for name in balls.cameras:
        for t in range(balls.n_frames):
            assert (copy.image(name, t) == balls.image(name, t)).all()
            before, now = balls.mask(name, t), copy.mask(name, t)
            if name in balls.test:
                assert (now == before).all()
            else:
                assert not (now & ~before).any()
                kept.append(now.sum() / before.sum())
    assert np.mean(np.array(kept) == 0) == pytest.approx(0.086, abs=0.02)
    # 40 masks: which of the damaged ones are empty as well is luck.
    assert np.mean(kept) == pytest.approx(0.772, abs=0.05)
    assert Scene.open(balls.directory).digest == balls.digest


def test_a_seed_gives_the_same_masks_and_another_seed_others(balls: Scene, tmp_path: Path) -> None:
    first, again = (changed_scene(balls, RAW, 1, tmp_path / place) for place in ("a", "b"))
    assert first.digest == again.digest
    assert changed_scene(balls, RAW, 2, tmp_path / "a").digest != first.digest
    assert changes(balls, RAW, 1) != changes(balls, RAW, 2)


def test_fewer_views_are_nested_and_bracket_the_test_views(balls: Scene, tmp_path: Path) -> None:
    four, three = nested_views(balls, 4), nested_views(balls, 3)
    assert set(three) < set(four) < set(balls.train)
    angle = azimuths(balls)
    for name in balls.test:
        assert min(angle[view] for view in three) < angle[name] < max(angle[view] for view in three)
    copy = changed_scene(balls, StudyVariant(name="views_3", train_views=3), 0, tmp_path)
    assert (copy.train, copy.test) == (three, balls.test)
    assert check_scene(copy.directory) == []
    np.testing.assert_array_equal(copy.cameras[three[1]].w2c, balls.cameras[three[1]].w2c)
    assert (copy.image("6", 3) == balls.image("6", 3)).all()
    assert {path.name for path in (copy.directory / "ims").iterdir()} == {*three, *balls.test}
    assert changed_scene(balls, StudyVariant(name="views_5", train_views=5), 0, tmp_path) is balls


def test_a_scene_without_scene_json_keeps_its_name(balls_copy: Path, tmp_path: Path) -> None:
    (balls_copy / "scene.json").unlink()
    balls_copy.rename(tmp_path / "bowl_003")  # one of Table S1, whose times follow from the name
    scene = Scene.open(tmp_path / "bowl_003")
    copy = changed_scene(scene, StudyVariant(name="v", train_views=4), 0, tmp_path / "cache")
    assert (copy.name, copy.is_released, copy.times_source) == ("bowl_003", True, "manifest")


def test_views_that_cannot_be_are_told(balls: Scene) -> None:
    with pytest.raises(SplashbenchError, match="has 5 training views, not 6"):
        nested_views(balls, 6)
    with pytest.raises(SplashbenchError, match="no 2 training views have every test view between"):
        # Test views 6 and 7 stand between 1 and 2 and between 3 and 4: without camera 1 nothing is left of 6.
        nested_views(_Without(balls, "4", "5"), 2)
    with pytest.raises(SplashbenchError, match="no training view '9'; it has 1, 2, 3, 4, 5"):
        changes(balls, StudyVariant(name="v", train_views=("1", "9")), 0)


def test_of_cameras_that_matter_equally_little_the_last_is_dropped(balls: Scene) -> None:
    scene = _Without(balls)
    scene.test = ("6",)  # between 1 and 2: none of 3, 4 and 5 narrows its gap
    assert nested_views(scene, 4) == ("1", "2", "3", "4")
    assert nested_views(scene, 2) == ("1", "2")


class _Without:
    """A scene that has some training views less."""

    def __init__(self, scene: Scene, *gone: str) -> None:
        self.directory, self.gravity, self.test = scene.directory, scene.gravity, scene.test
        self.train = tuple(name for name in scene.train if name not in gone)
        self.cameras = {name: camera for name, camera in scene.cameras.items() if name not in gone}

"""The upright vessel that the footage shows where the liquid is, without mesh and masks."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import trimesh
from scipy import ndimage

from splashbench.background.clean_plate import make_clean_plates
from splashbench.background.support import find_support
from splashbench.container import footage_vessel
from splashbench.container.footage_vessel import Standing, standing_about_liquid, standing_roughly
from splashbench.container.pool_vessel import pool_views
from splashbench.container.standing import ContainerView, place_about_liquid
from splashbench.container.verification import silhouette
from splashbench.harness.contract import Run
from splashbench.scene import Scene
from splashbench.scene.container import ContainerMesh
from splashbench_methods.splashsplat.fields.observations import observe
from splashbench_methods.splashsplat.settings import SplashSplatConfig

from .painted import bowl, tank, write_glass_scene, write_painted_scene

UP = np.array([0.0, 1.0, 0.0])
SPECKLED = np.random.default_rng(0).uniform(40, 220, (48, 48, 48, 3))


def trough() -> ContainerMesh:
    """A box 60 by 40 cm, and 24 cm high, that stands turned on the floor."""
    body = trimesh.creation.box((0.6, 0.24, 0.4), trimesh.transformations.rotation_matrix(0.5, UP))
    return ContainerMesh(body.vertices + np.array([0, 0.12, 0]), body.faces)


def standing(directory: Path) -> Standing:
    scene = Scene.open(directory).training()
    return standing_about_liquid(scene, make_clean_plates(scene))


def covers(found: Standing, mesh: ContainerMesh, directory: Path) -> list[float]:
    """Overlap of the silhouettes that were found with the true ones, of all cameras."""
    assert found.vessel is not None
    cameras = list(Scene.open(directory).cameras.values())
    masks = found.vessel.masks(cameras)
    true = {camera.name: silhouette(mesh, np.eye(4), camera) for camera in cameras}
    return [float((masks[name] & true[name]).sum() / (masks[name] | true[name]).sum()) for name in true]


@pytest.fixture(scope="module")
def speckled(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_painted_scene(tmp_path_factory.mktemp("speckled") / "scene", SPECKLED, masked=False)


def test_a_bowl_is_found_on_the_floor(speckled: Path) -> None:
    found, again = standing(speckled), standing(speckled)
    assert found.support is not None
    assert np.rad2deg(np.arccos(found.support.normal @ UP)) < 0.1
    assert abs(found.support.offset) < 0.001
    assert found.vessel is not None
    assert found.vessel.trusted
    assert np.ptp(found.vessel.rim[:, [0, 2]], axis=0) == pytest.approx([0.7, 0.7], abs=0.02)
    assert found.vessel.rim[:, 1] == pytest.approx(0.28, abs=0.01)
    assert min(covers(found, bowl(), speckled)) > 0.975
    assert again.vessel is not None
    np.testing.assert_array_equal(again.vessel.mesh.vertices, found.vessel.mesh.vertices)


def test_a_rough_one_is_there_before_edges_are_looked_at(speckled: Path) -> None:
    scene = Scene.open(speckled).training()
    roughly = standing_roughly(scene, make_clean_plates(scene))
    assert roughly.support is not None
    assert np.rad2deg(np.arccos(roughly.support.normal @ UP)) < 1
    assert roughly.vessel is not None
    assert roughly.vessel.trusted
    # Nothing was chosen on this scene: without what is taken off for plain bowls it would be .85.
    assert min(covers(roughly, bowl(), speckled)) > 0.75


@pytest.mark.parametrize("told", [pytest.param(False, marks=pytest.mark.slow), True])
def test_pixels_that_other_views_contradict_have_no_say(
    speckled: Path, told: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    """As beside a bowl in narrow images, where no other view shows the floor: a rim of wrong depths."""
    scene = Scene.open(speckled).training()
    plates = make_clean_plates(scene)
    place, views = place_about_liquid(scene, plates)

    def with_rim(view: ContainerView) -> ContainerView:
        shown = view.says > 0
        rim = (ndimage.binary_dilation(shown, iterations=9) & ~shown).astype(bool)
        says = np.where(rim, np.int8(1), view.says)
        points = np.empty((*says.shape, 3))
        points[shown], points[rim] = view.points, view.points.mean(axis=0)
        return replace(view, says=says, points=points[says > 0], doubtful=rim if told else np.zeros_like(rim))

    wrong = [with_rim(view) for view in views]
    monkeypatch.setattr(footage_vessel, "place_about_liquid", lambda *_: (place, wrong))
    found = standing_about_liquid(scene, plates)
    assert found.vessel is not None
    assert found.vessel.trusted is told
    if told:
        assert min(covers(found, bowl(), speckled)) > 0.975
    roughly = standing_roughly(scene, plates)
    assert (min(covers(roughly, bowl(), speckled)) > 0.85) is told


@pytest.mark.slow
def test_a_box_is_found_too(tmp_path: Path) -> None:
    directory = write_painted_scene(tmp_path / "scene", SPECKLED, trough(), masked=False)
    found = standing(directory)
    assert found.vessel is not None
    assert found.vessel.trusted
    assert min(covers(found, trough(), directory)) > 0.9


def test_what_holds_no_liquid_or_shows_no_depth_is_no_container(balls_directory: Path, tmp_path: Path) -> None:
    plain = write_painted_scene(tmp_path / "scene", None, masked=False)
    beside = ContainerMesh(bowl().vertices * 0.5 + [0.9, 0, -0.4], bowl().faces)
    other = write_painted_scene(tmp_path / "beside", SPECKLED, beside, masked=False)
    for directory in (balls_directory, plain, other):
        found = standing(directory)
        assert found.support is not None
        assert np.rad2deg(np.arccos(found.support.normal @ UP)) < 0.2
        assert found.vessel is None or not found.vessel.trusted, directory


@pytest.mark.slow
def test_glass_is_found_about_liquid_that_rests_in_it(tmp_path: Path) -> None:
    directory = write_glass_scene(tmp_path / "glass")
    found = standing(directory)
    assert found.vessel is not None
    assert found.vessel.trusted
    assert found.vessel.seen_through
    assert min(covers(found, tank(), directory)) > 0.93
    run = Run()
    config = SplashSplatConfig.model_validate({"hull_cells": 32, "transport_cells": 16})
    observed = observe(Scene.open(directory).training(), config.fields, run, lambda done, what: None)
    assert observed.in_transparent_container
    assert run.notes["container"].endswith("transparent")
    # Nothing rests in masks that images cut off, in one view, or in six frames, of which three are later ones.
    scene = Scene.open(directory).training()
    plates = make_clean_plates(scene)
    place, _ = place_about_liquid(scene, plates)
    assert place is not None
    rests = {name: scene.mask(name, 7) for name in scene.train}
    seen: dict[str, Callable[[str], np.ndarray]] = {
        "as it is": lambda name: rests[name],
        "cut off": lambda name: rests[name] | (np.arange(240) < 120),
        "in one view": lambda name: rests[name] & (name == "1"),
    }
    for what, mask in seen.items():
        masked = Scene.open(directory).training()
        masked.mask = lambda name, t, mask=mask: mask(name)  # type: ignore[misc, method-assign]
        assert bool(pool_views(masked, place, plates)) == (what == "as it is"), what
    brief = Scene.open(directory).training()
    brief.n_frames = 6  # type: ignore[misc]
    brief.mask = lambda name, t: rests[name]  # type: ignore[method-assign]
    assert pool_views(brief, place, plates) == []


@pytest.mark.slow
def test_a_puddle_has_no_glass_about_it(tmp_path: Path) -> None:
    scene = Scene.open(write_glass_scene(tmp_path / "puddle", edges=False)).training()
    plates = make_clean_plates(scene)
    found = standing_about_liquid(scene, plates).vessel
    assert found is not None
    assert "as liquid are none about it" in found.doubt
    # Wet floor is darker: there are edges, and they end where the liquid does.
    rests = {name: scene.mask(name, 7) for name in scene.train}
    scene.mask = lambda name, t: rests[name]  # type: ignore[method-assign]
    wet = {
        name: replace(plate, image=np.where(rests[name][..., None], plate.image * 0.7, plate.image).astype(np.uint8))
        for name, plate in plates.items()
    }
    found = standing_about_liquid(scene, wet).vessel
    assert found is not None
    assert "end where it does" in found.doubt


def test_without_liquid_or_with_one_camera_there_is_nothing_to_look_for(balls_directory: Path) -> None:
    scene = Scene.open(balls_directory).training()
    plates = make_clean_plates(scene)
    dry = Scene.open(balls_directory).training()
    dry.mask = lambda camera, t: np.zeros_like(scene.mask(camera, t))  # type: ignore[method-assign]
    found = standing_about_liquid(dry, plates)
    assert (found.support, found.vessel) == (None, None)
    roughly = standing_roughly(dry, plates)
    assert (roughly.support, roughly.vessel) == (None, None)
    alone = Scene.open(balls_directory).training()
    alone.train = scene.train[:1]  # type: ignore[misc]
    found = standing_about_liquid(alone, plates)
    assert (found.support, found.vessel) == (None, None)


@pytest.mark.slow
def test_gravity_that_is_stated_and_masks_that_failed(speckled: Path) -> None:
    scene = Scene.open(speckled).training()
    plates = make_clean_plates(scene)
    place, views = place_about_liquid(scene, plates)
    assert place is not None
    assert len(views) == len(scene.train)
    # In one frame a camera takes a corner of its image for liquid.
    corner = np.zeros_like(scene.mask("1", 0))
    corner[:80, :120] = True
    failed = Scene.open(speckled).training()
    failed.mask = lambda camera, t: corner if (camera, t) == ("1", 0) else scene.mask(camera, t)  # type: ignore[method-assign]
    moved, _ = place_about_liquid(failed, plates)
    assert moved is not None
    # Liquid moves by as much from frame to frame; by all pixels alike it would be .13 away.
    assert np.linalg.norm(moved.origin - place.origin) < 0.03
    # A surface that is not level is none that things stand on.
    for up, found in (([0.0, 1.0, 0.0], True), ([0.5, 0.866, 0.0], False)):
        stated = Scene.open(speckled).training()
        stated.gravity = -np.array(up)  # type: ignore[misc]
        assert (place_about_liquid(stated, plates)[0] is not None) == found


def test_the_support_is_where_the_most_points_lie_below_the_cameras() -> None:
    rng = np.random.default_rng(3)
    tilted = np.array([0.1, 0.99, -0.05])
    tilted /= np.linalg.norm(tilted)
    floor = rng.uniform(-1, 1, (3000, 3))
    floor -= np.outer(floor @ tilted + 0.2, tilted)
    wall = rng.uniform(-1, 1, (6000, 3)) * [1, 1, 0] + [0, 0, -1]
    points = np.concatenate([floor + rng.normal(0, 0.001, floor.shape), wall, rng.uniform(-1, 1, (1000, 3))])
    cameras = rng.uniform(-0.5, 0.5, (5, 3)) + np.array([0, 1.5, 2])
    found = find_support(points, cameras, UP, 60, 0.004)
    assert found is not None
    assert np.rad2deg(np.arccos(found.normal @ tilted)) < 0.1
    assert found.offset == pytest.approx(-0.2, abs=0.001)
    assert found.share == pytest.approx(0.3, abs=0.02)
    assert found.heights(cameras).min() > 0
    assert find_support(points, cameras - [0, 5, 0], UP, 60, 0.004) is None
    assert find_support(points[:50], cameras, UP, 60, 0.004) is None
    unknown = np.concatenate([points, np.full((100, 3), np.nan)])
    again = find_support(unknown, cameras, UP, 60, 0.004)
    assert again is not None
    assert again.normal == pytest.approx(found.normal, abs=1e-3)
    assert find_support(points, cameras, tilted + np.array([1.0, 0, 0]), 10, 0.004) is None
    assert find_support(points, cameras, np.zeros(3), 60, 0.004) is None
    assert find_support(np.zeros((500, 3)), cameras, UP, 60, 0.004) is None


def test_splashsplat_looks_for_the_container_in_the_footage(speckled: Path) -> None:
    def observed(**settings: Any) -> Run:
        run = Run()
        config = SplashSplatConfig.model_validate({"hull_cells": 32, "transport_cells": 16, **settings})
        observe(Scene.open(speckled).training(), config.fields, run, lambda done, what: None)
        return run

    run = observed()
    assert "clean plates" in run.notes["container"]
    assert "surface that things stand on" in run.notes["gravity"]
    assert observed(container_footage=False).notes["container"] == "not known"

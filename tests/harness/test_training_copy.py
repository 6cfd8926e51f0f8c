"""The copy of a scene that a method is given: the training views, and nothing that tells the truth."""

import os
from pathlib import Path

from splashbench.files import read_json, write_json
from splashbench.harness.training_copy import make_training_copy
from splashbench.scene import Scene


def test_a_copy_leads_to_no_test_view_no_truth_and_not_to_where_the_scene_came_from(
    balls_copy: Path, tmp_path: Path
) -> None:
    meta = read_json(balls_copy / "scene.json")
    write_json(balls_copy / "scene.json", meta | {"provenance": {"particle_radius": 0.01, "source": "a recipe"}})
    scene = Scene.open(balls_copy)
    assert scene.meta is not None
    assert scene.meta.provenance
    copy = make_training_copy(scene, tmp_path / "copy")
    targets = {os.path.realpath(Path(root, name)) for root, _, names in os.walk(copy) for name in names}
    originals = {Path(path).relative_to(balls_copy.resolve()) for path in targets if str(balls_copy.resolve()) in path}
    assert {path.parts[1] for path in originals if path.parts[0] in ("ims", "seg")} == set(scene.train)
    assert {path.parts[0] for path in originals} <= {"ims", "seg", "init_pt_cld.npz"}
    shown = Scene.open(copy).meta
    assert shown is not None
    assert shown.provenance == {}
    assert "a recipe" not in (copy / "scene.json").read_text()


def test_a_copy_has_sizes_and_times_of_the_test_views(balls: Scene, tmp_path: Path) -> None:
    training = Scene.open(make_training_copy(balls, tmp_path / "copy")).training()
    assert sorted(training.test_cameras) == sorted(balls.test)
    for name, camera in training.test_cameras.items():
        assert (camera.width, camera.height) == (balls.cameras[name].width, balls.cameras[name].height)
        assert training.camera_times[name].tolist() == balls.camera_times[name].tolist()

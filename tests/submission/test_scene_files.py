"""A submission that is scored against another scene, or another version of its own: the line says what is other."""

import json
from pathlib import Path

import pytest

from splashbench.errors import SplashbenchError
from splashbench.harness.oracle import write_oracle
from splashbench.scene import Scene
from splashbench.score.protocol import require_same_scene
from splashbench.submission import Submission


def _refusal(scene: Path, submission: Submission) -> str:
    with pytest.raises(SplashbenchError) as error:
        require_same_scene(Scene.open(scene), submission)
    return str(error.value)


def test_a_scene_that_changed_after_the_run_is_told_by_what_changed(balls_copy: Path, tmp_path: Path) -> None:
    submission = write_oracle(Scene.open(balls_copy), tmp_path / "out")
    require_same_scene(Scene.open(balls_copy), submission)
    path = balls_copy / "scene.json"
    before = path.read_text()
    meta = json.loads(before)
    path.write_text(json.dumps(meta | {"metres_per_unit": 0.123}))
    line = _refusal(balls_copy, submission)
    assert "another version of scene balls" in line
    assert "scene.json was changed, as `splashbench scene place-container` does, which comes before `run`" in line
    path.write_text(before)
    require_same_scene(Scene.open(balls_copy), submission)
    image = Scene.open(balls_copy).image_path("6", 0)
    image.write_bytes(Scene.open(balls_copy).image_path("6", 1).read_bytes())
    assert "its images or masks were changed" in _refusal(balls_copy, submission)


def test_an_older_submission_does_not_know_what_changed(balls_copy: Path, tmp_path: Path) -> None:
    submission = write_oracle(Scene.open(balls_copy), tmp_path / "out")
    (tmp_path / "out" / "scene_files.json").unlink()
    path = balls_copy / "scene.json"
    path.write_text(json.dumps(json.loads(path.read_text()) | {"metres_per_unit": 0.123}))
    assert "images, masks, cameras, times or scene.json have changed" in _refusal(balls_copy, submission)


def test_a_wrong_scene_is_named_beside_the_right_one(balls_copy: Path, balls: Scene, tmp_path: Path) -> None:
    submission = write_oracle(balls, tmp_path / "out")
    path = balls_copy / "scene.json"
    path.write_text(json.dumps(json.loads(path.read_text()) | {"name": "tank"}))
    line = _refusal(balls_copy, submission)
    assert f"{tmp_path / 'out'} of oracle is of scene balls, and {balls_copy} is scene tank" in line

"""The method in CONTRIBUTING.md, run as it stands: a guide that no longer works fails here."""

import inspect
import re
from pathlib import Path

import pytest

from splashbench.harness.runner import run_method
from splashbench.scene import Scene
from splashbench.submission import Status, check_submission
from splashbench_methods.hull_points import HullPoints

GUIDE = Path(__file__).parents[1] / "CONTRIBUTING.md"


def test_the_method_in_the_guide_runs_and_beats_its_own_background(
    balls_directory: Path, balls: Scene, tmp_path: Path
) -> None:
    if not GUIDE.is_file():
        pytest.skip("CONTRIBUTING.md is not beside the tests")
    blocks = re.findall(r"```python\n(.*?)```", GUIDE.read_text(encoding="utf-8"), re.DOTALL)
    assert len(blocks) == 1
    installed = Path(inspect.getfile(HullPoints))
    assert blocks[0] == installed.read_text(encoding="utf-8"), "the guide shows another file than methods/hull_points"
    method = tmp_path / "hull_points.py"
    method.write_text(blocks[0], encoding="utf-8")
    submission = run_method(f"{method}:HullPoints", balls_directory, tmp_path / "out", timing_frames=0)
    assert submission.status == Status.OK, submission.record
    assert check_submission(tmp_path / "out", balls) == []
    overlap = []
    for camera in balls.test:
        for t in range(balls.n_frames):
            mask, alpha = balls.mask(camera, t), submission.alpha(camera, t) > 0.5
            overlap.append((mask & alpha).sum() / max(1, (mask | alpha).sum()))
    assert sum(overlap) / len(overlap) > 0.5

"""Training views are rendered by a submission's model into a folder of their own; the submission does not change."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from splashbench.harness.runner import run_method
from splashbench.harness.training_renders import render_training_views
from splashbench.scene import Scene
from splashbench.submission import Status, Submission
from splashbench.submission.submission import Views


def test_the_views_that_were_asked_for_are_rendered(balls: Scene, tmp_path: Path) -> None:
    settings = {"points": 300, "cells": 24}
    submission = run_method("hull_points", balls.directory, tmp_path / "run", overrides=settings, timing_frames=0)
    out = tmp_path / "training"
    out.mkdir()
    outcome = render_training_views("hull_points", balls, submission, {"2": [0, 5], "4": [3]}, out)
    assert (outcome.status, outcome.render_fps) == (Status.OK, None)
    names = sorted(path.relative_to(out).as_posix() for path in out.rglob("*") if path.is_file())
    shown = ["2/000000.png", "2/000005.png", "4/000003.png"]
    assert names == [f"{kind}/{name}" for kind in ("alpha", "renders") for name in shown]
    # It is this view at this time: liquid is drawn where its mask is, more than where that of another time is.
    alpha = Views(out, submission.identity).alpha("2", 5)
    assert alpha[balls.mask("2", 5)].mean() > 2 * alpha[balls.mask("2", 0) & ~balls.mask("2", 5)].mean()
    # A changed submission would be refused.
    assert Submission.open(submission.directory).digest == submission.digest


def test_a_model_that_cannot_be_loaded_is_a_status(balls: Scene, tmp_path: Path) -> None:
    settings = {"points": 300, "cells": 24}
    submission = run_method("hull_points", balls.directory, tmp_path / "run", overrides=settings, timing_frames=0)
    np.savez(submission.directory / "model" / "model.npz")
    outcome = render_training_views("hull_points", balls, submission, {"2": [0]}, tmp_path)
    assert outcome.status == Status.CRASHED
    assert "positions" in outcome.reason

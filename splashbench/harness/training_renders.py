"""Renders of training views by a fitted model, to see how far its figures there are from those of test views.

They are made by the child process that renders test views, and kept outside the submission: no test score sees them.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

from splashbench.harness.leftovers import scratch_folder
from splashbench.harness.messages import Outcome, Request
from splashbench.harness.phases import run_phase
from splashbench.harness.training_copy import make_training_copy
from splashbench.scene import Scene
from splashbench.submission import Submission


def render_training_views(
    name: str,
    scene: Scene,
    submission: Submission,
    views: Mapping[str, Sequence[int]],
    out: Path,
    timeout_seconds: float | None = None,
) -> Outcome:
    """Render training views of `scene` by the model in `submission`, into the folder `out`, which exists.

    Args:
        name: of the method, as `run_method` takes it.
        submission: an `ok` one of a fit to all timesteps, that has its model.
        views: training camera -> timesteps.
        out: gets renders/<cam>/<frame>.png and alpha/<cam>/<frame>.png, as a submission has them.

    A method that fails gives an outcome with its status and reason.
    """
    identity = submission.identity
    with scratch_folder() as scratch:
        copy = make_training_copy(scene, scratch / "scene")
        request = Request(
            phase="render",
            method=name,
            scene=str(copy),
            preset=identity.preset,
            overrides={},  # of a fit; a model is loaded without them
            seed=identity.seed,
            device=identity.device,
            budget_seconds=timeout_seconds,
            scratch=str(scratch),
            model=str(submission.directory / "model"),
            output=str(out),
            progress=str(scratch / "progress"),
            timing_frames=0,
            exr=False,
            training_views={camera: list(steps) for camera, steps in views.items()},
        )
        label = f"{name.rpartition('/')[2][:24]}: training views"
        outcome, _ = run_phase(scratch, request, label, Scene.open(copy).training())
    return outcome

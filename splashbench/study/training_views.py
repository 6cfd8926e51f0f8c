"""How well a fitted model shows what it was fitted to: the figures of some training views, beside those of test views.

A method has seen these photographs, so that the figures say nothing of how good it is. Where they rise along a ladder
while those of test views fall, the model learns its photographs by heart.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
from pydantic import BaseModel, ConfigDict

from splashbench.harness.leftovers import scratch_folder
from splashbench.harness.training_renders import render_training_views
from splashbench.scene import Scene
from splashbench.score import PROTOCOL_V1
from splashbench.score.image.fidelity import outside_filled, psnr
from splashbench.score.image.lpips import Lpips, load_lpips
from splashbench.score.image.silhouette import iou
from splashbench.submission import Status, Submission
from splashbench.submission.submission import Views

#: Training views that are rendered, and timesteps between two of their renders: a tenth or less of what there is.
VIEWS, EVERY = 2, 5
#: What is scored, as of test views (docs/protocol.md).
TRAINING_METRICS = ("psnr", "lpips", "miou")


class TrainingScore(BaseModel):
    """Figures of training views.

    Attributes:
        status: ok, or how their rendering failed, with a `reason`.
        views: timesteps by camera.
        metrics: by name; a mean over frames, then views. Null where there is none.
    """

    model_config = ConfigDict(extra="forbid")
    status: str
    reason: str = ""
    views: dict[str, list[int]]
    metrics: dict[str, float | None] = {}


def chosen_views(scene: Scene) -> dict[str, list[int]]:
    """The training views that are scored, the same in every run: the first one and that in the middle of the list."""
    count = min(VIEWS, len(scene.train))
    names = [scene.train[len(scene.train) * k // count] for k in range(count)]
    return {name: list(range(0, scene.n_frames, EVERY)) for name in names}


def score_training_views(
    name: str, scene: Scene, submission: Submission, lpips_weights: Path | None, timeout_seconds: float | None = None
) -> TrainingScore:
    """Render and score training views of `scene` by the model in `submission` of the method `name`."""
    views = chosen_views(scene)
    lpips, _ = load_lpips(lpips_weights)
    with scratch_folder() as folder:
        outcome = render_training_views(name, scene, submission, views, folder, timeout_seconds)
        if outcome.status != Status.OK:
            return TrainingScore(status=outcome.status, reason=outcome.reason, views=views)
        renders = Views(folder, submission.identity)
        per_view = [[_frame(scene, renders, camera, t, lpips) for t in steps] for camera, steps in views.items()]
    means = {
        metric: _mean([_mean([row.get(metric) for row in rows]) for rows in per_view]) for metric in TRAINING_METRICS
    }
    return TrainingScore(status="ok", views=views, metrics=means)


def _frame(scene: Scene, renders: Views, camera: str, t: int, lpips: Lpips | None) -> dict[str, float]:
    """As `score.image.views` scores a frame of a test view; too little liquid has a mIoU alone."""
    protocol = PROTOCOL_V1
    truth, mask = scene.image(camera, t) / 255.0, scene.mask(camera, t)
    row = {"miou": iou(renders.alpha(camera, t), mask, protocol.opacity_threshold)}
    if int(np.count_nonzero(mask)) < protocol.min_mask_pixels:
        return row
    render = renders.rendering(camera, t) / 255.0
    row["psnr"] = psnr(render, truth, mask, protocol.psnr_cap_db)
    if lpips is not None:
        shown, true = (outside_filled(image, truth, mask, protocol.outside_mask) for image in (render, truth))
        row["lpips"] = lpips(shown, true)
    return row


def _mean(values: list[float | None]) -> float | None:
    there = [value for value in values if value is not None]
    return float(np.mean(there)) if there else None

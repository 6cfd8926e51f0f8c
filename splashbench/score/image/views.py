"""The image metrics of a submission: test views only, one frame in memory at a time.

Ground truth comes from the scene and from nowhere else.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from typing import Any

import numpy as np
from numpy.typing import NDArray

from splashbench.errors import SplashbenchError
from splashbench.scene import Camera, Scene
from splashbench.score.image.fidelity import Image, outside_filled, psnr, ssim
from splashbench.score.image.jitter import JitterError
from splashbench.score.image.lpips import Lpips
from splashbench.score.image.silhouette import iou, spill, spill_rgb
from splashbench.score.result import MetricValue, ViewValues, mean, metric_value
from splashbench.score.settings import Protocol
from splashbench.submission.withheld import scored_timesteps

Track = Callable[[Iterable[int], str], Iterator[int]]

_PER_FRAME = ("psnr", "dpsnr_bg", "ssim", "ssim_fg", "lpips", "spill", "spill_rgb", "miou")
_NEEDS_REFERENCE = ("dpsnr_bg", "spill_rgb")
_NO_REFERENCE = "needs the control `nothing` of this scene: score with --reference SUBMISSION"


def score_views(
    scene: Scene,
    submission: Any,
    reference: Any | None,
    lpips: Lpips | None,
    no_lpips: str,
    protocol: Protocol,
    track: Track,
) -> dict[str, MetricValue]:
    """Every image metric, averaged over frames, then over the test views.

    Args:
        submission, reference: give `rendering(camera, t)` and `alpha(camera, t)`; reference is the control `nothing`.
        lpips: the metric, or None for the reason `no_lpips`.

    Of a submission with withheld timesteps, only those are scored; the jitter error covers the whole sequence.
    """
    scored = set(scored_timesteps(scene.n_frames, submission.identity.withheld))
    per_view: dict[str, dict[str, list[float | None]]] = {name: {} for name in _PER_FRAME}
    jitter: dict[str, float | None] = {}
    for camera in scene.test:
        rows: list[dict[str, float]] = []
        jitter_error = JitterError()
        for t in track(range(scene.n_frames), f"scoring view {camera}"):
            rows.append(_score_frame(scene, submission, reference, lpips, protocol, camera, t, jitter_error))
        for name in _PER_FRAME:
            per_view[name][camera] = [row.get(name) if t in scored else None for t, row in enumerate(rows)]
        jitter[camera] = jitter_error.value()
    too_small = f"no test view has a frame with {protocol.min_mask_pixels} mask pixels"
    left_out = (scene.n_frames - len(scored)) * len(scene.test)
    values = {name: _averaged(name, views, too_small, left_out) for name, views in per_view.items()}
    values["jitter_error"] = _jitter_value(jitter)
    if reference is None:
        values |= {name: metric_value(name, None, _NO_REFERENCE) for name in _NEEDS_REFERENCE}
    if lpips is None:
        values["lpips"] = metric_value("lpips", None, no_lpips)
    return values


def _score_frame(
    scene: Scene,
    submission: Any,
    reference: Any | None,
    lpips: Lpips | None,
    protocol: Protocol,
    name: str,
    t: int,
    jitter_error: JitterError,
) -> dict[str, float]:
    """The metrics of one frame, without those that need more liquid than it shows."""
    camera = scene.cameras[name]
    truth, mask = _unit(scene.image(name, t)), scene.mask(name, t)
    render = _unit(_checked(submission.rendering(name, t), camera, t, "rendering"))
    alpha = _checked(submission.alpha(name, t), camera, t, "alpha")
    jitter_error.add(render, truth, mask)
    row = {"miou": iou(alpha, mask, protocol.opacity_threshold)}
    if int(np.count_nonzero(mask)) < protocol.min_mask_pixels:
        return row
    row["psnr"] = psnr(render, truth, mask, protocol.psnr_cap_db)
    row["spill"] = spill(alpha, mask)
    if reference is not None:
        nothing = _unit(_checked(reference.rendering(name, t), camera, t, "rendering of the reference"))
        row["dpsnr_bg"] = row["psnr"] - psnr(nothing, truth, mask, protocol.psnr_cap_db)
        row["spill_rgb"] = spill_rgb(render, nothing, mask)
        del nothing  # 200 MB at 4K, as each of the images below
    masked_render = outside_filled(render, truth, mask, protocol.outside_mask)
    masked_truth = outside_filled(truth, truth, mask, protocol.outside_mask)
    try:
        row["ssim"], row["ssim_fg"] = ssim(masked_render, masked_truth, mask, protocol.ssim_sigma)
    except ValueError as error:
        raise SplashbenchError(f"{scene.image_path(name, t)}: {error}; such a view cannot be scored") from None
    if lpips is not None:
        row["lpips"] = lpips(masked_render, masked_truth)
    return row


def _unit(image: NDArray[np.uint8]) -> Image:
    return image.astype(np.float64) / 255.0


def _checked(array: NDArray, camera: Camera, t: int, what: str) -> NDArray:
    """`array` if it has the camera's size and, unless 8-bit, values in [0, 1]. Raises SplashbenchError else."""
    size = (camera.height, camera.width)
    expected = size if what == "alpha" else (*size, 3)
    if array.shape != expected:
        raise SplashbenchError(
            f"{what} of camera {camera.name}, frame {t} is {'x'.join(map(str, array.shape))}, not "
            f"{'x'.join(map(str, expected))}; look the submission over with `splashbench check`"
        )
    if array.dtype != np.uint8 and not (array.min() >= 0 and array.max() <= 1):
        raise SplashbenchError(f"{what} of camera {camera.name}, frame {t} leaves [0, 1]; write the submission again")
    return array


def _averaged(name: str, views: dict[str, list[float | None]], reason: str, left_out: int) -> MetricValue:
    """Mean over each view's frames that have a value, then over the views that have one.

    left_out: number of (frame, view) pairs that are not to be scored; they do not count as skipped.
    """
    detailed = {camera: ViewValues(value=mean(frames), frames=tuple(frames)) for camera, frames in views.items()}
    skipped = sum(frame is None for frames in views.values() for frame in frames) - left_out
    value = mean([view.value for view in detailed.values()])
    return metric_value(name, value, reason, skipped_frames=skipped, views=detailed)


def _jitter_value(jitter: dict[str, float | None]) -> MetricValue:
    views = {camera: ViewValues(value=value) for camera, value in jitter.items()}
    return metric_value(
        "jitter_error", mean(list(jitter.values())), "no test view has two frames with liquid", views=views
    )

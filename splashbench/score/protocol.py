"""Scoring: Submission -> Result by one fixed protocol (paper, "Metrics"; every choice: docs/protocol.md).

Ground truth comes from the scene alone: images of test views, geometry from training masks. The true particles of a
synthetic scene give metrics of their own.
"""

from __future__ import annotations

import math
import platform
from collections.abc import Callable, Iterable, Iterator
from contextlib import suppress
from importlib import metadata
from pathlib import Path
from typing import Any

from splashbench import progress
from splashbench.errors import SplashbenchError
from splashbench.scene import Scene
from splashbench.score.image.lpips import load_lpips
from splashbench.score.image.views import Track, score_views
from splashbench.score.metrics import METRICS
from splashbench.score.particles.physics import liquid_particles, score_particles
from splashbench.score.particles.uniformity import DistanceFields
from splashbench.score.result import CheckpointScore, Digests, MetricValue, Result, metric_value
from splashbench.score.settings import PROTOCOL_V1, Protocol
from splashbench.score.truth.comparison import score_ground_truth
from splashbench.submission.scene_files import mismatch
from splashbench.version import __version__

REFERENCE_METHOD = "nothing"
MIN_TIMED_FRAMES = 100
_OK = "ok"


def score_submission(
    scene: Scene,
    submission: Any,
    reference: Any | None = None,
    lpips_weights: Path | None = None,
    track: Track = progress.track,
    *,
    protocol: Protocol = PROTOCOL_V1,
    fields: Callable[[], DistanceFields] | None = None,
) -> Result:
    """Score one verified submission (`splashbench.submission.Submission`) of `scene`.

    Args:
        reference: the submission of the control `nothing` on this scene; metrics that need it are null without it.
        lpips_weights: an .npz of LPIPS weights, see `splashbench.score.image.lpips.load_lpips`.
        track: wraps an iterable with a description, to show progress.
        protocol: other settings than v1's make a result that no table mixes with v1.
        fields: signed distance from the training masks when several submissions share it, see `shared_fields`.

    Raises SplashbenchError when the submission or the reference is of another scene, or has changed since its check.
    A submission that is not "ok" gives a result with that status and reason, and no score.
    """
    identity = submission.identity
    require_same_scene(scene, submission, "submission")
    if reference is not None:
        require_reference(scene, reference)
    status = _text(submission.status)
    metrics = _costs(submission.record)
    weights_digest = None
    checkpoints: tuple[CheckpointScore, ...] = ()
    if status == _OK:
        lpips, no_lpips = load_lpips(lpips_weights)
        weights_digest = lpips.digest if lpips else None

        def images(views: Any, track: Track) -> dict[str, MetricValue]:
            return score_views(scene, views, reference, lpips, no_lpips, protocol, track)

        metrics |= images(submission, track)
        checkpoints = _score_checkpoints(submission, images, track)
        fields = fields or shared_fields(scene, protocol)
        particles, no_particles = liquid_particles(scene, submission)
        metrics |= score_particles(scene, particles, no_particles, fields, protocol, track)
        metrics |= score_ground_truth(scene, submission, particles, no_particles, fields, protocol, track)
    else:
        no_score = f"the run ended with status {status}"
        metrics |= {name: metric_value(name, None, no_score) for name, m in METRICS.items() if m.group != "cost"}
    return Result(
        method=identity.method,
        method_version=identity.method_version,
        scene=scene.name,
        seed=identity.seed,
        preset=identity.preset,
        settings=identity.settings,
        overrides=tuple(identity.overrides),
        # Container masks and the like may have come after the run: no file that the scene's digest is of.
        told=scene.stated if identity.told is None else identity.told,
        control=identity.control,
        mixed=identity.mixed,
        withheld=identity.withheld,
        status=status,
        reason=submission.reason,
        protocol=protocol,
        digests=Digests(
            scene=scene.digest,
            submission=submission.digest,
            protocol=protocol.digest,
            reference=reference.digest if reference is not None else None,
            lpips_weights=weights_digest,
            truth=scene.truth_digest,
        ),
        metrics={name: metrics[name] for name in METRICS},
        checkpoints=checkpoints,
        stages=dict(submission.record.stages),
        notes=dict(submission.record.notes),
        decisions=list(submission.record.decisions),
        claimed={name: value for name, value in identity.claimed.items() if math.isfinite(value)},
        hardware=identity.hardware,
        times_source=scene.times_source,
        versions=_versions(),
    )


def _score_checkpoints(
    submission: Any, score: Callable[[Any, Track], dict[str, MetricValue]], track: Track
) -> tuple[CheckpointScore, ...]:
    """The image metrics of every state of the fit that was kept, in the order of time; `score` gives those of views."""
    if not submission.record.checkpoints:
        return ()
    views = {checkpoint.folder: of for checkpoint, of in submission.checkpoints()}
    scores = []
    for checkpoint in submission.record.checkpoints:
        figures: dict[str, float | None] = {}
        if checkpoint.folder in views:
            moment = f"after {checkpoint.seconds:.0f} s, "

            def told(steps: Iterable[int], what: str, moment: str = moment) -> Iterator[int]:
                return track(steps, moment + what)

            figures = {name: value.value for name, value in score(views[checkpoint.folder], told).items()}
        scores.append(
            CheckpointScore(
                seconds=checkpoint.seconds,
                status=_text(checkpoint.status),
                reason=checkpoint.reason,
                storage_bytes=checkpoint.storage_bytes,
                metrics=figures,
            )
        )
    return tuple(scores)


def shared_fields(scene: Scene, protocol: Protocol = PROTOCOL_V1) -> Callable[[], DistanceFields]:
    """A function giving the scene's signed distance fields: computed at the first call, from training masks alone."""
    computed: list[DistanceFields] = []

    def fields() -> DistanceFields:
        if not computed:
            from splashbench.observe import signed_distance_fields

            computed.append(signed_distance_fields(scene.training(), cells_longest_axis=protocol.grid_cells))
        return computed[0]

    return fields


def _text(status: Any) -> str:
    return str(getattr(status, "value", status))


def require_same_scene(scene: Scene, submission: Any, what: str = "submission") -> None:
    """Raise SplashbenchError unless `submission` was made for these very bytes of `scene`."""
    if submission.identity.scene_digest != scene.digest:
        raise SplashbenchError(mismatch(scene, submission, what))


def require_reference(scene: Scene, reference: Any) -> None:
    """Raise SplashbenchError unless `reference` is a finished submission of the control `nothing` for `scene`."""
    if reference.identity.method != REFERENCE_METHOD or not reference.identity.control:
        raise SplashbenchError(
            f"the reference is a submission of {reference.identity.method}; give one of the control {REFERENCE_METHOD}"
        )
    if _text(reference.status) != _OK:
        raise SplashbenchError(
            f"the reference ended with status {_text(reference.status)}; run {REFERENCE_METHOD} again"
        )
    require_same_scene(scene, reference, "reference")


def require_complete(scene: Scene, submission: Any) -> None:
    """Raise SplashbenchError unless `submission` is a finished one for `scene`, fitted to all of its timesteps."""
    require_same_scene(scene, submission)
    status = _text(submission.status)
    if status != _OK:
        raise SplashbenchError(f"{submission.directory}: the run ended with status {status}; run it again")
    if submission.identity.withheld is not None:
        raise SplashbenchError(f"{submission.directory} has withheld timesteps; give one without")


def _costs(record: Any) -> dict[str, MetricValue]:
    """What the harness measured, never what the method claims. A frame rate needs MIN_TIMED_FRAMES frames."""
    costs = {
        name: metric_value(name, _number(getattr(record, name)), "not measured")
        for name, metric in METRICS.items()
        if metric.group == "cost"
    }
    n_timed = getattr(record, "timed_frames", None)
    if n_timed is not None and n_timed < MIN_TIMED_FRAMES:
        reason = f"only {n_timed} frames were timed, not {MIN_TIMED_FRAMES}"
        costs["render_fps"] = metric_value("render_fps", None, reason)
    return costs


def _number(value: float | None) -> float | None:
    return None if value is None else float(value)


def _versions() -> dict[str, str]:
    """The software the figures depend on; PyTorch only where it is there, since LPIPS alone needs it."""
    versions = {"splashbench": __version__, "python": platform.python_version()}
    for name in ("numpy", "scipy", "torch"):
        with suppress(metadata.PackageNotFoundError):
            versions[name] = metadata.version(name)
    return versions

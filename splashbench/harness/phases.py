"""The phases of a run, each in a process of its own: fit, render, and the states of the fit on its way.

Here the run is measured: by the keeper's stamps, and by the files that are there once a phase's process is gone.
"""

from __future__ import annotations

import shutil
from itertools import islice
from pathlib import Path

from pydantic import ValidationError

from splashbench.child import child_command, raise_if_disk_was_full
from splashbench.errors import one_line
from splashbench.files import remove_any, tree_bytes, write_model
from splashbench.harness import keeper
from splashbench.harness.clock import FitTime, Report, fit_time, frames_per_second, state_seconds
from splashbench.harness.messages import Failure, Outcome, Request
from splashbench.harness.method_process import WARM_UP_FRAMES, requested_views
from splashbench.harness.outputs import require_liquid, require_views, tree_digest
from splashbench.harness.watched_process import Watched, watch
from splashbench.scene import Particles, Scene, TrainingScene
from splashbench.submission import Checkpoint, Record, Status
from splashbench.submission.identity import MAX_CHECKPOINTS, MAX_NOTES
from splashbench.submission.submission import unusable_files


def run_phases(scratch: Path, staging: Path, request: Request) -> Record:
    """Fit and render as `request` says, and measure both; the renders lie in `staging` then.

    A method that fails gives a record with its status and reason.
    """
    record = Record()
    # Before the method runs, which could change its copy of the scene.
    training = Scene.open(Path(request.scene)).training()
    outcome, watched = run_phase(scratch, request, _label(request, "fit"), training)
    record = _with_resources(record, outcome, watched)
    if outcome.status != Status.OK:
        return _failed(record, outcome, watched)
    model = Path(request.model)
    faults = ["it is a link"] if model.is_symlink() else unusable_files(model)
    if faults:
        reason = one_line(f"what the method saved is no model: {faults[0]}").replace(f"{model}/", "model/")
        return _failed(record, Outcome(status=Status.CRASHED, reason=reason), watched)
    storage = tree_bytes(model)
    time = _fit_time(watched, storage)
    if time is not None and len(time.states) > _states_saved(request):
        # Pauses that nobody asked for, or in which nothing was saved, are the fit's own time.
        time = FitTime(time.seconds + time.paused, [], 0.0)
    if time is None:
        reason = "the fit's process ended before the harness's own code in it had come to its end"
        return _failed(record, Outcome(status=Status.CRASHED, reason=reason), watched)
    # In a study, parts of the fit come from earlier runs; what they took there counts, and fetching them does not.
    shared = request.cache is not None
    reused = outcome.reused if shared else {}
    seconds = max(0.0, time.seconds - outcome.overhead_seconds) + sum(reused.values()) if shared else time.seconds
    record = record.model_copy(
        update={
            "fit_seconds": seconds,
            "reused": reused,
            "stages": outcome.stages,
            "notes": outcome.notes,
            "decisions": outcome.decisions,
            "checkpoint_seconds": time.paused if request.checkpoints else None,
            "storage_bytes": storage,
            "dynamic_bytes": storage - tree_bytes(model / "static"),
        }
    )
    states = state_seconds(outcome.checkpoints, time.states)[:MAX_CHECKPOINTS] if request.checkpoints else []
    # What the fit left in its scratch folder is no part of the model, whose bytes are counted.
    _empty(Path(request.scratch))
    saved = tree_digest(model)
    rendering = request.model_copy(update={"phase": "render"})
    outcome, watched = run_phase(scratch, rendering, _label(request, "render"), training)
    record = _with_resources(record, outcome, watched)
    if outcome.status != Status.OK:
        return _failed(record, outcome, watched)
    checkpoints = [_checkpoint(scratch, staging, rendering, training, k, of_fit) for k, of_fit in enumerate(states)]
    if tree_digest(model) != saved:
        reason = "the model was changed while it was rendered"
        return _failed(record, Outcome(status=Status.CRASHED, reason=reason), watched)
    faults = unusable_files(staging)
    if faults:
        reason = one_line(f"what the method wrote is no submission: {faults[0]}").replace(f"{staging}/", "")
        return _failed(record, Outcome(status=Status.CRASHED, reason=reason), watched)
    # The harness's own come first: a fit may have made as many notes as there may be, and under any name.
    return record.model_copy(
        update={
            "notes": dict(islice((outcome.notes | record.notes | outcome.notes).items(), MAX_NOTES)),
            "checkpoints": checkpoints,
            "render_fps": outcome.render_fps,
            "timed_frames": request.timing_frames,
            "primitives_per_frame": outcome.primitives_per_frame,
            "particles_per_frame": particles_per_frame(staging),
        }
    )


def _label(request: Request, what: str) -> str:
    return f"{request.method.rpartition('/')[2][:24]}: {what}"


def _with_resources(record: Record, outcome: Outcome, watched: Watched) -> Record:
    device_peak = record.peak_device_memory_bytes
    if outcome.peak_device_memory_bytes is not None:
        device_peak = max(device_peak or 0, outcome.peak_device_memory_bytes)
    return record.model_copy(
        update={
            "peak_memory_bytes": max(record.peak_memory_bytes or 0, watched.peak_memory_bytes),
            "peak_device_memory_bytes": device_peak,
            "renderer": sorted({*record.renderer, *outcome.renderer}),
        }
    )


def _failed(record: Record, outcome: Outcome, watched: Watched) -> Record:
    return record.model_copy(update={"status": outcome.status, "reason": outcome.reason, "log_tail": watched.log_tail})


def _fit_time(watched: Watched, storage_bytes: int) -> FitTime | None:
    return None if watched.report is None else fit_time(Report.model_validate(watched.report), storage_bytes)


def _states_saved(request: Request) -> int:
    """How many states of the fit were saved on its way."""
    return 0 if request.checkpoints is None else sum(path.is_dir() for path in Path(request.checkpoints).iterdir())


def _checkpoint(
    scratch: Path, staging: Path, request: Request, training: TrainingScene, number: int, seconds: float
) -> Checkpoint:
    """Render the test views by the state that the fit had after `seconds`; its model is removed then."""
    name = f"{number:02d}"
    model, folder = Path(str(request.checkpoints), name), f"checkpoints/{name}"
    (staging / folder).mkdir(parents=True, exist_ok=True)
    changes = {"model": str(model), "output": str(staging / folder), "timing_frames": 0}
    only_views = request.model_copy(update={**changes, "exr": False, "only_views": True})
    outcome, _ = run_phase(scratch, only_views, _label(request, f"after {seconds:.0f} s"), training)
    storage = tree_bytes(model)
    dynamic = storage - tree_bytes(model / "static")
    shutil.rmtree(model, ignore_errors=True)
    if outcome.status != Status.OK:
        shutil.rmtree(staging / folder, ignore_errors=True)
    return Checkpoint(
        seconds=seconds,
        folder=folder,
        status=outcome.status,
        reason=outcome.reason,
        storage_bytes=storage,
        dynamic_bytes=dynamic,
    )


def particles_per_frame(staging: Path) -> float | None:
    """Mean number of active particles in particles.npz, where there is one."""
    path = staging / "particles.npz"
    return float(Particles.load(path).active.sum(axis=1).mean()) if path.is_file() else None


def run_phase(scratch: Path, request: Request, label: str, training: TrainingScene) -> tuple[Outcome, Watched]:
    """Carry out `request` in a child process. Where it tells no outcome, its exit code and log give one.

    An outcome that is told counts only with an exit code of 0 and, of renders, with every file that belongs to them.

    training: the scene of `request`, read before a method could change it.
    """
    path, progress = scratch / "request.json", Path(request.progress)
    for left in (progress, scratch / "log"):  # an earlier phase may have put anything there
        remove_any(left)
    write_model(path, request)
    views = [(camera, t) for camera, t, _ in requested_views(request, training)]
    watched = watch(
        child_command(keeper.keep, path),
        log=scratch / "log",
        progress=progress,
        label=label,
        timeout_seconds=request.budget_seconds,
        kept=True,
    )
    raise_if_disk_was_full(watched.exit_code, watched.log_tail)
    if watched.timed_out:
        outcome = Outcome(status=Status.TIMEOUT, reason=f"the {request.phase} took over {request.budget_seconds:g} s")
    elif watched.exit_code == -9:
        outcome = Outcome(
            status=Status.OUT_OF_MEMORY, reason=f"the {request.phase} was killed (signal 9), as when memory runs out"
        )
    elif (told := _told(watched)) is not None and told.outcome is not None:
        outcome = told.outcome
        if outcome.status == Status.OK and request.phase == "render":
            outcome = _looked_over(request, outcome, told, views, training.n_frames)
    else:
        last = watched.log_tail[-1] if watched.log_tail else "it said nothing"
        outcome = Outcome(
            status=Status.CRASHED, reason=f"the {request.phase} ended with exit code {watched.exit_code}: {last}"
        )
    return outcome, watched


def _told(watched: Watched) -> Report | None:
    """The keeper's report of a process that ended well; None where there is none, or nonsense was told."""
    if watched.exit_code != 0 or watched.report is None:
        return None
    try:
        return Report.model_validate(watched.report)
    except ValidationError:
        return None


def _looked_over(request: Request, outcome: Outcome, report: Report, views: list, n_frames: int) -> Outcome:
    """`outcome` of a rendering, where all of it is there."""
    output = Path(request.output)
    try:
        require_views(output, views)
        if not request.only_views and request.training_views is None:
            require_liquid(output, n_frames)
    except Failure as failure:
        return Outcome(status=failure.status, reason=failure.reason)
    if request.timing_frames < 1:
        return outcome.model_copy(update={"render_fps": None})
    frames = WARM_UP_FRAMES + request.timing_frames
    return outcome.model_copy(update={"render_fps": frames_per_second(report, outcome.render_fps, frames)})


def _empty(folder: Path) -> None:
    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir(parents=True, exist_ok=True)

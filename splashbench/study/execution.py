"""The execution of a plan: runs that exist are reused, the others are made, one after another or several at once.

A study that is killed loses only the runs in progress. A run that fails has an entry like any other.
"""

from __future__ import annotations

import contextlib
import shutil
import subprocess
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path

from filelock import FileLock, Timeout

from splashbench.child import child_command, raise_if_disk_was_full
from splashbench.errors import SplashbenchError
from splashbench.files import require_folder_place, write_model, write_text
from splashbench.score.image.lpips import load_lpips
from splashbench.study.job import ERROR, Job, RunEntry, Store, carry_out, carry_out_file
from splashbench.study.plan import PlannedRun, StudyPlan

_MARK = ".splashbench_study"
_POLL_SECONDS = 0.1


@dataclass
class ExecutionOptions:
    """How a plan is carried out.

    Attributes:
        only: names of variants; the others are left as they are. None for all.
        jobs: runs at once.
        keep: keep submissions, with renders and models.
        retry: run again what failed before.
        lpips_weights: see `splashbench.score.image.lpips.load_lpips`.
        tell: is given a line for the user whenever a run starts.
        order: gives the missing runs in the order in which they are made, and may leave some out; it is asked for the
            next one once there is room for it. None for all, as planned.
        pictures: keep a render of each run, see `Store.picture_path`.
        training: score training views too, see training_views.py; not of references.
    """

    only: tuple[str, ...] | None = None
    jobs: int = 1
    keep: bool = False
    retry: bool = False
    lpips_weights: Path | None = None
    tell: Callable[[str], None] = field(default=lambda line: None)
    order: Callable[[Sequence[PlannedRun]], Iterator[PlannedRun]] | None = None
    pictures: bool = False
    training: bool = False


@dataclass
class Tally:
    """How many runs were made now, and how many existed before."""

    made: int = 0
    reused: int = 0


def carry_out_plan(plan: StudyPlan, out: Path, options: ExecutionOptions) -> Tally:
    """Make every run of `plan` that is not in the folder `out` yet.

    Raises SplashbenchError where `out` holds other files, where another study runs in it, and for a full disk.
    """
    store = Store(out)
    with claimed(store):
        selected = [run for run in plan.runs if options.only is None or run.variant.name in options.only]
        with_lpips = "lpips" in plan.spec.metrics and load_lpips(options.lpips_weights)[0] is not None
        missing = {
            run.digest: run for run in selected if _is_missing(run, store, with_lpips, options.retry, options.training)
        }
        needed = {run.reference for run in missing.values()}
        in_table = {run.digest for run in plan.reference_row} & {run.reference for run in selected}
        references = [
            run
            for run in plan.references
            if (run.digest in in_table and _is_missing(run, store, with_lpips, options.retry))
            or (run.digest in needed and not store.reference_path(run.digest).is_dir())
        ]
        total = len(references) + len(missing)
        chosen = iter(missing.values()) if options.order is None else options.order(list(missing.values()))
        progress = _Progress(total, options, _seconds_before(plan, store))
        # First what others are measured against; it also fits the backgrounds that they share.
        for runs, is_reference in ((references, True), (chosen, False)):
            _run_all((_job(plan, run, out, options, is_reference) for run in runs), options.jobs, progress)
        return Tally(progress.ended, len({run.digest for run in selected}) - len(missing))


def _is_missing(run: PlannedRun, store: Store, with_lpips: bool, retry: bool, training: bool = False) -> bool:
    """Whether the run is to be made: it does not exist, or it lacks a figure that can be computed now."""
    entry = store.entry(run.digest)
    if entry is None or entry.status == ERROR:
        return True
    if entry.status != "ok":
        return retry
    result = store.result(entry)
    if result is None:
        return True
    return (
        (with_lpips and result.value("lpips") is None)
        or (run.timing_frames > 0 and result.value("render_fps") is None)
        or (run.variant.unseen is not None and store.faded(entry) is None)
        or (training and (entry.training is None or (retry and entry.training.status != "ok")))
    )


def _job(plan: StudyPlan, run: PlannedRun, out: Path, options: ExecutionOptions, is_reference: bool) -> Job:
    return Job(
        digest=run.digest,
        title=f"{run.scene.name}__{run.variant.name}__seed{run.seed}__{run.digest[:8]}",
        scene=str(run.scene.scene.directory),
        variant=run.variant,
        seed=run.seed,
        method=run.method,
        preset=run.preset,
        overrides=dict(run.overrides),
        reference=run.reference,
        is_reference=is_reference,
        device="cpu" if is_reference else plan.spec.device,
        timeout_seconds=plan.spec.timeout_seconds,
        timing_frames=run.timing_frames,
        lpips_weights=str(options.lpips_weights) if options.lpips_weights else None,
        out=str(out),
        keep=options.keep,
        at_once=options.jobs,
        picture=options.pictures,
        training=options.training and not is_reference,
    )


def _seconds_before(plan: StudyPlan, store: Store) -> list[float]:
    """Seconds that each existing run took."""
    entries = [store.entry(run.digest) for run in plan.runs]
    return [entry.seconds for entry in entries if entry is not None and entry.status != ERROR]


class _Progress:
    """Tells the user before each run which one it is and about how long the rest takes."""

    def __init__(self, total: int, options: ExecutionOptions, seconds: list[float]) -> None:
        # How many there will be is not known where the order may leave some out.
        self._total = total if options.order is None else None
        self._jobs, self._tell = options.jobs, options.tell
        self._seconds, self._started, self.ended = seconds, 0, 0

    def starts(self, job: Job) -> None:
        self._started += 1
        if self._total is None:
            self._tell(f"run {self._started}: {job.title}")
            return
        remaining = ""
        if self._seconds:
            mean = sum(self._seconds) / len(self._seconds)
            remaining = f", about {duration(mean * (self._total - self.ended) / self._jobs)} left"
        self._tell(f"run {self._started} of {self._total}{remaining}: {job.title}")

    def ends(self, entry: RunEntry) -> None:
        self.ended += 1
        self._seconds.append(entry.seconds)
        if entry.status != "ok":
            self._tell(f"failed: {entry.title}: {entry.status}: {entry.reason}")


def duration(seconds: float) -> str:
    """ "40 s", "8 min" or "2.5 h"."""
    if seconds < 90:
        return f"{seconds:.0f} s"
    return f"{seconds / 60:.0f} min" if seconds < 5400 else f"{seconds / 3600:.1f} h"


def _run_all(jobs: Iterable[Job], at_once: int, progress: _Progress) -> None:
    waiting = iter(jobs)
    if at_once == 1:
        for job in waiting:
            progress.starts(job)
            progress.ends(carry_out(job))
        return
    running: list[_Worker] = []
    more = True
    try:
        while more or running:
            while more and len(running) < at_once:
                job = next(waiting, None)  # type: ignore[assignment]
                more = job is not None
                if more:
                    progress.starts(job)
                    running.append(_Worker(job))
            time.sleep(_POLL_SECONDS)
            for worker in [worker for worker in running if worker.has_ended()]:
                running.remove(worker)
                progress.ends(worker.entry())
    finally:
        for worker in running:
            worker.stop()


class _Worker:
    """A job in a process of its own."""

    def __init__(self, job: Job) -> None:
        self._job, self._store = job, Store(Path(job.out))
        scratch = self._store.cache / "jobs"
        request, self._log = scratch / f"{job.digest[:16]}.json", scratch / f"{job.digest[:16]}.log"
        write_model(request, job)
        with self._log.open("wb") as log:
            self._process = subprocess.Popen(
                child_command(carry_out_file, request),
                stdin=subprocess.DEVNULL,
                stdout=log,
                stderr=subprocess.STDOUT,
                start_new_session=True,
            )

    def has_ended(self) -> bool:
        return self._process.poll() is not None

    def entry(self) -> RunEntry:
        """The entry that the process wrote; an error entry where it ended without one."""
        if self._process.returncode == 0:
            entry = self._store.entry(self._job.digest)
            if entry is not None:
                return entry
        lines = self._log.read_text(encoding="utf-8", errors="replace").strip().splitlines()
        raise_if_disk_was_full(self._process.returncode, lines)
        last = lines[-1] if lines else "it said nothing"
        reason = f"the run's process ended with exit code {self._process.returncode}: {last}"
        entry = RunEntry(digest=self._job.digest, title=self._job.title, status=ERROR, reason=reason)
        write_model(self._store.entry_path(self._job.digest), entry)
        return entry

    def stop(self) -> None:
        """End the process, which ends what it started."""
        self._process.terminate()
        with contextlib.suppress(subprocess.TimeoutExpired):
            self._process.wait(timeout=10)
        self._process.kill()
        self._process.wait()


@contextmanager
def claimed(store: Store) -> Iterator[None]:
    """Hold the study's folder for this process, and remove what a killed one left half-made.

    Raises SplashbenchError where it holds other files, or another study runs in it.
    """
    out = store.out
    require_folder_place(out)
    if out.is_dir() and any(out.iterdir()) and not (out / _MARK).is_file():
        raise SplashbenchError(f"{out} holds files that are no study's; give a new or an empty folder")
    if not (out / _MARK).is_file():
        write_text(out / _MARK, "Made by `splashbench study`, which may replace everything here.\n")
    try:
        lock = FileLock(out / ".lock").acquire(blocking=False)
    except Timeout:
        raise SplashbenchError(f"another study is running in {out}; wait for it, or give another place") from None
    with lock:
        for folder in (store.submissions, *store.cache.glob("*"), *store.cache.glob("scenes/*")):
            for leftover in folder.glob(".tmp-*"):
                shutil.rmtree(leftover, ignore_errors=True)
        yield

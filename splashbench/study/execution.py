"""The execution of a plan: runs that exist are reused, the others are made, one after another or several at once.

Several at once run here or on a Ray cluster, by the same code. A study that is killed loses only the runs in progress.
A run that fails has an entry like any other. One whose machine is lost is made again.
"""

from __future__ import annotations

import os
import shutil
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from pathlib import Path

from filelock import FileLock, Timeout

from splashbench.child import raise_if_disk_was_full
from splashbench.cluster.place import has_gpu, workers_at
from splashbench.cluster.work import Ended, Needs, Work, Workers
from splashbench.errors import SplashbenchError, one_line
from splashbench.files import remove_any, require_folder_place, write_model, write_text
from splashbench.harness.devices import AUTO, CPU
from splashbench.harness.estimates import duration
from splashbench.score.image.lpips import WEIGHTS_VARIABLE, load_lpips
from splashbench.score.image.weights import weights_path
from splashbench.score.result import Result
from splashbench.study.commit import commit, commit_failure, new_attempt, recover
from splashbench.study.job import ERROR, Attempt, Job, RunEntry, Store, carry_out, carry_out_file
from splashbench.study.plan import PlannedRun, StudyPlan
from splashbench.study.scenes import changes

_MARK = ".splashbench_study"
#: How often a run is started whose worker or machine is lost each time.
_TRIES = 5
#: For an entry that another machine has written to be seen here.
_ARRIVAL_SECONDS = 5.0
#: Without a line for so long, the user is told how far runs are that are being made; so many of them.
_SILENT_SECONDS, _SHOWN_RUNS, _LOG_TAIL_BYTES = 60.0, 3, 4096
#: What a scene states of itself, of `Scene.stated`, whatever harm is done to its recording.
_LASTING = frozenset({"container masks", "container mesh", "sparse points"})
#: Runs that may wait for a machine of their kind while others start.
_AHEAD = 100
#: What the processes have imported that runs are forked off.
_MODULES = ("splashbench.study.preload",)


@dataclass
class ExecutionOptions:
    """How a plan is carried out.

    Attributes:
        only: names of variants; the others are left as they are. None for all.
        jobs: runs at once; None for one here, and for as many as there is room for on Ray.
        on: where they are made, see `cluster.place.workers_at`; None for this machine.
        cores, memory_bytes: of a run, see `Needs`.
        gpus: on Ray, of a run whose device is a GPU; None for one.
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
    jobs: int | None = 1
    on: str | None = None
    cores: int | None = None
    gpus: int | None = None
    memory_bytes: int | None = None
    keep: bool = False
    retry: bool = False
    lpips_weights: Path | None = None
    tell: Callable[[str], None] = field(default=lambda line: None)
    order: Callable[[Sequence[PlannedRun]], Iterator[PlannedRun]] | None = None
    pictures: bool = False
    training: bool = False


def gpu_elsewhere(on: str | None, device: str) -> bool | None:
    """Whether one of the machines at `on` (see `ExecutionOptions`) has a GPU, for a plan; None for this machine.

    They are asked where `device` is "auto". Raises SplashbenchError where no cluster answers.
    """
    if on is None:
        return None
    return has_gpu(on) if device == AUTO else False


@dataclass
class Tally:
    """How many runs were made now, and how many existed before."""

    made: int = 0
    reused: int = 0


def carry_out_plan(plan: StudyPlan, out: Path, options: ExecutionOptions) -> Tally:
    """Make every run of `plan` that is not in the folder `out` yet.

    Raises SplashbenchError where `out` holds other files, where another study runs in it, and for a full disk.
    """
    store, options = Store(out), replace(options, lpips_weights=_weights(options))
    if options.gpus and all(run.device == CPU for run in plan.runs):
        options.tell(
            "note: --gpus does nothing here: no run is on a GPU, as no method uses one, no machine has one, or the "
            "device is cpu"
        )
    for planned in plan.scenes:
        if store.out.resolve().is_relative_to(planned.scene.directory.resolve()):
            raise SplashbenchError(f"{out} lies in the scene {planned.scene.directory}; give a place outside it")
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
        with _workers(plan, store, options, total) as workers:
            at_once = max(1, workers.room(_most_needed(plan, options))) if workers else 1
            progress = _Progress(total, options, _seconds_before(plan, store), at_once)

            def made_ready(run: PlannedRun, is_reference: bool) -> tuple[Job, Needs]:
                needs = _needs(run, is_reference, options)
                sharing = workers.sharing(needs) if workers else 1
                return _job(plan, run, store, options, is_reference, sharing), needs

            # First what others are measured against; it also fits the backgrounds that they share.
            for runs, is_reference in ((references, True), (chosen, False)):
                jobs = (made_ready(run, is_reference) for run in runs)
                if workers is None:
                    _run_here((job for job, _ in jobs), store, progress)
                else:
                    _run_all(jobs, workers, Needs(options.cores, 0, options.memory_bytes), store, progress)
        return Tally(progress.ended, len({run.digest for run in selected}) - len(missing))


def _weights(options: ExecutionOptions) -> Path | None:
    """The file of LPIPS weights. Other machines have to be told of one that this machine would find by itself."""
    if options.lpips_weights is not None or options.on is None:
        return options.lpips_weights
    named = os.environ.get(WEIGHTS_VARIABLE)
    found = Path(named) if named else weights_path()
    return found if named or found.is_file() else None


def _most_needed(plan: StudyPlan, options: ExecutionOptions) -> Needs:
    """What the most demanding run takes of a machine."""
    gpus = max((_needs(run, False, options).gpus for run in plan.runs), default=0)
    return Needs(options.cores, gpus, options.memory_bytes)


def _needs(run: PlannedRun, is_reference: bool, options: ExecutionOptions) -> Needs:
    """What `run` takes of a machine."""
    asked = 1 if options.gpus is None else options.gpus
    gpus = 0 if is_reference or run.device == CPU else asked
    return Needs(options.cores, gpus, options.memory_bytes)


@contextmanager
def _workers(plan: StudyPlan, store: Store, options: ExecutionOptions, total: int) -> Iterator[Workers | None]:
    """Where runs are made: None for this process itself, which shows how far each run is."""
    needs = _most_needed(plan, options)
    alone = options.on is None and (options.jobs or 1) == 1 and needs == replace(needs, cores=None, memory_bytes=None)
    if alone or total == 0:
        yield None
        return
    weights = [options.lpips_weights] if options.lpips_weights else []
    files = [Path(_absolute(run.method).rpartition(":")[0]) for run in plan.runs if ":" in run.method]
    scenes = [scene.scene.directory for scene in plan.scenes]
    workers = workers_at(
        options.on,
        options.jobs,
        _MODULES,
        folder=store.cache.resolve(),
        inputs=sorted({path.resolve() for path in (*scenes, *files, *weights)}),
        needs=needs,
        tell=options.tell,
    )
    with workers:
        yield workers


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
        _told_otherwise(run, entry, result)
        or (with_lpips and result.value("lpips") is None)
        or (run.timing_frames > 0 and result.value("render_fps") is None)
        or (run.variant.unseen is not None and store.faded(entry) is None)
        or (training and (entry.training is None or (retry and entry.training.status != "ok")))
    )


def _told_otherwise(run: PlannedRun, entry: RunEntry, result: Result) -> bool:
    """Whether container masks, points or the like have come or gone since the run, of which no digest tells."""
    scene = run.scene.scene
    if result.told is None:
        return False
    if changes(scene, run.variant, run.seed) is None:
        return result.told != scene.stated
    # Harm takes away other things, and with a camera its masks.
    lasting = _LASTING.intersection(result.told), _LASTING.intersection(scene.stated)
    return entry.train_views == list(scene.train) and lasting[0] != lasting[1]


def _job(
    plan: StudyPlan, run: PlannedRun, store: Store, options: ExecutionOptions, is_reference: bool, at_once: int
) -> Job:
    return Job(
        digest=run.digest,
        title=f"{run.scene.name}__{run.variant.name}__seed{run.seed}__{run.digest[:8]}",
        scene=str(run.scene.scene.directory.resolve()),
        scene_digest=run.scene.scene.digest,
        variant=run.variant,
        seed=run.seed,
        method=_absolute(run.method),
        preset=run.preset,
        overrides=dict(run.overrides),
        reference=run.reference,
        is_reference=is_reference,
        device=CPU if is_reference else run.device,
        timeout_seconds=plan.spec.timeout_seconds,
        timing_frames=run.timing_frames,
        lpips_weights=str(options.lpips_weights.resolve()) if options.lpips_weights else None,
        out=str(store.out.resolve()),
        attempt=str(new_attempt(store, run.digest).resolve()),
        keep=options.keep,
        at_once=at_once,
        picture=options.pictures,
        training=options.training and not is_reference,
    )


def _absolute(method: str) -> str:
    """`method`, of FILE.py:CLASS the file's absolute path: a child on another machine stands elsewhere."""
    file, _, name = method.rpartition(":")
    return f"{Path(file).resolve()}:{name}" if file else method


def _seconds_before(plan: StudyPlan, store: Store) -> list[float]:
    """Seconds that each existing run took."""
    entries = [store.entry(run.digest) for run in plan.runs]
    return [entry.seconds for entry in entries if entry is not None and entry.status != ERROR]


class _Progress:
    """Tells the user before each run which one it is and about how long the rest takes, and of long ones how far they
    are."""

    def __init__(self, total: int, options: ExecutionOptions, seconds: list[float], at_once: int) -> None:
        # How many there will be is not known where the order may leave some out.
        self._total = total if options.order is None else None
        self._at_once, self._tell = at_once, options.tell
        self._seconds, self._started, self.ended = seconds, 0, 0
        self._told = time.monotonic()

    def _say(self, line: str) -> None:
        self._told = time.monotonic()
        self._tell(line)

    def starts(self, job: Job) -> None:
        self._started += 1
        if self._total is None:
            self._say(f"run {self._started}: {job.title}")
            return
        remaining = ""
        if self._seconds:
            mean = sum(self._seconds) / len(self._seconds)
            remaining = f", about {duration(mean * (self._total - self.ended) / self._at_once)} left"
        self._say(f"run {self._started} of {self._total}{remaining}: {job.title}")

    def goes_on(self, tasks: Sequence[_Task]) -> None:
        """Tell of runs that are being made, once nothing has been told for a while: the longest ones, by their logs."""
        now = time.monotonic()
        if not tasks or now - self._told < _SILENT_SECONDS:
            return
        longest = sorted(tasks, key=lambda task: task.started)[:_SHOWN_RUNS]
        shown = [f"{task.job.title} for {duration(now - task.started)}{_how_far(task.job)}" for task in longest]
        more = f", and {len(tasks) - len(shown)} more" if len(tasks) > len(shown) else ""
        self._say(f"{self.ended} ended; being made: {'; '.join(shown)}{more}")

    def is_lost(self, job: Job, reason: str) -> None:
        """Tell of a run that starts once more."""
        self._say(f"lost: {job.title}: {reason}; it is made again")

    def ends(self, entry: RunEntry) -> None:
        self.ended += 1
        self._seconds.append(entry.seconds)
        if entry.status != "ok":
            self._say(f"failed: {entry.title}: {entry.status}: {entry.reason}")


def _how_far(job: Job) -> str:
    """The last line of a run's log, where there is any."""
    try:
        with Attempt(Path(job.attempt)).log.open("rb") as log:
            log.seek(max(0, os.fstat(log.fileno()).st_size - _LOG_TAIL_BYTES))
            lines = log.read().decode("utf-8", errors="replace").strip().splitlines()
    except OSError:
        return ""
    return f" ({one_line(lines[-1])[:100]})" if lines else ""


def _run_here(jobs: Iterable[Job], store: Store, progress: _Progress) -> None:
    for job in jobs:
        progress.starts(job)
        attempt = Attempt(Path(job.attempt))
        write_model(attempt.request, job)
        try:
            carry_out(job)
        except BaseException:
            shutil.rmtree(attempt.folder, ignore_errors=True)
            raise
        progress.ends(commit(store, attempt))


@dataclass
class _Task:
    """A run that waits or is being made, for the `tries`th time, since `started` of the monotonic clock."""

    job: Job
    needs: Needs
    tries: int = 1
    started: float = 0.0


def _run_all(
    jobs: Iterable[tuple[Job, Needs]], workers: Workers, least: Needs, store: Store, progress: _Progress
) -> None:
    """Make `jobs`, several at once; those that need less may go before. least: what every one of them needs."""
    following = iter(jobs)
    waiting: list[_Task] = []
    running: dict[str, _Task] = {}
    more = True
    while more or waiting or running:
        for task in [*waiting]:
            if workers.room(task.needs) > 0:
                waiting.remove(task)
                running[_start(task, workers, progress)] = task
        while more and len(waiting) < _AHEAD and workers.room(least) > 0:
            found = next(following, None)
            if found is None:
                more = False
                break
            task = _Task(*found)
            if workers.room(task.needs) > 0:
                running[_start(task, workers, progress)] = task
            else:
                waiting.append(task)
        for ended in workers.wait() if more or running or waiting else []:
            task = running.pop(ended.key)
            job = task.job
            if ended.lost and not Path(job.attempt, "entry.json").is_file() and task.tries < _TRIES:
                progress.is_lost(job, ended.lost)
                # In a folder of its own: nobody knows whether the lost one goes on.
                job = job.model_copy(update={"attempt": str(new_attempt(store, job.digest).resolve())})
                waiting.insert(0, _Task(job, task.needs, task.tries + 1))
            else:
                progress.ends(_entry(job, ended, store))
        progress.goes_on(list(running.values()))


def _start(task: _Task, workers: Workers, progress: _Progress) -> str:
    """Start the run; returns the key of its work."""
    if task.tries == 1:
        progress.starts(task.job)
    task.started = time.monotonic()
    attempt = Attempt(Path(task.job.attempt))
    write_model(attempt.request, task.job)
    carried_out = f"{carry_out_file.__module__}:{carry_out_file.__qualname__}"
    workers.start(Work(attempt.folder.name, carried_out, attempt.request, attempt.log, task.needs))
    return attempt.folder.name


def _is_there(path: Path, seconds: float) -> bool:
    """Whether `path` is a file, or becomes one within `seconds`: other machines' files may arrive late."""
    deadline = time.monotonic() + seconds
    while not path.is_file():
        if time.monotonic() >= deadline:
            return False
        time.sleep(0.1)
        list(path.parent.glob("*"))  # has a network file system look anew
    return True


def _entry(job: Job, ended: Ended, store: Store) -> RunEntry:
    """The entry that a run's process wrote, which counts now; an error entry where it ended without one."""
    attempt = Attempt(Path(job.attempt))
    if _is_there(attempt.entry, _ARRIVAL_SECONDS if ended.exit_code == 0 and not ended.lost else 0):
        return commit(store, attempt)
    reason = f"{ended.lost}, {_TRIES} times; give the same command again"
    if not ended.lost:
        # There is none where the worker could not open it.
        said = attempt.log.read_text(encoding="utf-8", errors="replace") if attempt.log.is_file() else ""
        lines = said.strip().splitlines()
        raise_if_disk_was_full(ended.exit_code, lines)
        last = lines[-1] if lines else "it said nothing"
        reason = f"the run's process ended with exit code {ended.exit_code}: {last}"
    return commit_failure(store, RunEntry(digest=job.digest, title=job.title, status=ERROR, reason=reason))


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
                remove_any(leftover)
        recover(store)
        yield

"""One run of a study: fit, score, entry; in this process or a child.

It leaves a result in results/ and an entry in runs/. The entry is written last: a run with an entry is complete.
"""

from __future__ import annotations

import shutil
import time
from pathlib import Path
from typing import Any

from pydantic import BaseModel, ConfigDict, Field

from splashbench.errors import DiskFullError, SplashbenchError, one_line
from splashbench.files import read_model, write_model, write_png
from splashbench.harness.runner import run_method
from splashbench.processes import terminable
from splashbench.scene import Scene
from splashbench.score import Result, score_submission, shared_fields
from splashbench.study.scenes import changed_scene
from splashbench.study.spec import StudyVariant
from splashbench.study.training_views import TrainingScore, score_training_views
from splashbench.submission import Record, Status, Submission
from splashbench.submission.faded import FadedSubmission

#: The status of a run that ended outside its method: in reading the scene, say, or in scoring.
ERROR = "error"


class Job(BaseModel):
    """What the process of a run is given: the planned run with all its paths."""

    model_config = ConfigDict(extra="forbid")
    digest: str
    title: str
    scene: str
    variant: StudyVariant
    seed: int
    method: str
    preset: str
    overrides: dict[str, Any]
    reference: str | None
    is_reference: bool
    device: str
    timeout_seconds: float | None
    timing_frames: int
    lpips_weights: str | None
    out: str
    keep: bool
    at_once: int
    picture: bool = False
    training: bool = False


class RunEntry(BaseModel):
    """runs/DIGEST.json: a run that has ended.

    Attributes:
        result: name of its file in results/; null where there is none.
        faded: where timesteps were withheld, that of the control `faded` (submission/faded.py).
        at_once: how many runs shared the machine.
        training: figures of training views, where they were asked for (training_views.py).
        seconds: duration of the run, scoring included.
    """

    model_config = ConfigDict(extra="forbid")
    schema_version: int = 1
    digest: str
    title: str
    status: str
    reason: str = ""
    result: str | None = None
    faded: str | None = None
    record: Record | None = None
    train_views: list[str] = Field(default_factory=list)
    training: TrainingScore | None = None
    at_once: int = 1
    seconds: float = 0.0


class Store:
    """The folder of a study: its results, entries, submissions and cache."""

    def __init__(self, out: Path) -> None:
        self.out = Path(out)
        self.results, self.runs, self.submissions = self.out / "results", self.out / "runs", self.out / "submissions"
        self.cache = self.out / "cache"

    def entry(self, digest: str) -> RunEntry | None:
        """The entry of the run `digest`, None where there is none or its result is missing."""
        path = self.entry_path(digest)
        if not path.is_file():
            return None
        entry = read_model(path, RunEntry)
        return entry if entry.result is None or (self.results / entry.result).is_file() else None

    def result(self, entry: RunEntry) -> Result | None:
        """The result of an entry, None where it has none."""
        return Result.load(self.results / entry.result) if entry.result else None

    def faded(self, entry: RunEntry) -> Result | None:
        """The result of an entry's control `faded`, None where it has none."""
        path = self.results / entry.faded if entry.faded else None
        return Result.load(path) if path and path.is_file() else None

    def entry_path(self, digest: str) -> Path:
        return self.runs / f"{digest[:16]}.json"

    def picture_path(self, digest: str, t: int) -> Path:
        """A render of the run: of the first test view at timestep `t`, see `pictured_timestep`."""
        return self.out / "pictures" / f"{digest[:16]}_t{t}.png"

    def reference_path(self, digest: str) -> Path:
        """Folder of the submission of a reference run, which other runs are scored against."""
        return self.cache / "references" / digest[:16]

    def reference(self, digest: str) -> Submission | None:
        """The reference run `digest`, None where it is not there or failed."""
        path = self.reference_path(digest)
        if not path.is_dir():
            return None
        submission = Submission.open(path)
        return submission if submission.status == Status.OK else None


def pictured_timestep(n_frames: int) -> int:
    """The timestep of a run's picture: in the middle, and an odd one, which a method is mostly not shown where
    timesteps are withheld."""
    return min(n_frames // 2 | 1, n_frames - 1)


def carry_out(job: Job) -> RunEntry:
    """Make the run, score it, and write its entry. A run that fails has an entry with a status and a reason.

    Raises DiskFullError only, since no other run would succeed either.
    """
    store, start = Store(Path(job.out)), time.monotonic()
    entry = RunEntry(digest=job.digest, title=job.title, status=ERROR, at_once=job.at_once)
    try:
        entry = _scored(job, store, entry)
    except DiskFullError:
        raise
    except SplashbenchError as error:
        entry = entry.model_copy(update={"reason": str(error)})
    except Exception as error:  # a run of many: the others go on
        entry = entry.model_copy(update={"reason": one_line(f"{type(error).__name__}: {error}")})
    earlier = store.entry(job.digest)
    entry = entry.model_copy(update={"seconds": time.monotonic() - start})
    write_model(store.entry_path(job.digest), entry)
    for stale in {earlier.result, earlier.faded} - {entry.result, entry.faded, None} if earlier else ():
        (store.results / str(stale)).unlink(missing_ok=True)
    return entry


def _scored(job: Job, store: Store, entry: RunEntry) -> RunEntry:
    original = Scene.open(Path(job.scene))
    scene = changed_scene(original, job.variant, job.seed, store.cache / "scenes")
    place = store.reference_path(job.digest) if job.is_reference else store.submissions / job.title
    submission = run_method(
        job.method,
        scene.directory,
        place,
        preset=job.preset,
        overrides=job.overrides,
        seed=job.seed,
        device=job.device,
        timeout_seconds=job.timeout_seconds,
        timing_frames=job.timing_frames,
        keep_model=job.keep or job.training,
        replace=True,
        cache=store.cache / "parts",
        withheld=job.variant.unseen,
    )
    if job.is_reference:
        reference = submission if submission.status == Status.OK else None
    else:
        reference = store.reference(job.reference) if job.reference else None
    weights = Path(job.lpips_weights) if job.lpips_weights else None
    # Evaluation data never change: the fields come from the scene itself, not from worse masks or fewer views.
    result = score_submission(scene, submission, reference, weights, fields=shared_fields(original))
    saved, faded = result.save(store.results), None
    if job.picture and submission.status == Status.OK:
        t = pictured_timestep(scene.n_frames)
        path = store.picture_path(job.digest, t)
        path.parent.mkdir(parents=True, exist_ok=True)
        write_png(path, submission.rendering(scene.test[0], t))
    if job.variant.unseen and submission.status == Status.OK:
        control = FadedSubmission(submission, scene)
        faded = score_submission(scene, control, reference, weights, fields=shared_fields(original)).save(store.results)
    training = None
    if job.training and submission.status == Status.OK:
        training = score_training_views(job.method, scene, submission, weights, job.timeout_seconds)
    if not job.keep and not job.is_reference:
        shutil.rmtree(place)
    return entry.model_copy(
        update={
            "status": result.status,
            "reason": result.reason,
            "result": saved.name,
            "faded": faded.name if faded else None,
            "record": submission.record,
            "train_views": list(scene.train),
            "training": training,
        }
    )


def carry_out_file(file: str) -> int:
    """Carry out the job in `file`: what a child process does."""
    try:
        with terminable():
            carry_out(read_model(Path(file), Job))
    except KeyboardInterrupt:
        return 130
    return 0

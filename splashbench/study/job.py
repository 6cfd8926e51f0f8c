"""One run of a study: fit, score, entry; in this process, a child, or a child on another machine.

It writes into the folder of its attempt alone, the entry last. The study's own process takes from there what counts
(commit.py): of two attempts at one run, such as after a machine was taken for lost, only one does.
"""

from __future__ import annotations

import os
import shutil
import tempfile
import time
from pathlib import Path
from typing import Annotated, Any

from pydantic import AfterValidator, BaseModel, ConfigDict, Field

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

# A disk with less is full.
_ROOM_BYTES = 16 << 20
#: The status of a run that ended outside its method: in reading the scene, say, or in scoring.
ERROR = "error"


def _plain(name: str) -> str:
    """`name` where it names a file in a folder and nothing else: a study's folder may be a stranger's."""
    if name in ("", ".", "..") or any(letter in "/\\" or not letter.isprintable() for letter in name):
        raise ValueError("is no plain name of a file")
    return name


_Name = Annotated[str, AfterValidator(_plain)]


class Job(BaseModel):
    """What the process of a run is given: the planned run with all its paths, absolute ones.

    Attributes:
        scene_digest: of the scene when the study was planned.
        attempt: the folder that this attempt writes into; of no other attempt.
    """

    model_config = ConfigDict(extra="forbid")
    digest: _Name
    title: _Name
    scene: str
    scene_digest: str
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
    attempt: str
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
        attempt: name of the folder it was made in, which is gone.
    """

    model_config = ConfigDict(extra="forbid")
    schema_version: int = 1
    digest: _Name
    title: str
    status: str
    reason: str = ""
    result: _Name | None = None
    faded: _Name | None = None
    record: Record | None = None
    train_views: list[str] = Field(default_factory=list)
    training: TrainingScore | None = None
    at_once: int = 1
    seconds: float = 0.0
    attempt: str = ""


class Store:
    """The folder of a study: its results, entries, submissions and cache."""

    def __init__(self, out: Path) -> None:
        self.out = Path(out)
        self.results, self.runs, self.submissions = self.out / "results", self.out / "runs", self.out / "submissions"
        self.cache = self.out / "cache"
        self.pictures, self.attempts = self.out / "pictures", self.cache / "jobs"

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
        return self.pictures / f"{digest[:16]}_t{t}.png"

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
    """Make the run and score it, in the folder of its attempt. A run that fails has an entry with status and reason.

    Raises DiskFullError where the disk stays full, since no other run would succeed either.
    """
    attempt, start = Attempt(Path(job.attempt)), time.monotonic()
    entry = RunEntry(digest=job.digest, title=job.title, status=ERROR, at_once=job.at_once, attempt=attempt.folder.name)
    attempt.folder.mkdir(parents=True, exist_ok=True)
    try:
        entry = _scored(job, attempt, entry)
    except DiskFullError as error:
        attempt.clear()
        if not _there_is_room(attempt.folder):
            raise
        entry = entry.model_copy(update={"reason": f"the run filled the disk, and its files are removed: {error}"})
    except SplashbenchError as error:
        entry = entry.model_copy(update={"reason": str(error)})
    except Exception as error:  # a run of many: the others go on
        entry = entry.model_copy(update={"reason": one_line(f"{type(error).__name__}: {error}")})
    entry = entry.model_copy(update={"seconds": time.monotonic() - start})
    write_model(attempt.entry, entry)
    return entry


class Attempt:
    """The folder of one attempt at a run; `entry` is written last."""

    def __init__(self, folder: Path) -> None:
        self.folder = Path(folder)
        self.request, self.log, self.entry = folder / "request.json", folder / "log", folder / "entry.json"
        self.results, self.pictures, self.submission = folder / "results", folder / "pictures", folder / "submission"

    def clear(self) -> None:
        """Remove what it has made so far, but for its log."""
        for path in (self.results, self.pictures, self.submission):
            shutil.rmtree(path, ignore_errors=True)


def _there_is_room(folder: Path) -> bool:
    """Whether files can be written again, into `folder` and where runs have their scratch folders."""
    for place in (folder, Path(tempfile.gettempdir())):
        try:
            with tempfile.TemporaryFile(dir=place) as stream:
                os.posix_fallocate(stream.fileno(), 0, _ROOM_BYTES)
        except OSError:
            return False
    return True


def _scored(job: Job, attempt: Attempt, entry: RunEntry) -> RunEntry:
    store, original = Store(Path(job.out)), Scene.open(Path(job.scene))
    if original.digest != job.scene_digest:
        raise SplashbenchError(
            f"{job.scene} was changed while the study ran, maybe by a method; restore it and run the study again"
        )
    scene = changed_scene(original, job.variant, job.seed, store.cache / "scenes")
    submission = run_method(
        job.method,
        scene.directory,
        attempt.submission,
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
    saved, faded = result.save(attempt.results), None
    if job.picture and submission.status == Status.OK:
        t = pictured_timestep(scene.n_frames)
        attempt.pictures.mkdir(exist_ok=True)
        path = attempt.pictures / store.picture_path(job.digest, t).name
        write_png(path, submission.rendering(scene.test[0], t))
    if job.variant.unseen and submission.status == Status.OK:
        control = FadedSubmission(submission, scene)
        scored = score_submission(scene, control, reference, weights, fields=shared_fields(original))
        faded = scored.save(attempt.results)
    training = None
    if job.training and submission.status == Status.OK:
        training = score_training_views(job.method, scene, submission, weights, job.timeout_seconds)
    if not job.keep and not job.is_reference:
        shutil.rmtree(attempt.submission)
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

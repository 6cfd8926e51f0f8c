"""Messages between the harness and its child process: a request file in, progress lines and an outcome out."""

from __future__ import annotations

from typing import Any, Literal

from pydantic import BaseModel, ConfigDict, Field, ValidationError, model_validator

from splashbench.submission import Budget, Decision, Record, Status

_NO_MEMORY = (
    *("out of memory", "can't allocate memory", "cannot allocate memory"),
    *("insufficient memory", "outofmemory", "unable to allocate"),
)


class Request(BaseModel):
    """What a child process is to do.

    Attributes:
        phase: fit (scene -> model), import (an external code's output -> model), render (model -> test views).
        times: of the views to render, seconds by test camera; by default those of the scene's timesteps.
        only_views: render nothing but the views, and hand in no particles.
        training_views: training views to render in place of the test views, timesteps by camera.
        checkpoints: folder for states of the fit under way; null takes none. marks: when, see checkpoints.py.
        importer: imports and renders a model instead of the method. source, export: what it reads it from.
    """

    model_config = ConfigDict(extra="forbid")
    phase: Literal["fit", "import", "render"]
    method: str
    scene: str
    preset: str
    overrides: dict[str, Any]
    seed: int
    device: str
    budget_seconds: float | None
    scratch: str
    model: str
    output: str
    progress: str
    timing_frames: int
    exr: bool
    cache: str | None = None
    times: dict[str, list[float]] | None = None
    only_views: bool = False
    training_views: dict[str, list[int]] | None = None
    checkpoints: str | None = None
    marks: list[float] = []
    budget: Budget = Budget()
    importer: str | None = None
    source: str = ""
    export: str = ""


class Failure(Exception):
    """A phase that ended with a status of its own."""

    def __init__(self, status: Status, reason: str) -> None:
        super().__init__(reason)
        self.status, self.reason = status, reason


class Outcome(BaseModel):
    """How a phase ended, as the harness's own code in the child process tells it.

    It comes from the method's process, so nothing in it is a measurement of time: that is taken outside (clock.py).
    What no record may have is refused here, not when the submission is read.

    Attributes:
        overhead_seconds: of the fit, spent on what runs of a study share; believed in studies alone.
        checkpoints: seconds of the fit at each state, as its own clock told; believed where the keeper's says as much.
        render_fps: checked against the time that all timed frames took.
    """

    model_config = ConfigDict(extra="forbid")
    status: Status = Status.OK
    reason: str = ""
    overhead_seconds: float = Field(default=0.0, ge=0, allow_inf_nan=False)
    reused: dict[str, float] = {}
    stages: dict[str, float] = {}
    notes: dict[str, str] = {}
    decisions: list[Decision] = []
    checkpoints: list[float] = []
    render_fps: float | None = None
    primitives_per_frame: float | None = None
    peak_device_memory_bytes: int | None = None
    renderer: list[str] = []

    @model_validator(mode="after")
    def _fits_a_record(self) -> Outcome:
        shared = (set(Outcome.model_fields) & set(Record.model_fields)) - {"checkpoints"}
        try:
            Record.model_validate(self.model_dump(include=shared))
        except ValidationError as error:
            first = error.errors()[0]
            raise ValueError(f"{'.'.join(map(str, first['loc']))}: {first['msg']}") from None
        return self


def lacks_memory(text: str) -> bool:
    """Whether an error says that memory ran out, in the words of Python, PyTorch, CUDA, OpenCV or the system."""
    said = text.lower()
    return any(words in said for words in _NO_MEMORY)

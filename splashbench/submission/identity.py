"""What a submission states of itself: submission.toml (identity) and record.json (the harness's measurements)."""

from __future__ import annotations

import math
from enum import Enum
from itertools import pairwise
from typing import Annotated, Any, Literal

from pydantic import AfterValidator, BaseModel, ConfigDict, Field, field_validator, model_validator

from splashbench.submission.budget import Budget
from splashbench.submission.decisions import MAX_DECISIONS, Decision
from splashbench.submission.withheld import Withheld

PROTOCOL: Literal["v1"] = "v1"
_NAME = r"^[A-Za-z0-9_][A-Za-z0-9_.+\[\]-]{0,99}$"

#: No cost of a run comes near; anything beyond is no measurement (and infinity is none either).
_MAX_COST = 10**15
#: Of whole numbers and of lists and tables within each other, in what a submission says freely.
_LARGEST_INTEGER, _MAX_NESTING = 2**63 - 1, 24
#: Characters of a note in record.json, and notes, at most.
MAX_NOTE, MAX_NOTES = 500, 50
#: Letters of a preset's name or a version, and figures that a submitter claims, at most.
MAX_NAME, MAX_CLAIMS = 200, 1000
#: States of a fit on its way: their folders have two digits.
MAX_CHECKPOINTS = 100
#: Figures by the names that records and results had before version 0.2 -> today's names.
RENAMED_FIGURES = {"carriers_per_frame": "particles_per_frame"}


def with_current_names(figures: Any) -> Any:
    """`figures` as read from a file, with keys of `RENAMED_FIGURES` replaced: old files stay readable."""
    if not isinstance(figures, dict):
        return figures
    return {RENAMED_FIGURES.get(name, name): value for name, value in figures.items()}


def _plain_table(table: dict[str, Any]) -> dict[str, Any]:
    """`table` where JSON can say it, hence a result. Raises ValueError naming the first entry that is none of text,
    numbers, true, false, lists and tables: TOML has dates as well, and numbers without end."""
    _require_plain("", table, 0)
    return table


def _require_plain(place: str, value: Any, depth: int) -> None:
    if depth > _MAX_NESTING:
        raise ValueError(f"more than {_MAX_NESTING} lists or tables within each other")
    if isinstance(value, dict):
        for key, part in value.items():
            if not isinstance(key, str):
                raise ValueError(f"{place}{key!r} is no text, which keys are")
            _require_plain(f"{place}{key[:40]}.", part, depth + 1)
    elif isinstance(value, (list, tuple)):
        for part in value:
            _require_plain(place, part, depth + 1)
    elif isinstance(value, float) and not math.isfinite(value):
        raise ValueError(f"{place.rstrip('.')} is {value}, which is no number")
    elif isinstance(value, int) and abs(value) > _LARGEST_INTEGER:
        raise ValueError(f"{place.rstrip('.')} is a whole number of more than 64 bits")
    elif not (value is None or isinstance(value, (str, int, float))):
        raise ValueError(f"{place.rstrip('.')} is a {type(value).__name__}, not text, a number, true or false")


def _printable(text: str) -> str:
    if not text.isprintable():
        raise ValueError("it has control characters")
    return text


_Text = Annotated[str, Field(max_length=1000)]
_Label = Annotated[str, Field(max_length=MAX_NAME), AfterValidator(_printable)]
_Table = Annotated[dict[str, Any], AfterValidator(_plain_table)]


class Status(str, Enum):
    """How a run ended. Only `ok` is scored; everything else is kept, shown and never dropped."""

    OK = "ok"
    UNSUPPORTED = "unsupported"
    CRASHED = "crashed"
    TIMEOUT = "timeout"
    OUT_OF_MEMORY = "out_of_memory"
    NOT_FINITE = "not_finite"
    OUT_OF_RANGE = "out_of_range"
    WRONG_SIZE = "wrong_size"
    INCOMPLETE = "incomplete"


class Identity(BaseModel):
    """submission.toml. Identity is in here and never in a file name."""

    model_config = ConfigDict(extra="forbid")
    schema_version: Literal[1] = 1
    protocol: Literal["v1"] = PROTOCOL
    method: str = Field(pattern=_NAME)
    method_version: _Label = "1"
    preset: _Label = "best"
    settings: _Table = Field(default_factory=dict)
    #: KEY=VALUE: settings that were given on top of the preset
    overrides: list[Annotated[str, Field(max_length=100_000)]] = Field(default_factory=list, max_length=1000)
    #: What the user said that the fit may cost, where anything was said.
    budget: Budget | None = None
    seed: int = Field(default=0, ge=-_LARGEST_INTEGER, le=_LARGEST_INTEGER)
    device: _Text = "cpu"
    scene: _Text
    scene_digest: str = Field(pattern=r"^[0-9a-f]{64}$")
    #: What the scene stated besides images, masks and cameras when the run began (`Scene.stated`), of which its digest
    #: says nothing; null where it was not noted.
    told: tuple[_Text, ...] | None = Field(default=None, max_length=100)
    control: bool = False
    mixed: bool = False
    #: Timesteps that the method did not see; only they are scored (withheld.py).
    withheld: Withheld | None = None
    splashbench_version: _Text = ""
    hardware: _Table = Field(default_factory=dict)
    #: What the submitter says the figures are; shown beside the verified ones, never instead of them.
    claimed: dict[str, float] = Field(default_factory=dict, max_length=MAX_CLAIMS)

    @field_validator("claimed", mode="before")
    @classmethod
    def _current_names(cls, value: Any) -> Any:
        return with_current_names(value)


class Checkpoint(BaseModel):
    """A state of the fit under way, taken when it had lasted `seconds`; its views lie in the folder `folder`.

    Where `status` is not ok it has none, for `reason`. storage_bytes: of the model as it was then.
    """

    model_config = ConfigDict(extra="forbid")
    seconds: float = Field(ge=0, le=_MAX_COST)
    folder: str = Field(pattern=r"^checkpoints/[0-9]{2}$")
    status: Status = Status.OK
    reason: str = ""
    storage_bytes: int | None = Field(default=None, ge=0, le=_MAX_COST)
    dynamic_bytes: int | None = Field(default=None, ge=0, le=_MAX_COST)


class Record(BaseModel):
    """record.json: status and costs, as the harness measured them; null is not measured."""

    model_config = ConfigDict(extra="forbid")
    schema_version: Literal[1] = 1
    status: Status = Status.OK
    reason: str = ""
    fit_seconds: float | None = Field(default=None, ge=0, le=_MAX_COST)
    #: parts that were loaded from an earlier run, and the seconds of their fit there, which fit_seconds includes
    reused: dict[str, Annotated[float, Field(ge=0, le=_MAX_COST)]] = Field(default_factory=dict)
    #: seconds of the fit's stages, where the method tells them
    stages: dict[str, Annotated[float, Field(ge=0, le=_MAX_COST)]] = Field(default_factory=dict)
    #: states of the fit on its way, in the order of their seconds
    checkpoints: list[Checkpoint] = Field(default_factory=list, max_length=MAX_CHECKPOINTS)
    #: seconds that saving them took, which fit_seconds leaves out; null where none were asked for
    checkpoint_seconds: float | None = Field(default=None, ge=0, le=_MAX_COST)
    #: what the method found out by itself and went by
    notes: dict[str, Annotated[str, Field(max_length=MAX_NOTE)]] = Field(default_factory=dict, max_length=MAX_NOTES)
    #: what the method decided by itself, in the order in which it did
    decisions: list[Decision] = Field(default_factory=list, max_length=MAX_DECISIONS)
    render_fps: float | None = Field(default=None, ge=0, le=_MAX_COST)
    timed_frames: int | None = Field(default=None, ge=0, le=_MAX_COST)
    peak_memory_bytes: int | None = Field(default=None, ge=0, le=_MAX_COST)
    peak_device_memory_bytes: int | None = Field(default=None, ge=0, le=_MAX_COST)
    storage_bytes: int | None = Field(default=None, ge=0, le=_MAX_COST)
    dynamic_bytes: int | None = Field(default=None, ge=0, le=_MAX_COST)
    primitives_per_frame: float | None = Field(default=None, ge=0, le=_MAX_COST)
    particles_per_frame: float | None = Field(default=None, ge=0, le=_MAX_COST)
    renderer: list[str] = Field(default_factory=list)  # backends of the shared renderer, such as "cpu (avx2)"
    log_tail: list[str] = Field(default_factory=list)

    @model_validator(mode="before")
    @classmethod
    def _current_names(cls, data: Any) -> Any:
        return with_current_names(data)

    @field_validator("checkpoints")
    @classmethod
    def _in_order(cls, value: list[Checkpoint]) -> list[Checkpoint]:
        if any(later.seconds < earlier.seconds for earlier, later in pairwise(value)):
            raise ValueError("the seconds of checkpoints must not fall")
        if len({checkpoint.folder for checkpoint in value}) < len(value):
            raise ValueError("two checkpoints have one folder")
        return value

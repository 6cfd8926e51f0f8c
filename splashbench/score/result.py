"""A result: one immutable JSON per method, scene, preset and seed, with every value behind every mean.

A figure that cannot be computed is null, with a reason. A failed run is a result with a status, a reason and nulls,
never with a score. Results name by digest what they were computed from.
"""

from __future__ import annotations

import hashlib
import json
import math
import re
from collections.abc import Iterator
from itertools import pairwise
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
from pydantic import BaseModel, ConfigDict, Field, field_validator

from splashbench.errors import SplashbenchError, one_line
from splashbench.files import read_model, write_model
from splashbench.score.metrics import METRICS, Better
from splashbench.score.ranges import MEANS_OF_FRAMES, MEANS_OF_VIEWS, MOST, range_fault
from splashbench.score.settings import Protocol
from splashbench.submission import Decision, Status, with_current_names
from splashbench.submission.identity import MAX_CLAIMS, MAX_NAME
from splashbench.submission.withheld import Withheld

_UNSAFE = re.compile(r"[^A-Za-z0-9_.+-]+")
_MAX_HARDWARE = 80
_STATUSES = frozenset(status.value for status in Status)
_Figure = Annotated[float, Field(allow_inf_nan=False)]
_Seconds = Annotated[float, Field(ge=0, le=MOST, allow_inf_nan=False)]


class _Frozen(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True)


class ViewValues(_Frozen):
    """A metric in one test view: its mean and the value of each frame, null for a skipped one."""

    value: float | None = Field(default=None, allow_inf_nan=False)
    frames: tuple[_Figure | None, ...] = ()


class MetricValue(_Frozen):
    """One metric of a result; unit and direction stand beside the value.

    views: per test view, for image metrics. frames: per frame, for all others. skipped_frames: how many (frame, view)
    pairs or frames had no value.
    """

    value: float | None = Field(default=None, allow_inf_nan=False)
    reason: str | None = None
    unit: str = ""
    better: Better | None = None
    version: int = 1
    skipped_frames: int = 0
    views: dict[str, ViewValues] = Field(default_factory=dict)
    frames: tuple[_Figure | None, ...] = ()


class CheckpointScore(_Frozen):
    """The image metrics of the fit on its way, `seconds` after its begin: means alone, null for what has none.

    Where `status` is not ok there are no views to score, for `reason`.
    """

    seconds: float = Field(ge=0, allow_inf_nan=False)
    status: str = "ok"
    reason: str = ""
    storage_bytes: int | None = Field(default=None, ge=0, le=int(MOST))
    metrics: dict[str, _Figure | None] = Field(default_factory=dict)


class Digests(_Frozen):
    """SHA-256 of everything a result depends on; null for what was not used. truth: of the scene's true particles."""

    scene: str
    submission: str
    protocol: str
    reference: str | None = None
    lpips_weights: str | None = None
    truth: str | None = None


class Result(_Frozen):
    """The score of one submission. `metrics` has every name of the registry.

    Attributes:
        overrides: KEY=VALUE, settings that were given on top of the preset.
        told: what the scene states besides images, masks and cameras (`Scene.stated`); None where it was not noted.
        checkpoints: the fit on its way, in the order of time.
        stages, notes, decisions: of the submission's record: seconds of the fit's phases, what the method found out,
            and what it decided by itself.
    """

    schema_version: Literal[1] = 1
    method: str
    method_version: str
    scene: str
    seed: int
    preset: str
    settings: dict[str, Any] = Field(default_factory=dict)
    overrides: tuple[str, ...] = ()
    told: tuple[str, ...] | None = None
    control: bool = False
    mixed: bool = False
    withheld: Withheld | None = None
    status: str
    reason: str = ""
    protocol: Protocol
    digests: Digests
    metrics: dict[str, MetricValue]
    checkpoints: tuple[CheckpointScore, ...] = ()
    stages: dict[str, _Seconds] = Field(default_factory=dict)
    notes: dict[str, str] = Field(default_factory=dict)
    decisions: list[Decision] = Field(default_factory=list)
    claimed: dict[str, _Figure] = Field(default_factory=dict)
    hardware: dict[str, Any] = Field(default_factory=dict)
    times_source: str = ""
    versions: dict[str, str] = Field(default_factory=dict)

    @field_validator("metrics", "claimed", mode="before")
    @classmethod
    def _current_names(cls, value: Any) -> Any:
        return with_current_names(value)

    def value(self, name: str) -> float | None:
        """The value of metric `name`, or None."""
        metric = self.metrics.get(name)
        return metric.value if metric else None

    @property
    def protocol_label(self) -> str:
        """What results must share to be compared: the protocol, and whether timesteps were withheld."""
        return f"{self.protocol.label}, {self.withheld} timesteps withheld" if self.withheld else self.protocol.label

    @property
    def settings_digest(self) -> str:
        """Eight hex digits naming the method's version and settings: runs that differ in them are never averaged."""
        text = json.dumps([self.method_version, self.settings], sort_keys=True, default=str)
        return hashlib.sha256(text.encode()).hexdigest()[:8]

    @property
    def hardware_label(self) -> str:
        """One line for the machine a run was measured on; runs of different lines never share a speed chart."""
        parts = [_short(self.hardware[key]) for key in ("gpu", "device", "cpu") if self.hardware.get(key)]
        cores = self.hardware.get("cores")
        if cores:
            parts.append(f"{_short(cores)} core{'' if cores == 1 else 's'}")
        return ", ".join(parts) or "hardware not recorded"

    @property
    def file_name(self) -> str:
        """METHOD__SCENE__PRESET__seedK__DIGEST8.json, a convenience: identity is in the file."""
        exact = hashlib.sha256(f"{self.digests.submission} {self.digests.protocol}".encode()).hexdigest()
        parts = (self.method, self.scene, self.preset)
        return "__".join([*(_UNSAFE.sub("-", part)[:60] for part in parts), f"seed{self.seed}", exact[:8]]) + ".json"

    def save(self, directory: Path) -> Path:
        """Write the result into `directory` under `file_name`; returns the path."""
        path = Path(directory, self.file_name)
        write_model(path, self)
        return path

    @classmethod
    def load(cls, path: Path) -> Result:
        """Read a result, which may be a stranger's; one-line errors name the file and the entry.

        Raises SplashbenchError for what `splashbench score` never writes, see `faults`.
        """
        result = read_model(path, cls)
        fault = next(result.faults(), None)
        if fault is not None:
            raise SplashbenchError(f"{path}: {fault}; score the submission again")
        return result

    def faults(self) -> Iterator[str]:
        """What scoring never writes, a line each: unknown statuses, figures out of range or apart from their frames."""
        yield from self._name_faults()
        if self.status not in _STATUSES:
            yield f"status is {_short(self.status)!r}, which no run has ({', '.join(sorted(_STATUSES))})"
        if self.digests.protocol != self.protocol.digest:
            yield "digests.protocol is not that of its protocol"
        if len(self.claimed) > MAX_CLAIMS:
            yield f"claimed has {len(self.claimed)} figures, more than {MAX_CLAIMS}"
        for name, metric in self.metrics.items():
            fault = self._range_fault(name, metric.value) or _mean_fault(name, metric)
            if fault:
                yield f"metrics.{_short(name)} {fault}"
            if metric.value is not None and self.status != Status.OK.value and _is_score(name):
                yield f"metrics.{name} has a value, yet the run ended with status {_short(self.status)}"
        for number, checkpoint in enumerate(self.checkpoints):
            for name, value in checkpoint.metrics.items():
                fault = self._range_fault(name, value)
                if fault:
                    yield f"checkpoints.{number}.{_short(name)} {fault}"
        seconds = [checkpoint.seconds for checkpoint in self.checkpoints]
        if any(later < earlier for earlier, later in pairwise(seconds)) or max(seconds, default=0) > MOST:
            yield "the seconds of its checkpoints do not rise"

    def _name_faults(self) -> Iterator[str]:
        names = {"method": self.method, "scene": self.scene, "preset": self.preset, "version": self.method_version}
        for what, text in names.items():
            if len(text) > MAX_NAME:
                yield f"{what} has {len(text)} letters, more than {MAX_NAME}"
            elif not text.isprintable():
                yield f"{what} has control characters"

    def _range_fault(self, name: str, value: float | None) -> str:
        return range_fault(name, value, self.protocol.psnr_cap_db)


def metric_value(
    name: str,
    value: float | None,
    reason: str | None = None,
    *,
    skipped_frames: int = 0,
    views: dict[str, ViewValues] | None = None,
    frames: tuple[float | None, ...] = (),
) -> MetricValue:
    """A MetricValue of registry entry `name`. A null needs a reason."""
    if value is None and not reason:
        raise ValueError(f"{name} is null without a reason")
    metric = METRICS[name]
    return MetricValue(
        value=value,
        reason=None if value is not None else reason,
        unit=metric.unit,
        better=metric.better,
        version=metric.version,
        skipped_frames=skipped_frames,
        views=views or {},
        frames=frames,
    )


def frame_mean(name: str, frames: list[float | None], reason: str) -> MetricValue:
    """Metric `name` as the mean over the frames that have a value; null for `reason` where none has."""
    skipped = sum(value is None for value in frames)
    return metric_value(name, mean(frames), reason, skipped_frames=skipped, frames=tuple(frames))


def _short(value: Any) -> str:
    """`value` on one bounded line: it may come from a stranger's file."""
    text = one_line(str(value))
    return text if len(text) <= _MAX_HARDWARE else text[: _MAX_HARDWARE - 1] + "…"


def _is_score(name: str) -> bool:
    return name in METRICS and METRICS[name].group != "cost"


def _mean_fault(name: str, metric: MetricValue) -> str:
    """Why the value of metric `name` is not that of its views or frames, in words; "" where it is, or has none."""
    if name in MEANS_OF_VIEWS and metric.views:
        for camera, view in metric.views.items():
            if view.frames and not _same(view.value, mean(list(view.frames))):
                return f"of view {_short(camera)} is not the mean of its frames"
        if not _same(metric.value, mean([view.value for view in metric.views.values()])):
            return "is not the mean of its views"
    if name in MEANS_OF_FRAMES and metric.frames and not _same(metric.value, mean(list(metric.frames))):
        return "is not the mean of its frames"
    return ""


def _same(stated: float | None, computed: float | None) -> bool:
    if stated is None or computed is None:
        return stated is computed
    return math.isclose(stated, computed, rel_tol=1e-6, abs_tol=1e-6)


def mean(values: list[float | None]) -> float | None:
    """Mean of the values that are there, None where none is."""
    numbers = [value for value in values if value is not None]
    return float(np.mean(numbers)) if numbers else None

"""A result: one immutable JSON per method, scene, preset and seed, with every value behind every mean.

A figure that cannot be computed is null, with a reason. A failed run is a result with a status, a reason and nulls,
never with a score. Results name by digest what they were computed from.
"""

from __future__ import annotations

import hashlib
import json
import re
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
from pydantic import BaseModel, ConfigDict, Field, field_validator

from splashbench.files import read_model, write_model
from splashbench.score.metrics import METRICS, Better
from splashbench.score.settings import Protocol
from splashbench.submission import Decision, with_current_names

_UNSAFE = re.compile(r"[^A-Za-z0-9_.+-]+")


class _Frozen(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True)


class ViewValues(_Frozen):
    """A metric in one test view: its mean and the value of each frame, null for a skipped one."""

    value: float | None = Field(default=None, allow_inf_nan=False)
    frames: tuple[float | None, ...] = ()


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
    frames: tuple[float | None, ...] = ()


class CheckpointScore(_Frozen):
    """The image metrics of the fit on its way, `seconds` after its begin: means alone, null for what has none.

    Where `status` is not ok there are no views to score, for `reason`.
    """

    seconds: float = Field(ge=0, allow_inf_nan=False)
    status: str = "ok"
    reason: str = ""
    storage_bytes: int | None = Field(default=None, ge=0)
    metrics: dict[str, Annotated[float, Field(allow_inf_nan=False)] | None] = Field(default_factory=dict)


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
    withheld: str | None = None
    status: str
    reason: str = ""
    protocol: Protocol
    digests: Digests
    metrics: dict[str, MetricValue]
    checkpoints: tuple[CheckpointScore, ...] = ()
    stages: dict[str, float] = Field(default_factory=dict)
    notes: dict[str, str] = Field(default_factory=dict)
    decisions: list[Decision] = Field(default_factory=list)
    claimed: dict[str, float] = Field(default_factory=dict)
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
        parts = [str(self.hardware[key]) for key in ("gpu", "device", "cpu") if self.hardware.get(key)]
        cores = self.hardware.get("cores")
        if cores:
            parts.append(f"{cores} core{'' if cores == 1 else 's'}")
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
        """Read a result; one-line errors name the file and the entry."""
        return read_model(path, cls)


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


def mean(values: list[float | None]) -> float | None:
    """Mean of the values that are there, None where none is."""
    numbers = [value for value in values if value is not None]
    return float(np.mean(numbers)) if numbers else None

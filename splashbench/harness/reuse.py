"""A part of a fit that several runs share, such as a frozen background: fitted once, then loaded.

This happens only where the harness gives a run a folder for it (`Run.cache`), as a study does for its variants.
Ordinary runs fit everything. The seconds of the part's fit stay with it, so that no run's fit time leaves them out.
"""

from __future__ import annotations

import hashlib
import json
import os
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Generic, TypeVar

from filelock import FileLock
from pydantic import BaseModel, ConfigDict, Field

from splashbench.files import atomic_directory, read_model, sha256_file, write_model
from splashbench.scene import TrainingScene
from splashbench.version import __version__

T = TypeVar("T")

_RECORD = "reuse.json"


class PartRecord(BaseModel):
    """reuse.json: what the part is, by everything it depends on, and how long its fit took."""

    model_config = ConfigDict(extra="forbid")
    name: str
    key: dict[str, Any]
    seconds: float = Field(ge=0)


@dataclass(frozen=True)
class Part(Generic[T]):
    """A part of a fit, as `reuse` gives it.

    Attributes:
        value: what was fitted or loaded.
        loaded_seconds: of its fit in the earlier run that it comes from; None where it was fitted now.
        overhead_seconds: time spent on waiting, reading and writing, which an ordinary run would not spend.
    """

    value: T
    loaded_seconds: float | None
    overhead_seconds: float


def reuse(
    cache: Path,
    name: str,
    scene_digest: str,
    key: Mapping[str, Any],
    fit: Callable[[], T],
    save: Callable[[T, Path], None],
    load: Callable[[Path], T],
) -> Part[T]:
    """The part `name` from the folder `cache`, fitted and written there where it is not yet.

    Of runs at the same time one fits and the others wait.

    Args:
        scene_digest: see `training_digest`.
        key: what the part depends on besides the scene, in values that JSON has.
        save, load: as in `Fitted.save` and `Method.load`, with a folder of its own.
    """
    start = time.perf_counter()
    dependencies = {"splashbench": __version__, "scene": scene_digest, **key}
    digest = hashlib.sha256(json.dumps([name, dependencies], sort_keys=True).encode()).hexdigest()[:16]
    place = Path(cache, f"{name}-{digest}")
    place.parent.mkdir(parents=True, exist_ok=True)
    with FileLock(place.with_suffix(".lock")):
        if (place / _RECORD).is_file():
            value, record = load(place), read_model(place / _RECORD, PartRecord)
            return Part(value, record.seconds, time.perf_counter() - start)
        before_fit = time.perf_counter()
        value = fit()
        after_fit = time.perf_counter()
        with atomic_directory(place) as staging:
            save(value, staging)
            write_model(staging / _RECORD, PartRecord(name=name, key=dependencies, seconds=after_fit - before_fit))
        return Part(value, None, time.perf_counter() - start - (after_fit - before_fit))


def training_digest(scene: TrainingScene) -> str:
    """SHA-256 over every file below the scene's folder: all that a method can have read."""
    digest = hashlib.sha256()
    for root, folders, names in os.walk(scene.directory):
        folders.sort()
        for name in sorted(names):
            path = Path(root, name)
            entry = [path.relative_to(scene.directory).as_posix(), sha256_file(path)]
            digest.update(json.dumps(entry).encode())
    return digest.hexdigest()

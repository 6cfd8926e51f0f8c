"""Reading a folder of results, and what tells one entry of a table from another."""

from __future__ import annotations

import hashlib
import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from splashbench.errors import SplashbenchError
from splashbench.score.result import Result


@dataclass(frozen=True)
class Source:
    """A result and the file it came from (relative to the folder read)."""

    path: str
    result: Result


def load_results(location: Path) -> list[Source]:
    """Every result (*.json) below the folder `location`, or the one file, in one order on every machine.

    A submission scored twice by the same protocol counts once: the result with more figures (one scored with a
    reference, or with LPIPS weights) stands. Raises SplashbenchError for a file that is no result, and where there
    is none.
    """
    location = Path(location)
    files = [location] if location.is_file() else sorted(location.rglob("*.json"))
    files = [path for path in files if not path.name.startswith(".")]
    if not files:
        raise SplashbenchError(f"{location} holds no results (*.json); make some with `splashbench score`")
    root = location.parent if location.is_file() else location
    kept: dict[tuple[str, ...], Source] = {}
    for path in files:
        source = Source(path.relative_to(root).as_posix(), Result.load(path))
        digests = source.result.digests
        key = (digests.scene, digests.submission, digests.protocol)
        if key not in kept or _known(source.result) > _known(kept[key].result):
            kept[key] = source
    return sorted(kept.values(), key=lambda source: (*_order(source.result), source.path))


def _known(result: Result) -> int:
    return sum(metric.value is not None for metric in result.metrics.values())


def _order(result: Result) -> tuple[str, str, str, int]:
    return (result.scene, result.method, result.preset, result.seed)


def settings_digest(result: Result) -> str:
    """Eight hex digits naming the method's version and settings: runs that differ in them are never averaged."""
    text = json.dumps([result.method_version, result.settings], sort_keys=True, default=str)
    return hashlib.sha256(text.encode()).hexdigest()[:8]


def hardware_label(hardware: dict[str, Any]) -> str:
    """One line for the machine a run was measured on; runs of different lines never share a speed chart."""
    parts = [str(hardware[key]) for key in ("gpu", "device", "cpu") if hardware.get(key)]
    if hardware.get("cores"):
        parts.append(f"{hardware['cores']} core{'' if hardware['cores'] == 1 else 's'}")
    return ", ".join(parts) or "hardware not recorded"

"""The results in a folder: every file read, repeats refused, order fixed."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path

from splashbench.errors import SplashbenchError
from splashbench.score.result import Result

#: Figures that are charted, with the least each can be; no figure comes near the largest.
_CHARTED = {"psnr": -1e15, "lpips": 0.0, "miou": 0.0, "fit_seconds": 0.0}
_CHARTED_MAX = 1e15


@dataclass(frozen=True)
class ResultFile:
    """A result and the file it came from (relative to the folder read)."""

    path: str
    result: Result


def load_results(location: Path) -> list[ResultFile]:
    """Every result (*.json) below the folder `location`, or the one file, in one order on every machine.

    A submission scored twice by the same protocol counts once: the result with more figures is used, such as the one
    scored with LPIPS weights. Raises SplashbenchError for a file that is no result, and for a folder without any.
    """
    location = Path(location)
    if (location / "submission.toml").is_file():
        raise SplashbenchError(f"{location} is a submission, not results; score it first with `splashbench score`")
    files = [location] if location.is_file() else sorted(location.rglob("*.json"))
    # What a killed process left behind has a name that begins with a dot, and so has a folder of such.
    files = [path for path in files if not any(part.startswith(".") for part in path.relative_to(location).parts)]
    if not files:
        raise SplashbenchError(f"{location} holds no results (*.json); make some with `splashbench score`")
    root = location.parent if location.is_file() else location
    by_digests: dict[tuple[str, ...], ResultFile] = {}
    for path in files:
        source = ResultFile(path.relative_to(root).as_posix(), _plausible(path, Result.load(path)))
        digests = source.result.digests
        key = (digests.scene, digests.submission, digests.protocol)
        if key not in by_digests or _figure_count(source.result) > _figure_count(by_digests[key].result):
            by_digests[key] = source
    sources = sorted(by_digests.values(), key=lambda source: (*_order(source.result), source.path))
    _refuse_repeats(sources)
    return sources


def _refuse_repeats(sources: list[ResultFile]) -> None:
    """Raise SplashbenchError for two submissions of one method, settings, scene and seed: an old and a new run."""
    seen: dict[tuple[str, ...], ResultFile] = {}
    for source in sources:
        result = source.result
        same = (result.digests.scene, result.protocol_label, result.method, result.preset)
        key = (*same, str(result.seed), result.settings_digest, result.hardware_label)
        if key in seen:
            raise SplashbenchError(
                f"{seen[key].path} and {source.path} are two runs of {result.method} with one seed and the same "
                "settings; remove the older one, or raise the method's version"
            )
        seen[key] = source


def _plausible(path: Path, result: Result) -> Result:
    """`result`. Raises SplashbenchError where a charted figure is out of range."""
    for name, least in _CHARTED.items():
        values = [(f"metrics.{name}", result.value(name))]
        values += [(f"checkpoints.{k}.{name}", c.metrics.get(name)) for k, c in enumerate(result.checkpoints)]
        for where, value in values:
            if value is not None and not least <= value <= _CHARTED_MAX:
                raise SplashbenchError(f"{path}: {where} is {value:g}, which no run has; score the submission again")
    seconds = [checkpoint.seconds for checkpoint in result.checkpoints]
    if any(later < earlier for earlier, later in pairwise(seconds)) or max(seconds, default=0) > _CHARTED_MAX:
        raise SplashbenchError(f"{path}: the seconds of its checkpoints do not rise; score the submission again")
    return result


def _figure_count(result: Result) -> int:
    return sum(metric.value is not None for metric in result.metrics.values())


def _order(result: Result) -> tuple[str, str, str, int]:
    return (result.scene, result.method, result.preset, result.seed)

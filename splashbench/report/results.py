"""The results in a folder: every file read, bad ones named and left out, repeats refused, order fixed."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace
from pathlib import Path

from splashbench.errors import SplashbenchError
from splashbench.score.metrics import METRICS
from splashbench.score.result import Result
from splashbench.score.verification import Difference, Verification, contradictions


@dataclass(frozen=True)
class ResultFile:
    """A result and the file it came from (relative to the folder read).

    verification: what scoring its submission again gave, where that was asked for. `result` is then the one that was
    computed here, not the one in the file, where there is one.
    """

    path: str
    result: Result
    verification: Verification | None = None


@dataclass(frozen=True)
class LeftOut:
    """A file that is in no table, and why."""

    path: str
    reason: str


@dataclass(frozen=True)
class Reading:
    """What a folder of results holds. left_out: files that could not be used; each costs its own row alone."""

    sources: list[ResultFile]
    left_out: list[LeftOut]


def load_results(location: Path) -> list[ResultFile]:
    """The results of `read_results`, where none is left out. Raises SplashbenchError for the first one that is."""
    reading = read_results(location)
    if reading.left_out:
        raise _error(Path(location), reading.left_out[0])
    return reading.sources


def read_results(location: Path, verify: Callable[[Result, Path], Verification] | None = None) -> Reading:
    """Every result (*.json) below the folder `location`, or the one file, in one order on every machine.

    Args:
        verify: scores the submission of a result again, given the folder that the result lies in.

    A submission scored twice by the same protocol counts once: the result with more figures is used, such as the one
    scored with LPIPS weights. Two that contradict each other are both left out, unless `verify` tells which is right.
    So are two runs of one method, settings, scene and seed. Raises SplashbenchError where no result is left.
    """
    location = Path(location)
    if (location / "submission.toml").is_file():
        raise SplashbenchError(f"{location} is a submission, not results; score it first with `splashbench score`")
    files = [location] if location.is_file() else sorted(location.rglob("*.json"))
    # What a killed process left behind has a name that begins with a dot, and so has a folder of such. A submission
    # that lies beside its result, to be verified, holds documents that are no results.
    files = [path for path in files if not any(part.startswith(".") for part in path.relative_to(location).parts)]
    sealed: dict[Path, bool] = {}
    files = [path for path in files if not _in_submission(path.parent, location, sealed)]
    if not files:
        raise SplashbenchError(f"{location} holds no results (*.json); make some with `splashbench score`")
    root = location.parent if location.is_file() else location
    sources: list[ResultFile] = []
    left_out: list[LeftOut] = []
    for path in files:
        name = path.relative_to(root).as_posix()
        try:
            source = ResultFile(name, Result.load(path))
        except SplashbenchError as error:
            left_out.append(LeftOut(name, str(error).removeprefix(f"{path}: ").removeprefix(f"{path} ")))
            continue
        if verify is not None:
            verification = verify(source.result, path.parent)
            source = replace(source, result=verification.result or source.result, verification=verification)
        sources.append(source)
    sources = _one_each(sources, left_out)
    sources.sort(key=lambda source: (*_order(source.result), source.path))
    sources = _without_repeats(sources, left_out)
    if not sources:
        raise _error(location, left_out[0])
    return Reading(sources, sorted(left_out, key=lambda each: each.path))


def _error(location: Path, bad: LeftOut) -> SplashbenchError:
    place = location if location.is_file() else location / bad.path
    return SplashbenchError(f"{place}: {bad.reason}")


def _in_submission(folder: Path, location: Path, known: dict[Path, bool]) -> bool:
    """Whether `folder`, which lies in `location`, is part of a submission."""
    if folder == location or folder == location.parent:
        return False
    if folder not in known:
        known[folder] = (folder / "submission.toml").is_file() or _in_submission(folder.parent, location, known)
    return known[folder]


def _one_each(sources: Iterable[ResultFile], left_out: list[LeftOut]) -> list[ResultFile]:
    """One of each submission and protocol: what was verified first, then the one with more figures."""
    by_digests: dict[tuple[str, ...], list[ResultFile]] = {}
    for source in sources:
        digests = source.result.digests
        by_digests.setdefault((digests.scene, digests.submission, digests.protocol), []).append(source)
    kept = []
    for same in by_digests.values():
        true = [source for source in same if source.verification and source.verification.verdict == "confirmed"]
        if true:
            for source in same:
                if source.verification and source.verification.verdict == "differs":
                    text = f"is not what its submission gives: {shown_differences(source.verification.differences)}"
                    left_out.append(LeftOut(source.path, f"{text}; {true[0].path} is"))
            same = true
        first = same[0]
        contradicted = None
        for source in same[1:]:
            if source.verification is None or source.verification.result is None:  # else both were computed here
                contradicted = contradicted or next(
                    ((source, different) for different in contradictions(first.result, source.result)), None
                )
        if contradicted is not None:
            other, different = contradicted
            for source in same:
                twin = other.path if source is first else first.path
                reason = (
                    f"and {twin} are of one submission and contradict each other: {different.name} {different.stated} "
                    f"and {different.verified}; remove the wrong one, or let --verify find it"
                )
                left_out.append(LeftOut(source.path, reason))
            continue
        kept.append(max(same, key=lambda source: _figure_count(source.result)))
    return kept


def _without_repeats(sources: list[ResultFile], left_out: list[LeftOut]) -> list[ResultFile]:
    """`sources` without those of one method, settings, scene, seed and hints: an old and a new run."""
    by_run: dict[tuple[str, ...], list[ResultFile]] = {}
    for source in sources:
        result = source.result
        same = (result.digests.scene, result.protocol_label, result.method, result.preset)
        key = (*same, str(result.seed), result.settings_digest, result.hardware_label, str(result.told))
        by_run.setdefault(key, []).append(source)
    repeated = set()
    for runs in by_run.values():
        for n, source in enumerate(runs if len(runs) > 1 else ()):
            twin = runs[0 if n else 1]
            repeated.add(source.path)
            reason = (
                f"and {twin.path} are two runs of {source.result.method} with one seed and the same settings, "
                "told the same; remove the older one, or raise the method's version"
            )
            left_out.append(LeftOut(source.path, reason))
    return [source for source in sources if source.path not in repeated]


def shown_differences(found: Iterable[Difference], most: int = 5) -> str:
    """The first of `found` in words."""
    listed = list(found)
    more = f" and {len(listed) - most} more" if len(listed) > most else ""
    return ", ".join(map(str, listed[:most])) + more


def claimed_text(name: str, verifications: Iterable[Verification | None]) -> str:
    """What results state of metric `name` other than their submissions give, to stand behind the verified figure."""
    stated = [
        different.stated for each in verifications if each for different in each.differences if different.name == name
    ]
    return f" (claimed {', '.join(dict.fromkeys(stated))})" if stated else ""


def _figure_count(result: Result) -> tuple[int, int, bool]:
    """How much a result says: figures, then states on the way, then whether it notes what the scene told."""
    figures = sum(result.value(name) is not None for name in METRICS)
    return figures, len(result.checkpoints), result.told is not None


def _order(result: Result) -> tuple[str, str, str, int]:
    return (result.scene, result.method, result.preset, result.seed)

"""Results recomputed: what a result states beside what scoring its submission again gives (docs/protocol.md).

It finds results that were edited. It does not find a forged submission: for that the method has to be run again.
"""

from __future__ import annotations

import os
from collections.abc import Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal

from splashbench.errors import SplashbenchError
from splashbench.files import sha256_file
from splashbench.scene import Scene
from splashbench.score.metrics import METRICS
from splashbench.score.protocol import score_submission
from splashbench.score.ranges import agree
from splashbench.score.result import Result
from splashbench.submission import Submission
from splashbench.submission.submission import SUMS

Verdict = Literal["confirmed", "differs", "not verified"]
#: Folders that are looked into for submissions or scenes, and how deep below the one that is named.
_MAX_FOLDERS, _MAX_DEPTH = 100_000, 6
#: What names a run: in these a result has to say what its submission says.
_NAMES = (
    *("method", "method_version", "scene", "seed", "preset", "status", "control", "mixed", "withheld"),
    *("settings_digest", "hardware_label", "told"),
)


@dataclass(frozen=True)
class Difference:
    """One thing that a result states and its submission does not bear out, as text. name: a metric's, or a field's."""

    name: str
    stated: str
    verified: str

    def __str__(self) -> str:
        return f"{self.name} {self.stated}, verified {self.verified}"


@dataclass(frozen=True)
class Verification:
    """What became of one result.

    Attributes:
        verdict: "confirmed", "differs", or "not verified" for `reason`.
        result: scored again from the submission; None where that was not possible.
        differences: what the result states otherwise. unchecked: metrics it states that could not be computed here.
    """

    verdict: Verdict
    reason: str = ""
    result: Result | None = None
    differences: tuple[Difference, ...] = ()
    unchecked: tuple[str, ...] = ()


@dataclass
class Evidence:
    """Where submissions and scenes are looked for, by their digests.

    Attributes:
        submissions, scenes: folders that are one, or hold some.
        lpips_weights: see `splashbench.score.image.lpips.load_lpips`.
    """

    submissions: Sequence[Path] = ()
    scenes: Sequence[Path] = ()
    lpips_weights: Path | None = None
    _found: dict[Path, dict[str, Path]] = field(default_factory=dict, init=False, repr=False)
    _scenes: list[Scene] | None = field(default=None, init=False, repr=False)

    def verify(self, result: Result, beside: Path) -> Verification:
        """Score the submission of `result` again. beside: a folder that is looked into before `submissions`."""
        try:
            return self._verified(result, beside)
        except SplashbenchError as error:
            return Verification("not verified", str(error))

    def _verified(self, result: Result, beside: Path) -> Verification:
        digests = result.digests
        place = self._submission(digests.submission, beside)
        if place is None:
            reason = f"its submission {digests.submission[:12]} lies neither beside it nor in what --submissions names"
            return Verification("not verified", reason)
        submission = Submission.open(place)
        scene = self._scene(submission)
        if scene is None:
            reason = f"its scene {submission.identity.scene} is in no folder that is given for scenes"
            return Verification("not verified", reason)
        reference = None
        if digests.reference is not None:
            found = self._submission(digests.reference, beside)
            reference = None if found is None else Submission.open(found)
        rescored = score_submission(scene, submission, reference, self.lpips_weights, protocol=result.protocol)
        different = tuple(differences(result, rescored))
        unchecked = tuple(name for name in METRICS if result.value(name) is not None and rescored.value(name) is None)
        # A figure that its submission has no ground for differs; one that lacks weights or the reference is unchecked.
        return Verification("differs" if different else "confirmed", "", rescored, different, unchecked)

    def _submission(self, digest: str, beside: Path) -> Path | None:
        for folder in (beside, *self.submissions):
            if folder not in self._found:
                self._found[folder] = dict(_by_digest(folder))
            if digest in self._found[folder]:
                return self._found[folder][digest]
        return None

    def _scene(self, submission: Submission) -> Scene | None:
        if self._scenes is None:
            self._scenes = list(_opened(self.scenes))
        wanted = submission.identity
        # Digests take reading every file: those of the same name first.
        for scene in sorted(self._scenes, key=lambda scene: scene.name != wanted.scene):
            with suppress(SplashbenchError, OSError):  # of a scene with a file missing: it is not the one
                if scene.digest == wanted.scene_digest:
                    return scene
        return None


def contradictions(first: Result, second: Result) -> Iterator[Difference]:
    """What two results of one submission both state and cannot both be right about, in whichever order.

    An older one lacks what was not noted then, and one that was scored without weights or truth lacks their figures.
    """
    lacks = {name for name in METRICS if first.value(name) is None or second.value(name) is None}
    if first.told is None or second.told is None:
        lacks.add("told")
    if not first.checkpoints or not second.checkpoints:
        lacks.add("checkpoints")
    yield from (different for different in differences(first, second) if different.name not in lacks)


def differences(stated: Result, verified: Result) -> Iterator[Difference]:
    """What `stated` says otherwise than `verified`: names of the run, the scene's bytes, and figures both have."""
    for name in _NAMES:
        was, now = getattr(stated, name), getattr(verified, name)
        if was != now and not (name == "told" and was is None):  # older results did not note it
            yield Difference(name, str(was), str(now))
    if stated.digests.scene != verified.digests.scene:
        yield Difference("scene's bytes", stated.digests.scene[:12], verified.digests.scene[:12])
    for name, metric in METRICS.items():
        was, now = stated.value(name), verified.value(name)
        if was is None:
            continue
        if now is not None and not agree(name, was, now):
            yield Difference(name, f"{was:.{metric.decimals}f}", f"{now:.{metric.decimals}f}")
        elif now is None and _cannot_have(name, verified):
            yield Difference(name, f"{was:.{metric.decimals}f}", "none")
    if len(stated.checkpoints) != len(verified.checkpoints):
        yield Difference("checkpoints", str(len(stated.checkpoints)), str(len(verified.checkpoints)))
        return
    for number, (first, second) in enumerate(zip(stated.checkpoints, verified.checkpoints)):
        for name in METRICS:
            was, now = first.metrics.get(name), second.metrics.get(name)
            if was is not None and now is not None and not agree(name, was, now):
                yield Difference(f"checkpoint {number} {name}", f"{was:g}", f"{now:g}")


def _cannot_have(name: str, verified: Result) -> bool:
    """Whether the submission gives no figure of `name` at all, rather than for want of weights or a reference."""
    if name == "lpips":
        return verified.digests.lpips_weights is not None or verified.status != "ok"
    if name in ("dpsnr_bg", "spill_rgb"):
        return verified.digests.reference is not None or verified.status != "ok"
    return True


def _by_digest(folder: Path) -> Iterator[tuple[str, Path]]:
    """The submissions at or below `folder`, by digest. One whose list of sums cannot be read has none."""
    for place in _folders_with(folder, SUMS):
        with suppress(SplashbenchError, OSError):
            yield sha256_file(place / SUMS), place


def _folders_with(folder: Path, name: str) -> Iterator[Path]:
    """Folders at or below `folder`, links left out, that hold the file `name`; a folder that does is not gone into."""
    for seen, (root, folders, files) in enumerate(os.walk(folder)):
        place = Path(root)
        if name in files:
            folders.clear()
            yield place
        elif seen > _MAX_FOLDERS or len(place.relative_to(folder).parts) >= _MAX_DEPTH:
            folders.clear()
        else:
            folders[:] = sorted(each for each in folders if not each.startswith("."))


def _opened(places: Sequence[Path]) -> Iterator[Scene]:
    """The scenes at or right below `places`. Raises SplashbenchError for a place that is none and holds none."""
    for place in places:
        folders = [place, *sorted(p for p in place.iterdir() if p.is_dir())] if place.is_dir() else [place]
        found = []
        fault: SplashbenchError | None = None
        for folder in folders:
            try:
                found.append(Scene.open(folder))
            except SplashbenchError as error:
                fault = fault or error
            if found and folder == place:
                break
        if not found and fault is not None:
            raise fault
        yield from found

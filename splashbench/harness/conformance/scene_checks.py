"""Checks of what a fit depends on and touches: seeds, test views, the scene's files, scenes at the edge."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

from splashbench.harness.conformance.findings import Found, NotTested, Verdict, found
from splashbench.harness.conformance.messages import Answer
from splashbench.harness.conformance.model_checks import differences, rendered, whole, whole_fit
from splashbench.harness.conformance.trial import SEED, Trial
from splashbench.submission import Status


def same_seed(trial: Trial) -> Found:
    """Two fits that should be one."""
    fitted = whole_fit(trial)
    if _difference(trial) is None:
        return Verdict.OK, ""
    # The other fit could see the test views; only one that differs in nothing tells chance from peeping.
    refitted = whole(trial.refitted, "the second fit")
    return found(differences(rendered(fitted), rendered(refitted), f"in a second fit with seed {SEED}"))


def _difference(trial: Trial) -> str | None:
    """How the ordinary run, whose method could have read test views, differs from the fit without; None for not."""
    if trial.ran.status != Status.OK.value:
        return f"the run with them ended as {trial.ran.status}: {trial.ran.reason}"
    for answer in (trial.loaded, trial.reloaded):
        if not answer.done:
            return f"its model does not load: {answer.reason}"
    faults = differences(rendered(trial.loaded), rendered(trial.reloaded), "where they can be read")
    return faults[0] if faults else None


def other_seed(trial: Trial) -> Found:
    """A fit with another seed."""
    fitted, other = whole_fit(trial), trial.other_seed
    if not other.done:
        return Verdict.FAILED, f"{other.stage}: {other.reason}"
    same = rendered(fitted) == rendered(other)
    return Verdict.OK, "the result is the same" if same else "the result is another"


def hidden(trial: Trial) -> Found:
    """A fit without test views against one that could have read them."""
    if trial.ran.status != Status.OK.value:
        raise NotTested(f"the run with them ended as {trial.ran.status}: {trial.ran.reason}")
    if not trial.fitted.done:
        return Verdict.FAILED, f"without them it ends in {trial.fitted.stage}: {trial.fitted.reason}"
    whole(trial.loaded, "loading")
    whole(trial.reloaded, "loading")
    difference = _difference(trial)
    if difference is None:
        return Verdict.OK, ""
    if same_seed(trial)[0] != Verdict.OK:
        raise NotTested("two fits with one seed differ, so nothing can be told from a third")
    return Verdict.FAILED, difference


def unread(trial: Trial) -> Found:
    """Openings of test views, and whatever else of the scene is no business of a method."""
    _fit_and_load(trial)
    paths = {*trial.bench.opened, *(Path(touch.path) for touch in trial.bench.touches if touch.how != "written")}
    shown = sorted({_shown(path, [trial.ordinary.scene, trial.hidden.scene]) for path in paths})
    unseen = "" if trial.bench.watched else "; what native code opens cannot be seen on this system"
    return found([f"it looked into {name}" for name in shown], f"nothing outside the training view was opened{unseen}")


def _fit_and_load(trial: Trial) -> None:
    """Have the fit, and where it succeeds its model, made and watched."""
    if trial.fitted.done:
        _ = trial.loaded


def _shown(path: Path, folders: list[Path]) -> str:
    for folder in folders:
        if path.is_relative_to(folder):
            return path.relative_to(folder).as_posix() if path != folder else "the scene's folder"
    return str(path)


def unchanged(trial: Trial) -> Found:
    """The scene's files, and the training view's."""
    _ = trial.ran, trial.fitted
    before, now = trial.before, trial.contents()
    changed = sorted(name for name in before | now if before.get(name) != now.get(name))
    shown = dict.fromkeys(name.partition("/")[2] for name in changed)
    return found([f"{name} was changed" for name in shown])


def elsewhere(trial: Trial) -> Found:
    """Files written where nobody expects them."""
    _fit_and_load(trial)
    scenes = [trial.ordinary.scene, trial.hidden.scene, trial.ordinary.view, trial.hidden.view]
    paths = sorted({touch.path for touch in trial.bench.touches if touch.how == "written"})
    outside = [path for path in paths if not any(Path(path).is_relative_to(scene) for scene in scenes)]
    return found([f"it writes {path}" for path in outside], wrong=Verdict.WARNING)


def edge(which: Callable[[Trial], Answer]) -> Callable[[Trial], Found]:
    """A scene that a method may refuse."""

    def look(trial: Trial) -> Found:
        answer = which(trial)
        if answer.done:
            faults = [seen.fault for seen in answer.views.values() if seen.kind == "test" and seen.fault]
            faults += [held.fault for held in (answer.particles, answer.geometry) if held.fault]
            return found(faults, "it is reconstructed")
        if answer.clear:
            return Verdict.OK, f"it is refused: {answer.reason}"
        return Verdict.FAILED, f"it ends in {answer.stage}: {answer.reason or 'without a reason'}"

    return look

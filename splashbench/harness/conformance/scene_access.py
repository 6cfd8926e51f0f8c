"""Checks of what a fit depends on and touches: seeds, test views, the scene's files."""

from __future__ import annotations

from pathlib import Path

from splashbench.harness.conformance.evidence import SEED, Evidence, complete, complete_fit, differences
from splashbench.harness.conformance.report import Judgement, NotTested, Verdict, check, judge
from splashbench.submission import Status


@check(
    "two fits with one seed give the same bytes",
    "draw every random number from generators seeded with run.seed; depend on no time, path, hash order or race",
)
def same_seed(evidence: Evidence) -> Judgement:
    fitted = complete_fit(evidence)
    if _difference(evidence) is None:
        return Verdict.OK, ""
    # The other fit could see the test views. Only one that differs in nothing tells chance from a look at them.
    refitted = complete(evidence.refitted, "the second fit")
    return judge(differences(fitted.digests, refitted.digests, f"in a second fit with seed {SEED}"))


def _difference(evidence: Evidence) -> str | None:
    """How the ordinary run, whose method could have read test views, differs from the fit without; None for not."""
    if not evidence.run.ok:
        return _run_fault(evidence)
    for answer in (evidence.loaded, evidence.reloaded):
        if not answer.done:
            return f"its model does not load: {answer.reason}"
    faults = differences(evidence.loaded.digests, evidence.reloaded.digests, "where they can be read")
    return faults[0] if faults else None


def _run_fault(evidence: Evidence) -> str:
    return f"the run with them ended as {evidence.run.status}: {evidence.run.reason}"


@check(
    "states of the fit on its way render, and taking them changes nothing",
    "let the function given to run.checkpoint() copy what it needs, and change nothing that the fit goes on with",
)
def checkpoints(evidence: Evidence) -> Judgement:
    if not evidence.run.ok:
        raise NotTested(f"the run without them ended as {evidence.run.status}")
    run = evidence.checkpointed
    if not run.ok:
        return Verdict.FAILED, f"{run.status}: {run.reason}"
    taken = run.record.checkpoints if run.record else []
    if not taken:
        return Verdict.OK, "none was offered: its end alone stands in charts of quality over time"
    bad = [f"after {c.seconds:.1f} s: {c.status.value}: {c.reason}" for c in taken if c.status != Status.OK]
    if bad:
        return Verdict.FAILED, bad[0]
    plain = complete(evidence.reloaded, "loading")
    watched = complete(evidence.reloaded_checkpointed, "loading")
    faults = differences(plain.digests, watched.digests, "where states were taken on the way")
    if faults and same_seed.judgement(evidence)[0] != Verdict.OK:
        raise NotTested("two fits with one seed differ, so nothing can be told from a third")
    return judge(faults, f"{len(taken)} states")


@check("another seed is accepted", "take any seed of 0 or more")
def other_seed(evidence: Evidence) -> Judgement:
    fitted, other = complete_fit(evidence), evidence.other_seed
    if not other.done:
        return Verdict.FAILED, f"{other.ended_in}: {other.reason}"
    same = fitted.digests == other.digests
    return Verdict.OK, "the result is the same" if same else "the result is another"


@check(
    "without the test images, masks and truth the result is the same",
    "use what TrainingScene gives, and nothing else",
)
def hidden_test_views(evidence: Evidence) -> Judgement:
    if not evidence.run.ok:
        raise NotTested(_run_fault(evidence))
    if not evidence.fitted.done:
        return Verdict.FAILED, f"without them it ends in {evidence.fitted.ended_in}: {evidence.fitted.reason}"
    complete(evidence.loaded, "loading")
    complete(evidence.reloaded, "loading")
    difference = _difference(evidence)
    if difference is None:
        return Verdict.OK, ""
    if same_seed.judgement(evidence)[0] != Verdict.OK:
        raise NotTested("two fits with one seed differ, so nothing can be told from a third")
    return Verdict.FAILED, difference


@check(
    "no test image, mask or truth is opened, nor looked for",
    "read images and masks through scene.image() and scene.mask() of training cameras alone",
)
def unread_test_views(evidence: Evidence) -> Judgement:
    _fit_and_load(evidence)
    bench, folders = evidence.bench, [evidence.ordinary.scene, evidence.hidden.scene]
    paths = {*bench.opened, *(Path(touch.path) for touch in bench.touches if touch.how != "written")}
    names = sorted({_name(path, folders) for path in paths})
    unseen = "" if bench.complete else "; what native code opens cannot be seen on this system"
    return judge([f"it looked into {name}" for name in names], f"nothing outside the training copy was opened{unseen}")


def _fit_and_load(evidence: Evidence) -> None:
    """Have the fit, and where it succeeds its model, made and watched."""
    if evidence.fitted.done:
        _ = evidence.loaded


def _name(path: Path, folders: list[Path]) -> str:
    for folder in folders:
        if path.is_relative_to(folder):
            return path.relative_to(folder).as_posix() if path != folder else "the scene's folder"
    return str(path)


@check("the scene is left as it was", "write into run.directory; the scene's files are links to the user's own")
def unchanged_scene(evidence: Evidence) -> Judgement:
    _ = evidence.run, evidence.fitted
    before, now = evidence.before, evidence.contents()
    changed = sorted(name for name in before | now if before.get(name) != now.get(name))
    names = dict.fromkeys(name.partition("/")[2] for name in changed)
    return judge([f"{name} was changed" for name in names])


@check(
    "files are written in run.directory, the model's folder, the temporary folder and caches alone",
    "write scratch files into run.directory, which the harness removes",
)
def writes(evidence: Evidence) -> Judgement:
    _fit_and_load(evidence)
    folders = [folder for copy in (evidence.ordinary, evidence.hidden) for folder in (copy.scene, copy.training)]
    paths = sorted({touch.path for touch in evidence.bench.touches if touch.how == "written"})
    outside = [path for path in paths if not any(Path(path).is_relative_to(folder) for folder in folders)]
    return judge([f"it writes {path}" for path in outside], verdict=Verdict.WARNING)

"""The checks of the conformance test, in the order in which a method's author can mend what they find."""

from __future__ import annotations

import signal
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path

from splashbench.conformance.described import description_faults
from splashbench.conformance.findings import NotTested, Verdict
from splashbench.conformance.messages import Answer, Held, Kind, Seen
from splashbench.conformance.stopping import Stopped, ignores_interrupts
from splashbench.conformance.stored import storage_faults
from splashbench.conformance.trial import SEED, Trial
from splashbench.scene import Scene
from splashbench.submission import Status, Submission, check_submission

#: A verdict, and what was found.
Found = tuple[Verdict, str]
_SHOWN = 3


@dataclass(frozen=True)
class Check:
    """One line of the test: its name, what it asks for, what to do where it fails, and how it is found out."""

    name: str
    about: str
    remedy: str
    look: Callable[[Trial], Found]


def _found(faults: list[str], ok: str = "", wrong: Verdict = Verdict.FAILED) -> Found:
    if not faults:
        return Verdict.OK, ok
    more = f" (and {len(faults) - _SHOWN} more)" if len(faults) > _SHOWN else ""
    return wrong, "; ".join(faults[:_SHOWN]) + more


def _whole(answer: Answer, what: str) -> Answer:
    """`answer`, unless it ended on the way."""
    if not answer.done:
        raise NotTested(f"{what} ended in {answer.stage}: {answer.reason}")
    return answer


def _fitted(trial: Trial) -> Answer:
    return _whole(trial.fitted, "the fit")


def _loaded(trial: Trial) -> Answer:
    _fitted(trial)
    return _whole(trial.loaded, "loading")


def _rendered(answer: Answer) -> dict[str, str]:
    """Everything that a model gave: name -> digest."""
    views = {name: seen.digest for name, seen in answer.views.items()}
    return views | {"its particles": answer.particles.digest, "its signed distance": answer.geometry.digest}


def _differing(one: Mapping[str, str], other: Mapping[str, str]) -> list[str]:
    return [name for name, digest in one.items() if other.get(name) != digest]


def _differ(names: list[str], than: str) -> list[str]:
    return [f"{names[0]} differs {than}" + (f", as {len(names) - 1} more do" if names[1:] else "")] if names else []


def _description(trial: Trial) -> Found:
    return _found(description_faults(trial.name, trial.method, trial.preset, trial.config))


def _fit(trial: Trial) -> Found:
    ran = trial.ran
    if ran.status == Status.OK.value:
        return Verdict.OK, f"the fit took {ran.fit_seconds:.1f} s"
    if ran.status == Status.UNSUPPORTED.value:
        return Verdict.FAILED, f"it does not take this scene: {ran.reason}; give one that it takes with --scene"
    return Verdict.FAILED, f"{ran.status}: {ran.reason}"


def _progress(trial: Trial) -> Found:
    answer = trial.fitted
    if answer.stage in ("import", "supports", "fit"):
        _whole(answer, "the fit")
    said = answer.said
    if not said.reports:
        return Verdict.FAILED, "fit() reported none"
    if not said.fault and not said.messages:
        return Verdict.FAILED, f"none of {said.reports} reports says what is being done"
    return _found([said.fault] if said.fault else [], f"{said.reports} reports")


def _files(trial: Trial) -> Found:
    _fitted(trial)
    return _found(storage_faults(trial.saved))


def _load(trial: Trial) -> Found:
    fitted = _fitted(trial)
    loaded = trial.loaded
    if not loaded.done:
        return Verdict.FAILED, f"{loaded.stage}: {loaded.reason}"
    return _found(_differ(_differing(_rendered(fitted), _rendered(loaded)), "from the model in memory"))


def _again(trial: Trial) -> Found:
    loaded = _loaded(trial)
    first = {name: seen.digest for name, seen in loaded.views.items()}
    return _found(_differ(_differing(first, loaded.again), "when all views are rendered again, the last one first"))


def _views(kind: Kind) -> Callable[[Trial], Found]:
    def look(trial: Trial) -> Found:
        # Of the model in memory, or, where that is fine, of the loaded one, which is what a run renders.
        answers = [_fitted(trial)] + ([trial.loaded] if trial.loaded.done else [])
        for answer in answers:
            seen: list[Seen] = [view for view in answer.views.values() if view.kind == kind]
            faults = [view.fault for view in seen if view.fault]
            if kind == "window" and answer.window_fault:
                faults.append(answer.window_fault)
            if faults:
                return _found(faults)
        if not seen:
            return Verdict.OK, "the scene has a single timestep"
        return Verdict.OK, f"{len(seen)} view{'s' if len(seen) > 1 else ''}"

    return look


def _held(which: Callable[[Answer], Held]) -> Callable[[Trial], Found]:
    def look(trial: Trial) -> Found:
        held = which(_fitted(trial))
        return _found([held.fault] if held.fault else [], held.about)

    return look


def _same_seed(trial: Trial) -> Found:
    fitted = _rendered(_fitted(trial))
    if _unhidden_differs(trial) is None:
        return Verdict.OK, ""
    # The other run saw the test views as well; only a fit that differs in nothing tells chance from peeping.
    refitted = _rendered(_whole(trial.refitted, "the second fit"))
    return _found(_differ(_differing(fitted, refitted), f"in a second fit with seed {SEED}"))


def _unhidden_differs(trial: Trial) -> str | None:
    """How the ordinary run, whose method could have read test views, differs from the fit without; None for not."""
    if trial.ran.status != Status.OK.value:
        return f"the run with them ended as {trial.ran.status}: {trial.ran.reason}"
    if not trial.reloaded.done:
        return f"its model does not load: {trial.reloaded.reason}"
    faults = _differ(_differing(_rendered(_loaded(trial)), _rendered(trial.reloaded)), "where they can be read")
    return faults[0] if faults else None


def _other_seed(trial: Trial) -> Found:
    _fitted(trial)
    answer = trial.other_seed
    if not answer.done:
        return Verdict.FAILED, f"{answer.stage}: {answer.reason}"
    same = not _differing(_rendered(trial.fitted), _rendered(answer))
    return Verdict.OK, "the result is the same" if same else "the result is another"


def _hidden(trial: Trial) -> Found:
    if not trial.fitted.done:
        if trial.ran.status != Status.OK.value:
            raise NotTested(f"the run ended as {trial.ran.status}")
        return Verdict.FAILED, f"without them it ends in {trial.fitted.stage}: {trial.fitted.reason}"
    if not trial.loaded.done:
        raise NotTested(f"loading ended: {trial.loaded.reason}")
    difference = _unhidden_differs(trial)
    if difference is None:
        return Verdict.OK, ""
    if trial.ran.status != Status.OK.value:
        raise NotTested(difference)
    if _same_seed(trial)[0] != Verdict.OK:
        raise NotTested("two fits with one seed differ, so nothing can be told from a third")
    return Verdict.FAILED, difference


def _unread(trial: Trial) -> Found:
    _ = trial.fitted, trial.fitted.done and trial.loaded
    places = (trial.ordinary, trial.hidden)
    paths = set(trial.opened)
    paths |= {Path(touch.path) for touch in trial.touches if touch.how in ("read", "listed")}
    shown = sorted({_shown(path, [place.scene for place in places]) for path in paths})
    unseen = "" if trial.watched else "; what native code opens cannot be seen on this system"
    return _found([f"it looked into {name}" for name in shown], f"nothing outside the training view was opened{unseen}")


def _shown(path: Path, folders: list[Path]) -> str:
    for folder in folders:
        if path.is_relative_to(folder):
            return path.relative_to(folder).as_posix() if path != folder else "the scene's folder"
    return str(path)


def _unchanged(trial: Trial) -> Found:
    _ = trial.ran, trial.fitted
    before, now = trial.before, trial.contents()
    changed = sorted(name for name in before | now if before.get(name) != now.get(name))
    shown = dict.fromkeys(name.partition("/")[2] for name in changed)
    return _found([f"{name} was changed" for name in shown])


def _elsewhere(trial: Trial) -> Found:
    _ = trial.fitted, trial.fitted.done and trial.loaded
    scenes = [trial.ordinary.scene, trial.hidden.scene, trial.ordinary.view, trial.hidden.view]
    paths = sorted({touch.path for touch in trial.touches if touch.how == "written"})
    outside = [path for path in paths if not any(Path(path).is_relative_to(scene) for scene in scenes)]
    return _found([f"it writes {path}" for path in outside], wrong=Verdict.WARNING)


def _time_limit(trial: Trial) -> Found:
    stopped, out = trial.stopped(None, _half_way(trial))
    if stopped.exit_code != 1 or not out.is_dir():
        return Verdict.FAILED, f"the run did not end with status timeout: {stopped.said or stopped.exit_code}"
    submission = Submission.open(out, verify=False)
    faults = check_submission(out, Scene.open(trial.ordinary.scene))
    if submission.status != Status.TIMEOUT:
        faults = [f"status {submission.status.value}: {submission.reason}", *faults]
    return _found([*faults, *_debris(out)], submission.reason)


def _half_way(trial: Trial) -> int:
    return max(1, _fitted(trial).said.reports // 2)


def _signals(trial: Trial) -> Found:
    # Early and late: a method may start processes and files of its own on the way.
    stops = {signal.SIGTERM: _half_way(trial)} | ({} if ignores_interrupts() else {signal.SIGINT: 1})
    faults = []
    for signum, report in stops.items():
        stopped, out = trial.stopped(signum, report)
        faults += [f"{signum.name}: {fault}" for fault in _signal_faults(stopped, signum, out)]
    return _found(faults, " and ".join(signum.name for signum in stops))


def _signal_faults(stopped: Stopped, signum: signal.Signals, out: Path) -> list[str]:
    if not stopped.held:
        return [f"the fit did not get to its middle: {stopped.said or 'it said nothing'}"]
    if stopped.exit_code is None:
        return ["the run did not end"]
    faults = [] if stopped.exit_code == 128 + signum else [f"exit status {stopped.exit_code}: {stopped.said}"]
    return faults + (["there is a submission"] if out.exists() else []) + _debris(out)


def _debris(out: Path) -> list[str]:
    return [f"{path.name} was left beside the submission" for path in sorted(out.parent.iterdir()) if path != out]


def _processes(trial: Trial) -> Found:
    _ = trial.ran, trial.fitted
    return _found(trial.left)


def _edge(which: Callable[[Trial], Answer]) -> Callable[[Trial], Found]:
    def look(trial: Trial) -> Found:
        if trial.fitted.stage == "import":
            _fitted(trial)
        answer = which(trial)
        if answer.done:
            faults = [seen.fault for seen in answer.views.values() if seen.kind == "test" and seen.fault]
            faults += [held.fault for held in (answer.particles, answer.geometry) if held.fault]
            return _found(faults, "it is reconstructed")
        if answer.clear:
            return Verdict.OK, f"it is refused: {answer.reason}"
        return Verdict.FAILED, f"it ends in {answer.stage}: {answer.reason or 'without a reason'}"

    return look


CHECKS: tuple[Check, ...] = (
    Check(
        "metadata",
        "id, title, presets and settings are valid and survive being written",
        "mend the class's attributes and its Config, see CONTRIBUTING.md",
        _description,
    ),
    Check("fit", "a run through the harness ends as ok", "mend fit(), load() and render() until this run is ok", _fit),
    Check(
        "progress",
        "fit() reports its progress, in [0, 1], never backwards, and says what it does",
        "call run.progress(fraction, message) as the fit goes on",
        _progress,
    ),
    Check(
        "files",
        "save() writes plain files and no pickles",
        "write arrays with numpy.savez and settings as JSON; a pickle from a stranger runs code when it is read",
        _files,
    ),
    Check(
        "load",
        "loaded in a fresh process, from another place, the model renders the same bytes",
        "save everything that render() needs, in full precision, in the folder that save() is given",
        _load,
    ),
    Check(
        "again",
        "views rendered twice, in any order, are the same bytes",
        "let render() draw no random numbers and keep nothing from call to call that changes the result",
        _again,
    ),
    Check(
        "views",
        "every test view at every timestep has its size, is finite and in [0, 1]",
        "mend render(); what lies outside of [0, 1] by more than 0.5, and integers, are refused",
        _views("test"),
    ),
    Check(
        "between",
        "views between the timesteps, and a little outside of them, are whole as well",
        "render() is asked for any time; take the nearest timestep, or carry the liquid there",
        _views("between"),
    ),
    Check(
        "size",
        "a camera of another size and focal length is rendered at its own size",
        "take width, height and K from the camera that render() is given, never from the training views",
        _views("size"),
    ),
    Check(
        "principal_point",
        "a window of a view, with its principal point off the middle, shows that part of the view",
        "project with camera.K or camera.project(), principal point included",
        _views("window"),
    ),
    Check(
        "particles",
        "particles, where there are any, are finite and cover the timesteps",
        "return None or Particles of positions [T, N, 3] with T the scene's timesteps",
        _held(lambda answer: answer.particles),
    ),
    Check(
        "signed_distance",
        "the signed distance, where there is one, covers the timesteps",
        "return None or a SignedDistance of phi [T, nx, ny, nz] with T the scene's timesteps",
        _held(lambda answer: answer.geometry),
    ),
    Check(
        "same_seed",
        "two fits with one seed give the same bytes",
        "draw every random number from generators seeded with run.seed; depend on no time, path, hash order or race",
        _same_seed,
    ),
    Check("other_seed", "another seed is accepted", "take any seed of 0 or more", _other_seed),
    Check(
        "hidden_test_views",
        "without the test images, masks and truth the result is the same",
        "use what TrainingScene gives, and nothing else",
        _hidden,
    ),
    Check(
        "unread_test_views",
        "no test image, mask or truth is opened, nor looked for",
        "read images and masks through scene.image() and scene.mask() of training cameras alone",
        _unread,
    ),
    Check(
        "unchanged_scene",
        "the scene is left as it was",
        "write into run.directory; the scene's files are links to the user's own",
        _unchanged,
    ),
    Check(
        "writes",
        "files are written in run.directory, the model's folder, the temporary folder and caches alone",
        "write scratch files into run.directory, which the harness removes",
        _elsewhere,
    ),
    Check(
        "time_limit",
        "a fit that takes too long is stopped, with status timeout and nothing half-written",
        "write nothing beside the folders that the harness gives, and leave signals and process groups as they are",
        _time_limit,
    ),
    Check(
        "signals",
        "stopped by SIGTERM or Ctrl-C in the middle of the fit, a run leaves nothing half-written",
        "write nothing beside the folders that the harness gives, and leave signals and process groups as they are",
        _signals,
    ),
    Check(
        "processes",
        "no process outlives its run",
        "start processes in the method's own process group (no start_new_session, no daemons) and end them",
        _processes,
    ),
    Check(
        "one_frame",
        "a scene of one timestep is reconstructed, or refused with a reason",
        "return Support(False, reason) from supports(), or raise SplashbenchError with one clear line",
        _edge(lambda trial: trial.one_frame),
    ),
    Check(
        "no_liquid",
        "a scene without liquid is reconstructed, or refused with a reason",
        "return Support(False, reason) from supports(), or raise SplashbenchError with one clear line",
        _edge(lambda trial: trial.no_liquid),
    ),
)

"""Checks of the method and of a model that it fitted: what it states of itself, saves, loads and renders."""

from __future__ import annotations

import tempfile
from collections.abc import Callable
from pathlib import Path

from pydantic import ValidationError

from splashbench import toml
from splashbench.errors import SplashbenchError, one_line
from splashbench.files import write_text
from splashbench.harness.conformance.evidence import Evidence, complete, complete_fit, differences
from splashbench.harness.conformance.report import Check, Judgement, Verdict, check, judge
from splashbench.harness.conformance.storage import storage_faults
from splashbench.harness.conformance.subject import Answer
from splashbench.harness.conformance.views import Kind, ReturnedArrays
from splashbench.harness.runner import without_nulls
from splashbench.submission import Identity, Status, identity_text


@check(
    "id, title, presets and settings are valid and survive being written",
    "fix the class's attributes and its Config, see CONTRIBUTING.md",
)
def metadata(evidence: Evidence) -> Judgement:
    method, name, faults = evidence.method, evidence.name, []
    if not isinstance(method.title, str) or not method.title.strip() or one_line(method.title) != method.title:
        faults.append(f"title {method.title!r} is no line of text")
    if ":" not in name and method.id != name:
        faults.append(f"its id is {method.id!r}, but it is registered as {name!r}")
    for attribute in ("control", "mixed"):
        if not isinstance(getattr(method, attribute), bool):
            faults.append(f"{attribute} is neither True nor False")
    if "cpu" not in method.devices and "cuda" not in method.devices:
        faults.append(f"devices {method.devices!r} names neither cpu nor cuda")
    for preset in method.Config.presets:
        try:
            method.Config.preset(preset)
        except SplashbenchError as error:
            faults.append(f"preset {preset}: {error}")
    return judge(faults + _settings_faults(evidence))


def _settings_faults(evidence: Evidence) -> list[str]:
    """Faults of what submission.toml and a request to the child process would say of the run."""
    method, config = evidence.method, evidence.config
    try:
        if type(config).model_validate_json(config.model_dump_json()) != config:
            return ["its settings are others after being written as JSON and read back"]
        identity = Identity(
            method=method.id,
            method_version=method.version,
            preset=evidence.preset,
            settings=without_nulls(config.model_dump(mode="json")),
            scene="balls",
            scene_digest="0" * 64,
        )
        with tempfile.TemporaryDirectory() as folder:
            path = Path(folder, "submission.toml")
            write_text(path, identity_text(identity))
            if Identity.model_validate(toml.load(path)) != identity:
                return ["its settings are others after being written as TOML and read back"]
    except ValidationError as error:
        first = error.errors()[0]
        return [f"{'.'.join(map(str, first['loc']))}: {first['msg']}"]
    except (TypeError, ValueError) as error:  # pydantic's own for what JSON cannot say is a ValueError
        return [f"its settings cannot be written: {one_line(str(error))}"]
    return []


@check("a run through the harness ends as ok", "fix fit(), load() and render() until this run is ok")
def fit(evidence: Evidence) -> Judgement:
    run = evidence.run
    if run.ok:
        return Verdict.OK, f"the fit took {run.fit_seconds:.1f} s"
    if run.status == Status.UNSUPPORTED.value:
        return Verdict.FAILED, f"it does not take this scene: {run.reason}; give one that it takes with --scene"
    return Verdict.FAILED, f"{run.status}: {run.reason}"


@check(
    "fit() reports its progress, in [0, 1], never backwards, and says what it does",
    "call run.progress(fraction, message) as the fit goes on",
)
def progress(evidence: Evidence) -> Judgement:
    answer = evidence.fitted
    if answer.ended_in in ("import", "supports", "fit"):
        complete(answer, "the fit")
    reported = answer.progress
    if not reported.reports:
        return Verdict.FAILED, "fit() reported none"
    if not reported.fault and not reported.messages:
        return Verdict.FAILED, f"none of {reported.reports} reports says what is being done"
    return judge([reported.fault] if reported.fault else [], f"{reported.reports} reports")


@check(
    "save() writes plain files and no pickles",
    "write arrays with numpy.savez and settings as JSON; a pickle from a stranger runs code when it is read",
)
def files(evidence: Evidence) -> Judgement:
    complete_fit(evidence)
    return judge(storage_faults(evidence.saved))


@check(
    "loaded in a fresh process, from another place, the model renders the same bytes",
    "save everything that render() needs, in full precision, in the folder that save() is given",
)
def load(evidence: Evidence) -> Judgement:
    fitted, loaded = complete_fit(evidence), evidence.loaded
    if not loaded.done:
        return Verdict.FAILED, f"{loaded.ended_in}: {loaded.reason}"
    return judge(differences(fitted.digests, loaded.digests, "from the model in memory"))


@check(
    "views rendered twice, in any order, are the same bytes",
    "let render() draw no random numbers and keep nothing from call to call that changes the result",
)
def again(evidence: Evidence) -> Judgement:
    complete_fit(evidence)
    loaded = complete(evidence.loaded, "loading")
    first = {name: view.digest for name, view in loaded.views.items()}
    return judge(differences(first, loaded.again, "when all views are rendered again, the last one first"))


def _rendered(kind: Kind) -> Callable[[Evidence], Judgement]:
    """Judges sizes, finiteness and ranges of the views of one kind."""

    def judgement(evidence: Evidence) -> Judgement:
        # Of the model in memory, or, where that is fine, of the loaded one, which is what a run renders.
        answers = [complete_fit(evidence), evidence.loaded]
        for answer in answers:
            faults = [view.fault for view in answer.views.values() if view.kind == kind and view.fault]
            if kind == "window" and answer.window_fault:
                faults.append(answer.window_fault)
            if faults:
                return judge(faults)
        count = sum(view.kind == kind for view in answers[0].views.values())
        if not count:
            return Verdict.OK, "the scene has a single timestep"
        return Verdict.OK, f"{count} view{'s' if count > 1 else ''}"

    return judgement


views = Check(
    "views",
    "every test view at every timestep has its size, is finite and in [0, 1]",
    "fix render(); what lies outside of [0, 1] by more than 0.5, and integers, are refused",
    _rendered("test"),
)
between = Check(
    "between",
    "views between the timesteps, and a little outside of them, are whole as well",
    "render() is asked for any time; take the nearest timestep, or carry the liquid there",
    _rendered("between"),
)
size = Check(
    "size",
    "a camera of another size and focal length is rendered at its own size",
    "take width, height and K from the camera that render() is given, never from the training views",
    _rendered("size"),
)
principal_point = Check(
    "principal_point",
    "a window of a view, with its principal point off the middle, shows that part of the view",
    "project with camera.K or camera.project(), principal point included",
    _rendered("window"),
)


def _returned(which: Callable[[Answer], ReturnedArrays]) -> Callable[[Evidence], Judgement]:
    """Judges particles or signed distance."""

    def judgement(evidence: Evidence) -> Judgement:
        returned = which(complete_fit(evidence))
        return judge([returned.fault] if returned.fault else [], returned.about)

    return judgement


particles = Check(
    "particles",
    "particles, where there are any, are finite and cover the timesteps",
    "return None or Particles of positions [T, N, 3] with T the scene's timesteps",
    _returned(lambda answer: answer.particles),
)
signed_distance = Check(
    "signed_distance",
    "the signed distance, where there is one, covers the timesteps",
    "return None or a SignedDistance of phi [T, nx, ny, nz] with T the scene's timesteps",
    _returned(lambda answer: answer.geometry),
)


def _edge(which: Callable[[Evidence], Answer]) -> Callable[[Evidence], Judgement]:
    """Judges a fit of a scene that a method may refuse."""

    def judgement(evidence: Evidence) -> Judgement:
        answer = which(evidence)
        if answer.done:
            faults = [view.fault for view in answer.views.values() if view.kind == "test" and view.fault]
            faults += [returned.fault for returned in (answer.particles, answer.geometry) if returned.fault]
            return judge(faults, "it is reconstructed")
        if answer.clear:
            return Verdict.OK, f"it is refused: {answer.reason}"
        return Verdict.FAILED, f"it ends in {answer.ended_in}: {answer.reason or 'without a reason'}"

    return judgement


_REFUSE = "return Support(False, reason) from supports(), or raise SplashbenchError with one clear line"
one_frame = Check(
    "one_frame",
    "a scene of one timestep is reconstructed, or refused with a reason",
    _REFUSE,
    _edge(lambda evidence: evidence.one_frame),
)
no_liquid = Check(
    "no_liquid",
    "a scene without liquid is reconstructed, or refused with a reason",
    _REFUSE,
    _edge(lambda evidence: evidence.no_liquid),
)

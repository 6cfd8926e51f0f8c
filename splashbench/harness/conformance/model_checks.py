"""Checks of the method and of a model that it fitted: what it says, saves, loads and renders."""

from __future__ import annotations

from collections.abc import Callable, Mapping

from splashbench.harness.conformance.described import description_faults
from splashbench.harness.conformance.findings import Found, NotTested, Verdict, found
from splashbench.harness.conformance.messages import Answer, Held, Kind
from splashbench.harness.conformance.stored import storage_faults
from splashbench.harness.conformance.trial import Trial
from splashbench.submission import Status


def whole(answer: Answer, what: str) -> Answer:
    """`answer`; raises NotTested where `what` ended on the way."""
    if not answer.done:
        raise NotTested(f"{what} ended in {answer.stage}: {answer.reason}")
    return answer


def whole_fit(trial: Trial) -> Answer:
    """The fit without test views; raises NotTested where it failed."""
    return whole(trial.fitted, "the fit")


def rendered(answer: Answer) -> dict[str, str]:
    """Everything that a model gave: name -> digest."""
    views = {name: seen.digest for name, seen in answer.views.items()}
    return views | {"its particles": answer.particles.digest, "its signed distance": answer.geometry.digest}


def differences(one: Mapping[str, str], other: Mapping[str, str], than: str) -> list[str]:
    """A line on what differs between two sets of digests, the second one called `than`; none where nothing does."""
    names = [name for name, digest in one.items() if other.get(name) != digest]
    more = f", as {len(names) - 1} more do" if names[1:] else ""
    return [f"{names[0]} differs {than}{more}"] if names else []


def description(trial: Trial) -> Found:
    """Metadata and settings."""
    return found(description_faults(trial.name, trial.method, trial.preset, trial.config))


def fit(trial: Trial) -> Found:
    """An ordinary run."""
    ran = trial.ran
    if ran.status == Status.OK.value:
        return Verdict.OK, f"the fit took {ran.fit_seconds:.1f} s"
    if ran.status == Status.UNSUPPORTED.value:
        return Verdict.FAILED, f"it does not take this scene: {ran.reason}; give one that it takes with --scene"
    return Verdict.FAILED, f"{ran.status}: {ran.reason}"


def progress(trial: Trial) -> Found:
    """What the fit reported while it went on."""
    answer = trial.fitted
    if answer.stage in ("import", "supports", "fit"):
        whole(answer, "the fit")
    said = answer.said
    if not said.reports:
        return Verdict.FAILED, "fit() reported none"
    if not said.fault and not said.messages:
        return Verdict.FAILED, f"none of {said.reports} reports says what is being done"
    return found([said.fault] if said.fault else [], f"{said.reports} reports")


def files(trial: Trial) -> Found:
    """What was saved."""
    whole_fit(trial)
    return found(storage_faults(trial.saved))


def load(trial: Trial) -> Found:
    """The loaded model against the one in memory."""
    fitted = whole_fit(trial)
    loaded = trial.loaded
    if not loaded.done:
        return Verdict.FAILED, f"{loaded.stage}: {loaded.reason}"
    return found(differences(rendered(fitted), rendered(loaded), "from the model in memory"))


def again(trial: Trial) -> Found:
    """The loaded model's views against the same rendered once more."""
    whole_fit(trial)
    loaded = whole(trial.loaded, "loading")
    first = {name: seen.digest for name, seen in loaded.views.items()}
    return found(differences(first, loaded.again, "when all views are rendered again, the last one first"))


def views(kind: Kind) -> Callable[[Trial], Found]:
    """Sizes, finiteness and ranges of the views of one kind."""

    def look(trial: Trial) -> Found:
        # Of the model in memory, or, where that is fine, of the loaded one, which is what a run renders.
        answers = [whole_fit(trial), trial.loaded]
        for answer in answers:
            faults = [view.fault for view in answer.views.values() if view.kind == kind and view.fault]
            if kind == "window" and answer.window_fault:
                faults.append(answer.window_fault)
            if faults:
                return found(faults)
        count = sum(view.kind == kind for view in answers[0].views.values())
        if not count:
            return Verdict.OK, "the scene has a single timestep"
        return Verdict.OK, f"{count} view{'s' if count > 1 else ''}"

    return look


def held(which: Callable[[Answer], Held]) -> Callable[[Trial], Found]:
    """Particles or signed distance."""

    def look(trial: Trial) -> Found:
        one = which(whole_fit(trial))
        return found([one.fault] if one.fault else [], one.about)

    return look

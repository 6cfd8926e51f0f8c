"""The stress study: every kind of harm at every severity, for several methods, as one plan of runs.

Its runs are those of an ordinary study: kept, resumed and scored alike. What they say is in stability.py.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from splashbench.errors import SplashbenchError
from splashbench.harness.devices import CPU
from splashbench.harness.discovery import load_method
from splashbench.harness.runner import parse_overrides
from splashbench.scene import Scene
from splashbench.score import Result
from splashbench.study.job import Store
from splashbench.study.perturbations import KINDS, Dice, Recording, Step, perturbed
from splashbench.study.plan import StudyPlan, make_plan
from splashbench.study.scenes import recording_of
from splashbench.study.spec import SceneEntry, StudySpec, StudyVariant, metric_of
from splashbench.study.stability import StressRun
from splashbench.study.table import StudyRun
from splashbench.submission.withheld import scored_timesteps

#: The control that shows what a recording gives without any liquid.
NOTHING = "nothing"
#: On top of the preset of that control; tests shorten it.
REFERENCE_SETTINGS: dict[str, Any] = {}
#: What stability is told by, the first one first; all of them are tabulated.
METRICS = ("miou", "psnr", "lpips")
_AS_RECORDED = "as_recorded"
# Of a method's label in the name of a variant, which has room for a kind and a level besides.
_LONGEST_LABEL = 32


@dataclass(frozen=True)
class Harm:
    """One column of the grid. level: from 1 on, its place in the kind's ladder."""

    kind: type[Step]
    level: int

    @property
    def amount(self) -> float:
        return self.kind.ladder[self.level - 1]

    @property
    def step(self) -> Step:
        return self.kind.at(self.amount)


@dataclass(frozen=True)
class StressPlan:
    """plan: the runs. methods: labels, in order. rows: by name of a variant, its method's label and its harm, which is
    None on the recording as it is. harms: what is done to recordings. left_out: harms that some scene cannot have, each
    with the reason."""

    plan: StudyPlan
    methods: tuple[str, ...]
    rows: Mapping[str, tuple[str, Harm | None]]
    harms: tuple[Harm, ...]
    left_out: tuple[tuple[Harm, str], ...]


def kinds_named(names: Sequence[str]) -> tuple[type[Step], ...]:
    """The kinds of these names, all where there are none. Raises SplashbenchError for a name that is none."""
    by_name = {kind.named(): kind for kind in KINDS}
    for name in names:
        if name not in by_name:
            raise SplashbenchError(f"there is no kind {name!r} of harm; give some of {', '.join(by_name)}")
    return tuple(by_name[name] for name in dict.fromkeys(names)) if names else KINDS


def make_stress_plan(
    methods: Sequence[str],
    scenes: Sequence[str],
    *,
    kinds: Sequence[str] = (),
    levels: Sequence[int] = (1, 2, 3, 4, 5),
    seeds: Sequence[int] = (0,),
    timeout_seconds: float | None = None,
    device: str = CPU,
    gpu_elsewhere: bool | None = None,
    thin: Callable[[Scene], Scene] = lambda scene: scene,
) -> StressPlan:
    """The runs of `methods` (each METHOD[:PRESET][:KEY=VALUE,...]) on `scenes`, as recorded and with every harm.

    device, gpu_elsewhere: what methods run on, see `make_plan`. thin: makes of each scene the one that is used
    (thinning.py).

    Raises SplashbenchError, one line, for a method, preset, scene or kind that does not exist, and where no harm is
    left.
    """
    chosen = [parse_method(text) for text in methods]
    labels = method_labels(chosen)
    wanted = [Harm(kind, level) for kind in kinds_named(kinds) for level in sorted(set(levels))]
    opened = [thin(scene) for scene in [Scene.open(Path(entry)) for entry in scenes]]
    recordings = {scene.name: recording_of(scene) for scene in opened}
    left_out = [(harm, reason) for harm in wanted if (reason := _impossible(recordings, harm)) is not None]
    harms = [harm for harm in wanted if harm not in [other for other, _ in left_out]]
    if not harms:
        raise SplashbenchError(f"none of the harms is left: {left_out[0][1] if left_out else 'give some severities'}")
    nothing = StudyVariant(name=f"{NOTHING}.{_AS_RECORDED}", method=NOTHING, settings=REFERENCE_SETTINGS)
    variants = [nothing]
    rows: dict[str, tuple[str, Harm | None]] = {nothing.name: (NOTHING, None)}
    for number, (label, (method, preset, settings)) in enumerate(zip(labels, chosen)):
        # Methods may be called as they like, variants may not.
        plain = re.sub(r"[^A-Za-z0-9_-]", "_", label)
        plain = plain if plain == label and len(plain) <= _LONGEST_LABEL else f"{plain[: _LONGEST_LABEL - 3]}+{number}"
        for harm in (None, *harms):
            name = f"{plain}.{_AS_RECORDED if harm is None else f'{harm.kind.named()}.{harm.level}'}"
            steps = [] if harm is None else [harm.step]
            rows[name] = label, harm
            row = {"name": name, "method": method, "preset": preset, "settings": settings, "perturbation": steps}
            variants.append(StudyVariant.model_validate(row))
    spec = StudySpec(
        name="stress",
        title="Stability",
        method=chosen[0][0],
        scenes=tuple(SceneEntry(path=str(scene.directory)) for scene in opened),
        seeds=tuple(seeds),
        metrics=METRICS,
        baseline=variants[1].name,
        variants=tuple(variants),
        reference=None,
        timeout_seconds=timeout_seconds,
        device=device,
    )
    return StressPlan(make_plan(spec, gpu_elsewhere), tuple(labels), rows, tuple(harms), tuple(left_out))


def stress_runs(stress: StressPlan, store: Store, metric: str) -> tuple[list[StressRun], dict[tuple[str, int], float]]:
    """The runs that were made, with their `metric`; and the control's values by scene and seed.

    Runs that were not made yet are in neither, and neither are those that were scored without weights for `metric`.
    Raises SplashbenchError where the control failed on a scene.
    """
    found: list[StressRun] = []
    nothing: dict[tuple[str, int], float] = {}
    for planned in stress.plan.runs:
        entry = store.entry(planned.digest)
        if entry is None:
            continue
        run = StudyRun(planned, entry, store.result(entry))
        if lacks_weights(run.result, metric):
            continue
        label, harm = stress.rows[planned.variant.name]
        value = run.value(metric)
        if label == NOTHING:
            if value is None:
                raise SplashbenchError(
                    f"the control {NOTHING} has no {metric} on {planned.scene.name}, seed {planned.seed}: "
                    f"{run.status} {run.reason}".rstrip()
                )
            nothing[planned.scene.name, planned.seed] = value
        else:
            kind, level = ("", 0) if harm is None else (harm.kind.named(), harm.level)
            found.append(StressRun(label, planned.scene.name, planned.seed, kind, level, value))
    whole = {(run.method, run.scene, run.seed) for run in found if run.level == 0}
    complete = [run for run in found if (run.method, run.scene, run.seed) in whole and (run.scene, run.seed) in nothing]
    return complete, nothing


def lacks_weights(result: Result | None, metric: str) -> bool:
    """Whether a run that came through has no `metric` as it was scored without the network's weights: no failure."""
    return result is not None and result.status == "ok" and metric == "lpips" and result.digests.lpips_weights is None


def higher_is_better(metric: str) -> bool:
    """Whether more of `metric` is better."""
    return metric_of(metric).better == "higher"


def parse_method(text: str) -> tuple[str, str | None, dict[str, Any]]:
    """Method, preset and settings of METHOD or FILE.py:CLASS, with :PRESET, with :KEY=VALUE,KEY=VALUE, or with both."""
    parts = text.split(":")
    settings = parse_overrides(parts.pop().split(",")) if "=" in parts[-1] and len(parts) > 1 else {}
    if parts[0].endswith(".py"):
        method, rest = ":".join(parts[:2]), parts[2:]
    else:
        method, rest = parts[0], parts[1:]
    if len(rest) > 1:
        raise SplashbenchError(f"{text!r} is no method; write METHOD, METHOD:PRESET or METHOD:PRESET:KEY=VALUE")
    return method, rest[0] if rest else None, settings


def method_labels(chosen: Sequence[tuple[str, str | None, Mapping[str, Any]]]) -> list[str]:
    """What each is called: the method's own name, with what tells it apart where a method comes twice."""
    names = [load_method(method).id for method, _, _ in chosen]
    if NOTHING in names:
        raise SplashbenchError(f"{NOTHING} is the control, and runs in any case; leave it out of the methods")
    labels = []
    for name, (_, preset, settings) in zip(names, chosen):
        chosen_so = " ".join([f"{name}-{preset}" if preset else name, *(f"{k}={v}" for k, v in settings.items())])
        labels.append(chosen_so if names.count(name) > 1 else name)
    twice = next((label for label in labels if labels.count(label) > 1), None)
    if twice is not None:
        raise SplashbenchError(f"method {twice} is listed twice; give each a preset or settings of its own")
    return labels


def _impossible(recordings: Mapping[str, Recording], harm: Harm) -> str | None:
    """Why one of `recordings` cannot have `harm`; None where all can."""
    for name, recording in recordings.items():
        unseen = harm.step.withheld
        if unseen is not None and not scored_timesteps(recording.n_frames, unseen):
            return f"{name}: of {recording.n_frames} timesteps {unseen} leaves none between two that are seen"
        try:
            perturbed(recording, [harm.step], Dice(0, name))
        except SplashbenchError as error:
            return f"{name}: {error}"
    return None

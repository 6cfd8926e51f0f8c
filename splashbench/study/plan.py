"""From a spec to the runs it asks for, each with a digest of all it depends on.

The digest identifies a run, its row does not. Rows with the same settings share a run, and a run that was made under
another spec is used here too.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

from splashbench.errors import SplashbenchError
from splashbench.harness.contract import Method
from splashbench.harness.devices import planned_device
from splashbench.harness.discovery import load_method
from splashbench.harness.runner import TIMING_FRAMES, without_nulls
from splashbench.scene import Scene
from splashbench.score import PROTOCOL_V1
from splashbench.study.scenes import changes
from splashbench.study.spec import StudySpec, StudyVariant


@dataclass(frozen=True)
class NamedScene:
    """A scene under the name that the study's tables give it."""

    name: str
    scene: Scene


@dataclass(frozen=True)
class PlannedRun:
    """A run of the study.

    Attributes:
        scene, variant, seed: its place in the table; the variant `nothing` is the reference.
        digest: 64 hex digits over all that the run depends on.
        method, preset, overrides: what `run_method` is given.
        reference: digest of the reference run its dpsnr_bg is measured against, None where there is none.
        timing_frames: renders timed for the frame rate; none where the study does not ask for it.
        control: whether the method is a control.
        device: what the method runs on.
    """

    scene: NamedScene
    variant: StudyVariant
    seed: int
    digest: str
    method: str
    preset: str
    overrides: Mapping[str, Any]
    reference: str | None
    timing_frames: int
    control: bool
    device: str = "cpu"


@dataclass(frozen=True)
class StudyPlan:
    """All runs of a study, and the control runs they are measured against (those of changed scenes are in no row)."""

    spec: StudySpec
    method: Method
    preset: str
    scenes: tuple[NamedScene, ...]
    references: tuple[PlannedRun, ...]
    runs: tuple[PlannedRun, ...]

    @property
    def reference_row(self) -> tuple[PlannedRun, ...]:
        """The reference on the scenes as they are."""
        return tuple(run for run in self.references if not run.variant.perturbation and run.variant.train_views is None)


def make_plan(spec: StudySpec, gpu_elsewhere: bool | None = None) -> StudyPlan:
    """The runs of `spec`, on its `device`, seed by seed. All that can be wrong before a run starts is reported here.

    gpu_elsewhere: whether one of the other machines that make the runs has a GPU (`cluster.place.has_gpu`); None where
    this one makes them.

    Raises SplashbenchError, one line, for a missing scene, an unknown method, preset or setting.
    """
    rows = {variant.name: _row(spec, variant, gpu_elsewhere) for variant in spec.variants}
    scenes = _open_scenes(spec)
    timing = TIMING_FRAMES if "render_fps" in spec.metrics else 0
    references: dict[str, PlannedRun] = {}
    runs: list[PlannedRun] = []
    for seed in spec.seeds:
        for scene in scenes:
            for variant in spec.variants:
                reference = _reference(spec, scene, variant, seed, timing)
                if reference:
                    references.setdefault(reference.digest, reference)
                row = rows[variant.name]
                runs.append(
                    PlannedRun(
                        scene,
                        variant,
                        seed,
                        _digest(row.method, row.preset, row.resolved, seed, row.device, scene.scene, variant),
                        row.name,
                        row.preset,
                        row.overrides,
                        reference.digest if reference else None,
                        timing,
                        row.method.control,
                        row.device,
                    )
                )
    method = load_method(spec.method)
    preset = spec.preset or next(iter(method.Config.presets))
    return StudyPlan(spec, method, preset, scenes, tuple(references.values()), tuple(runs))


class _MethodChoice(NamedTuple):
    """What a variant runs: its method, the method's name in the spec, preset, overrides, resolved settings, device."""

    method: Method
    name: str
    preset: str
    overrides: dict[str, Any]
    resolved: dict[str, Any]
    device: str


def _row(spec: StudySpec, variant: StudyVariant, gpu_elsewhere: bool | None) -> _MethodChoice:
    name = variant.method or spec.method
    method = load_method(name)
    device = planned_device(method, spec.device, gpu_elsewhere)
    of_study_method = variant.method is None
    preset = variant.preset or (spec.preset if of_study_method else None) or next(iter(method.Config.presets))
    overrides, resolved = _checked(spec, method, variant.name, preset, variant.settings, with_base=of_study_method)
    return _MethodChoice(method, name, preset, overrides, resolved, device)


def _open_scenes(spec: StudySpec) -> tuple[NamedScene, ...]:
    scenes: list[NamedScene] = []
    for entry in spec.scenes:
        scene = Scene.open(Path(entry.path))
        name = entry.name or scene.name
        if name in [other.name for other in scenes]:
            raise SplashbenchError(f"study {spec.name}: two scenes are called {name!r}; give one another name")
        scenes.append(NamedScene(name, scene))
    return tuple(scenes)


def _checked(
    spec: StudySpec, method: Method, row: str, preset: str, settings: Mapping[str, Any], *, with_base: bool = True
) -> tuple[dict[str, Any], dict[str, Any]]:
    """The overrides of a row, and all its settings. Raises SplashbenchError for an unknown setting."""
    overrides = {**(spec.base if with_base else {}), **settings}
    try:
        config = method.Config.preset(preset, overrides)
    except SplashbenchError as error:
        raise SplashbenchError(f"study {spec.name}, variant {row}: {error}") from None
    return overrides, without_nulls(config.model_dump(mode="json"))


def _reference(spec: StudySpec, scene: NamedScene, variant: StudyVariant, seed: int, timing: int) -> PlannedRun | None:
    if spec.reference is None:
        return None
    reference = spec.reference
    method = load_method(reference.method)
    preset = reference.preset or next(iter(method.Config.presets))
    overrides, resolved = _checked(spec, method, reference.method, preset, reference.settings, with_base=False)
    changed = changes(scene.scene, variant, seed) is not None
    row = StudyVariant(
        name=reference.method,
        perturbation=variant.harm if changed else (),
        train_views=variant.train_views if changed else None,
    )
    digest = _digest(method, preset, resolved, seed, "cpu", scene.scene, row)
    return PlannedRun(scene, row, seed, digest, reference.method, preset, overrides, None, timing, method.control)


def _digest(
    method: Method,
    preset: str,
    settings: Mapping[str, Any],
    seed: int,
    device: str,
    scene: Scene,
    variant: StudyVariant,
) -> str:
    parts = {
        "method": [method.id, method.version],
        "preset": preset,
        "settings": settings,
        "seed": seed,
        "device": device,
        "scene": [scene.digest, changes(scene, variant, seed)],
        "protocol": PROTOCOL_V1.digest,
    }
    if variant.unseen:  # only where timesteps are withheld: digests of earlier runs must not change
        parts["withheld"] = variant.unseen
    return hashlib.sha256(json.dumps(parts, sort_keys=True).encode()).hexdigest()

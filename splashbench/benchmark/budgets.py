"""What `quick` and `full` mean for each method, and photographs at the size they have.

The baselines' preset `quick` shrinks photographs to 400 pixels. That costs nothing at 240x160, where it was chosen, and
is a handicap of 4.5 times at 1200x1800. So every method with a setting `longest_side`, which says how far photographs
are shrunk, gets the largest value there is, unless the user says otherwise.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

from splashbench.errors import SplashbenchError
from splashbench.harness.contract import Method
from splashbench.harness.discovery import load_method
from splashbench.manifest import load_neurofluid, load_scenes
from splashbench.paper_figures import paper_rows
from splashbench.scene import Scene
from splashbench.study import stress
from splashbench.study.plan import StudyPlan, make_plan
from splashbench.study.spec import Paper, Reference, SceneEntry, StudySpec, StudyVariant
from splashbench.study.stress import NOTHING, method_labels, parse_method

BudgetName = Literal["quick", "full"]
#: Six methods: the paper's, its three baselines, the hull's points, and the nearest photograph as a yardstick.
DEFAULT_METHODS = (
    *("splashsplat", "scaffold_4d", "spacetime_gaussians", "deformable_3dgs", "hull_points", "nearest_camera"),
)
#: The setting that says to how many pixels photographs are shrunk, and a value that shrinks none.
SHRINKS, NATIVE_SIDE = "longest_side", 16384
#: The preset of a full budget where it is not a method's first one: the published schedules.
_FULL = dict.fromkeys(("deformable_3dgs", "spacetime_gaussians", "spacetime_gaussians_lite", "scaffold_4d"), "paper")
_METRICS = (
    *("psnr", "dpsnr_bg", "ssim", "lpips", "miou", "spill", "jitter_error", "sigma_d", "sigma_mu_ratio", "uniformity"),
    *("delta_e", "fit_seconds", "render_fps", "peak_memory_bytes", "storage_bytes", "primitives_per_frame"),
)


@dataclass(frozen=True)
class Entrant:
    """A method of the benchmark. native: whether `longest_side` was set here, so that photographs are not shrunk."""

    label: str
    method: str
    id: str
    preset: str
    settings: Mapping[str, Any]
    native: bool


def make_entrants(methods: Sequence[str], budget: BudgetName) -> list[Entrant]:
    """The methods, each METHOD[:PRESET][:KEY=VALUE,...]. Raises SplashbenchError for an unknown one."""
    chosen = [parse_method(text) for text in methods]
    entrants = []
    for label, (name, preset, settings) in zip(method_labels(chosen), chosen):
        method = load_method(name)
        preset = preset or preset_of(method, budget)
        if preset not in method.Config.presets:
            raise SplashbenchError(
                f"method {method.id} has no preset {preset!r}; choose one of {', '.join(method.Config.presets)}"
            )
        native = SHRINKS in method.Config.model_fields and SHRINKS not in settings
        settings = {**settings, SHRINKS: NATIVE_SIDE} if native else settings
        method.Config.preset(preset, settings)
        entrants.append(Entrant(label, name, method.id, preset, settings, native))
    return entrants


def preset_of(method: Method, budget: BudgetName) -> str:
    """The preset that a method has for `budget`: `quick` or the published schedule, else its first one."""
    wanted = "quick" if budget == "quick" else _FULL.get(method.id, "")
    presets = list(method.Config.presets)
    return wanted if wanted in presets else presets[0]


def make_benchmark_plan(
    entrants: Sequence[Entrant],
    scenes: Sequence[str],
    budget: BudgetName,
    *,
    seeds: Sequence[int] = (0,),
    device: str = "cpu",
    gpu_elsewhere: bool | None = None,
    timeout_seconds: float | None = None,
) -> StudyPlan:
    """The runs of `entrants` on `scenes`, and of the control `nothing` on each.

    device: "auto" for a GPU where a method and the machine can use one. gpu_elsewhere: see `make_plan`.
    """
    nothing = load_method(NOTHING)
    settings = {SHRINKS: NATIVE_SIDE} if SHRINKS in nothing.Config.model_fields else {}
    settings |= stress.REFERENCE_SETTINGS
    paper_names = set(DEFAULT_METHODS[:4])
    spec = StudySpec(
        name=f"benchmark_{budget}",
        title="The benchmark",
        method=entrants[0].method,
        preset=entrants[0].preset,
        scenes=tuple(SceneEntry(path=scene) for scene in scenes),
        seeds=tuple(seeds),
        metrics=_METRICS,
        baseline=_plain(entrants, 0),
        variants=tuple(
            StudyVariant(
                name=_plain(entrants, number),
                method=each.method,
                preset=each.preset,
                settings=dict(each.settings),
                paper=each.id if each.id in paper_names else None,
                note="" if not each.native else "photographs at the size they have",
            )
            for number, each in enumerate(entrants)
        ),
        reference=Reference(preset=preset_of(nothing, budget), settings=settings),
        paper=_paper_of([Scene.open(Path(scene)).name for scene in scenes]),
        device=device,
        timeout_seconds=timeout_seconds,
    )
    return make_plan(spec, gpu_elsewhere)


def _paper_of(scenes: Sequence[str]) -> Paper | None:
    """The paper's figures that stand beside these scenes, by their names: its means over the real ones, or those of one
    of NeuroFluid's. Other scenes have none."""
    if set(scenes) <= set(load_scenes()):
        return Paper(scene_set="real_20")
    names = {scene.lower() for scene in scenes if scene in load_neurofluid().scenes}
    reported = {str(row["scene_set"]) for row in paper_rows()}
    return Paper(scene_set=names.pop()) if len(names) == len(set(scenes)) == 1 and names <= reported else None


def _plain(entrants: Sequence[Entrant], number: int) -> str:
    """The label as a name that a study's row may have."""
    label = entrants[number].label
    plain = "".join(letter if letter.isascii() and (letter.isalnum() or letter in "_+-.") else "_" for letter in label)
    return plain if plain == label and len(plain) <= 50 else f"{plain[:46]}+{number}"

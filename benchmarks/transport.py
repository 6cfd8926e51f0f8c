"""How well one step of transport keeps carriers in the observed liquid (supplement, "One-Step Solver Comparison").

    python benchmarks/transport.py SCENE... [--presets best quick] [--spacings 1 2] [--json FILE] [--markdown FILE]
    python benchmarks/transport.py scenes/thin_stream scenes/still_pool --every 4 --json transport.json

For every step t -> t+1 of each scene all predictors move the same carriers, drawn in the shell below the surface of
phi_t as the method draws them, and phi_{t+1} says where they end up:

validity   share of the carriers with phi_{t+1} < 0.5 voxels
escape     mean of max(phi_{t+1}, 0), transport voxels; beyond the grid its distance is added
seconds    median time of one prediction; other load on the machine is in it

Each is the mean over a scene's steps, and in the table the mean over scenes. Nothing is corrected nor deactivated. With
--spacings 2 the scene has every second frame only, so that steps are twice as long. Steps from or to a frame without
liquid do not count. The predictors:

ours       the preset's velocity u_t, and where a fall ends
no motion  carriers stay where they are
FLIP       one frame step of the solver, from liquid all through phi_t < 0 that moves with u_t, with the scene's gravity
           and container. The others double its substeps, the limit of pressure iterations (which changes nothing where
           the solve converges before), and the cells of its grid per axis, with eight times as many particles.

The JSON has, per scene, preset, spacing and predictor, these figures and their values for every step.
"""

from __future__ import annotations

import argparse
import statistics
import sys
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from functools import cached_property, partial
from pathlib import Path
from typing import Any

import numpy as np

from splashbench.errors import SplashbenchError
from splashbench.files import write_json, write_text
from splashbench.harness import hardware
from splashbench.harness.contract import Run
from splashbench.observe.container import solid_distance
from splashbench.observe.grid import Grid
from splashbench.observe.kernels import sample
from splashbench.progress import Bar
from splashbench.scene import Scene
from splashbench.scene.scene import TrainingScene
from splashbench_methods.splashsplat.carriers.resampling import newborns
from splashbench_methods.splashsplat.fields.observations import Observations, Report, observe
from splashbench_methods.splashsplat.flip.solver import FlipSettings, FlipSolver, gravity_in_voxels
from splashbench_methods.splashsplat.motion.observed_frames import observed_frames
from splashbench_methods.splashsplat.motion.steps import FrameStep
from splashbench_methods.splashsplat.settings import SplashSplatConfig

VALID_VOXELS = 0.5


class Thinned(TrainingScene):
    """Every `spacing`-th frame of a scene."""

    def __init__(self, scene: Scene, spacing: int) -> None:
        super().__init__(scene)
        self._spacing = spacing
        self.frames, self.times = scene.frames[::spacing], scene.times[::spacing]
        self.n_frames = len(self.frames)
        self.camera_times = {name: times[::spacing] for name, times in scene.camera_times.items()}

    def image(self, camera: str, t: int) -> np.ndarray:
        return super().image(camera, t * self._spacing)

    def mask(self, camera: str, t: int) -> np.ndarray:
        return super().mask(camera, t * self._spacing)


@dataclass
class Surroundings:
    """What stays the same through a scene. ratio: hull voxels per transport voxel."""

    scene: TrainingScene
    observations: Observations
    config: SplashSplatConfig
    grid: Grid
    ratio: float
    solvers: dict[FlipSettings, FlipSolver] = field(default_factory=dict)

    @cached_property
    def solid(self) -> np.ndarray | None:
        """Signed distance to the container's walls on the transport grid."""
        mesh = self.scene.container_mesh()
        return None if mesh is None else solid_distance(mesh, self.grid)

    def solver(self, settings: FlipSettings) -> FlipSolver:
        """The solver with these settings, made once."""
        if settings not in self.solvers:
            gravity = gravity_in_voxels(self.scene, self.grid)
            self.solvers[settings] = FlipSolver(self.grid.shape, gravity, self.solid, settings)
        return self.solvers[settings]


@dataclass(frozen=True)
class State:
    """What a predictor may know of step t -> t+1.

    phi: phi_t on the hull grid, in transport voxels. motion: the fitted one. carriers: float32 [N, 3], transport-grid
    coordinates. dt: seconds.
    """

    t: int
    phi: np.ndarray
    motion: FrameStep
    carriers: np.ndarray
    dt: float
    surroundings: Surroundings


Predictor = Callable[[State], np.ndarray]


def ours(state: State) -> np.ndarray:
    """Along the fitted velocity; a fall ends on the pool or at a wall where the preset knows of them."""
    identity = np.broadcast_to(np.eye(3, dtype=np.float32), (len(state.carriers), 3, 3))
    around = state.surroundings
    moved = state.motion.forecast(state.carriers, identity)[0]
    return around.observations.landed(state.t + 1, state.carriers, moved) if around.config.ballistic else moved


def no_motion(state: State) -> np.ndarray:
    """Nowhere."""
    return state.carriers


def flip(settings: FlipSettings, state: State) -> np.ndarray:
    """By the solver; the carriers are particles of the liquid among others."""
    around = state.surroundings
    solver, rng = around.solver(settings), np.random.default_rng([0, state.t])
    liquid = solver.fill(state.phi, around.ratio, rng)
    particles = np.concatenate([state.carriers, liquid])
    velocities = state.motion.velocity(particles) / state.dt
    return solver.step(particles, velocities, state.dt)[0][: len(state.carriers)].astype(np.float32)


_DEFAULT = FlipSettings()
#: name -> function from State to positions [N, 3]; the table has a row for each
PREDICTORS: dict[str, Predictor] = {
    "ours": ours,
    "no motion": no_motion,
    "FLIP": partial(flip, _DEFAULT),
    "FLIP, 2x substeps": partial(flip, FlipSettings(substeps_scale=2.0)),
    "FLIP, 2x pressure iterations": partial(
        flip, FlipSettings(pressure_iterations=2 * FlipSettings.pressure_iterations)
    ),
    "FLIP, 2x grid": partial(flip, FlipSettings(grid_scale=2)),
}


def steps(
    around: Surroundings, observations: Observations, report: Report, every: int, seed: int
) -> Iterator[tuple[State, np.ndarray]]:
    """Every `every`-th step with liquid before and after, and phi_{t+1} on the hull grid."""
    before: np.ndarray | None = None
    frames = observed_frames(observations, around.scene, around.config.motion, Run(), report)
    for t, frame in enumerate(frames):
        phi = frame.phi
        wet = before is not None and (before < 0).any() and (phi < 0).any()
        if before is not None and frame.step is not None and wet and (t - 1) % every == 0:
            rng = np.random.default_rng([seed, t - 1])
            nothing = np.zeros((0, 3), np.float32)
            carriers = newborns(before, around.grid, around.ratio, nothing, around.config.carriers.shell, rng)
            dt = float(around.scene.times[t] - around.scene.times[t - 1])
            if len(carriers):
                yield State(t - 1, before, frame.step, carriers, dt, around), phi
        before = phi


def distances(phi: np.ndarray, positions: np.ndarray, around: Surroundings) -> np.ndarray:
    """phi at `positions` [N, 3] (transport-grid coordinates), beyond the grid with the distance to it: float32 [N]."""
    inside = np.clip(positions, 0, np.array(around.grid.shape, np.float32) - 1)
    return sample(phi, inside * np.float32(around.ratio)) + np.linalg.norm(positions - inside, axis=1)


def compare(
    scene: TrainingScene, config: SplashSplatConfig, chosen: list[str], every: int, seed: int
) -> dict[str, Any]:
    """The figures of one scene: predictor -> validity, escape, seconds and their values per step; and the steps."""
    bar = Bar(f"{scene.name}, {scene.n_frames} frames")
    observations = observe(scene, config.fields, Run(), bar.update)
    if observations.in_transparent_container:
        config = config.in_transparent_container()
    around = Surroundings(scene, observations, config, observations.grid, observations.ratio)
    values: dict[str, dict[str, list[float]]] = {name: {"validity": [], "escape": [], "seconds": []} for name in chosen}
    frames, carriers = [], []
    for state, after in steps(around, observations, bar.update, every, seed):
        frames.append(state.t)
        carriers.append(len(state.carriers))
        for name in chosen:
            start = time.perf_counter()
            moved = PREDICTORS[name](state)
            values[name]["seconds"].append(time.perf_counter() - start)
            depth = distances(after, moved, around)
            values[name]["validity"].append(float((depth < VALID_VOXELS).mean()))
            values[name]["escape"].append(float(np.maximum(depth, 0).mean()))
    bar.close()
    if not frames:
        raise SplashbenchError(f"{scene.directory}: no two frames in a row show liquid; give another scene")
    figures = {
        name: {
            "validity": statistics.fmean(of["validity"]),
            "escape": statistics.fmean(of["escape"]),
            "seconds": statistics.median(of["seconds"]),
            "per_step": of,
        }
        for name, of in values.items()
    }
    return {"voxel": around.grid.voxel, "frames": frames, "carriers": carriers, "predictors": figures}


def table(results: list[dict[str, Any]]) -> str:
    """Markdown: a table per preset and spacing, the scenes side by side and their mean."""
    lines: list[str] = []
    for key in dict.fromkeys((result["preset"], result["spacing"]) for result in results):
        group = [result for result in results if (result["preset"], result["spacing"]) == key]
        names = [result["scene"] for result in group]
        lines += [f"Preset {key[0]}, {'every frame' if key[1] == 1 else f'1 frame in {key[1]}'}: validity / escape", ""]
        lines += ["| predictor | " + " | ".join([*names, "mean", "s a step"]) + " |"]
        lines += ["|---" * (len(names) + 3) + "|"]
        for predictor in group[0]["predictors"]:
            figures = [result["predictors"][predictor] for result in group]
            pairs = [(one["validity"], one["escape"]) for one in figures]
            pairs.append((statistics.fmean(v for v, _ in pairs), statistics.fmean(e for _, e in pairs)))
            cells = [f"{validity:.3f} / {escape:.2f}" for validity, escape in pairs]
            seconds = statistics.fmean(one["seconds"] for one in figures)
            lines.append(f"| {predictor} | " + " | ".join([*cells, f"{seconds:.2f}"]) + " |")
        lines.append("")
    return "\n".join(lines)


def main() -> int:
    """Print the tables, and write the files asked for."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("scenes", type=Path, nargs="+", metavar="SCENE", help="folders of scenes")
    parser.add_argument("--presets", nargs="+", default=["best"], metavar="NAME", help="of splashsplat (default: best)")
    parser.add_argument("--set", action="append", default=[], metavar="KEY=VALUE", help="a setting over the preset's")
    parser.add_argument("--spacings", type=int, nargs="+", default=[1, 2], metavar="N", help="frames a step (1 2)")
    parser.add_argument("--every", type=int, default=1, metavar="N", help="measure every N-th step only")
    parser.add_argument("--predictors", nargs="+", default=list(PREDICTORS), choices=list(PREDICTORS), metavar="NAME")
    parser.add_argument("--seed", type=int, default=0, help="of the carriers' places")
    parser.add_argument("--json", type=Path, metavar="FILE", help="write every figure here")
    parser.add_argument("--markdown", type=Path, metavar="FILE", help="write the tables here")
    options = parser.parse_args()
    if min([*options.spacings, options.every]) < 1:
        parser.error("--spacings and --every must be at least 1")
    if not all("=" in setting for setting in options.set):
        parser.error("--set takes KEY=VALUE")
    overrides = dict(setting.split("=", 1) for setting in options.set)
    for path in (options.json, options.markdown):
        if path is not None and not path.resolve().parent.is_dir():
            parser.error(f"{path}: there is no such folder")
    results: list[dict[str, Any]] = []
    about = {"machine": hardware.describe(), "every": options.every, "seed": options.seed, "settings": overrides}
    try:
        for preset in options.presets:
            config = SplashSplatConfig.preset(preset, overrides)
            for directory in options.scenes:
                scene = Scene.open(directory)
                for spacing in options.spacings:
                    figures = compare(Thinned(scene, spacing), config, options.predictors, options.every, options.seed)
                    key = {"scene": directory.resolve().name, "preset": preset, "spacing": spacing}
                    results.append(key | figures)
                    # After every scene: what is measured is kept when somebody loses patience.
                    if options.json is not None:
                        write_json(options.json, about | {"results": results})
                    if options.markdown is not None:
                        write_text(options.markdown, table(results))
    except SplashbenchError as error:
        print(f"error: {error}", file=sys.stderr)
        return 1
    print(table(results))
    return 0


if __name__ == "__main__":
    sys.exit(main())

"""Made-up scenes: a simulated liquid seen by seven perfect pinhole cameras on one clock, with exact ground truth.

Where a session (`splashbench.synth.session`) also tests the preparation, a scene isolates the methods: nothing about
calibration, synchronisation or masks is wrong. Scene units are metres, y points up.
"""

from __future__ import annotations

import tempfile
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from splashbench.errors import SplashbenchError
from splashbench.files import atomic_directory
from splashbench.scene import Camera, Particles, Scene, SceneMeta, write_scene
from splashbench.synth import simulation
from splashbench.synth.geometry import bowl_mesh
from splashbench.synth.lens import LensCamera
from splashbench.synth.plan import CAMERAS, GRAVITY, TEST, TRAIN, Options, make_plan
from splashbench.synth.rendering import Stage, View
from splashbench.synth.room import pour_room
from splashbench.synth.session import write_ply
from splashbench.synth.simulation import Pour
from splashbench.synth.surface import liquid_surface
from splashbench.synth.trajectory import Trajectory
from splashbench.synth.video import SensorNoise

_POINTS_PER_VIEW = 4000


@dataclass(frozen=True)
class Recipe:
    """A pour, and the part of it, in seconds from its start, that the scene shows."""

    title: str
    pour: Pour
    shown: tuple[float, float]


RECIPES: dict[str, Recipe] = {
    "opaque_bowl": Recipe("a pour that splashes in an opaque bowl", Pour(duration=1.3), (0.1, 1.28)),
    "thin_stream": Recipe(
        "a stream a centimetre thick, at the limit of what the cameras resolve",
        Pour(duration=1.3, particle_radius=0.0025, stream_diameter=0.010, speed=0.9),
        (0.1, 1.28),
    ),
    "still_pool": Recipe("a pool coming to rest", Pour(duration=2.4, emit_until=0.9), (1.6, 2.38)),
}


def make_scene(
    name: str,
    out: Path,
    size: tuple[int, int] = (480, 270),
    timesteps: int = 50,
    seed: int = 0,
    particle_radius: float | None = None,
    replace_existing: bool = False,
) -> Scene:
    """Make the scene `name` of `RECIPES` in the new folder `out`, with `timesteps` frames of `size` (width, height).

    `particle_radius` in metres replaces the recipe's own.
    Raises SplashbenchError for an unknown name, or when the liquid solver cannot run.
    """
    if name not in RECIPES:
        raise SplashbenchError(f"there is no made-up scene {name!r}; choose one of {', '.join(RECIPES)}")
    if timesteps < 2:
        raise SplashbenchError(f"--timesteps {timesteps} will not do; give 2 or more")
    recipe = RECIPES[name]
    radius = recipe.pour.particle_radius if particle_radius is None else particle_radius
    options = Options(size=size, seed=seed, particle_radius=radius)
    plan = make_plan(options)
    pour = replace(
        recipe.pour,
        azimuth_degrees=plan.pour.azimuth_degrees,
        particle_radius=options.particle_radius,
    )
    lenses = {camera: _pinhole(plan.recorders[camera].camera) for camera in CAMERAS}
    shown = np.linspace(*recipe.shown, timesteps)
    with (
        atomic_directory(Path(out), replace=replace_existing, holds="train_meta.json") as staging,
        tempfile.TemporaryDirectory(prefix="splashbench-") as scratch,
    ):
        running = simulation.start(pour, bowl_mesh(), Path(scratch))
        try:
            trajectory = running.finish()
        finally:
            running.stop()
        stage = Stage(pour_room(seed))
        views = {camera: View(stage, lens, samples=1) for camera, lens in lenses.items()}
        write_scene(
            staging,
            cameras={camera: Camera(camera, *size, lens.K, lens.w2c) for camera, lens in lenses.items()},
            train=TRAIN,
            test=TEST,
            n_frames=timesteps,
            frames=_frames(stage, lenses, trajectory, shown, pour.particle_radius, seed),
            meta=SceneMeta(
                name=f"synthetic_{name}",
                times=(shown - shown[0]).tolist(),
                metres_per_unit=1.0,
                gravity=GRAVITY,
                container_mesh="truth/container.ply",
                container_pose=np.eye(4).tolist(),
                provenance={"made_by": "splashbench synth scene", "recipe": recipe.title, "seed": seed},
            ),
            initial_points=_initial_points([views[camera] for camera in TRAIN], seed),
            container_masks={camera: view.container_mask for camera, view in views.items()},
        )
        (staging / "truth").mkdir()
        _true_particles(trajectory, shown).save(staging / "truth" / "particles.npz")
        bowl = bowl_mesh()
        write_ply(staging / "truth" / "container.ply", bowl.vertices, bowl.faces)
    return Scene.open(out)


def _pinhole(camera: LensCamera) -> LensCamera:
    return replace(camera, distortion=np.zeros(5))


def _frames(
    stage: Stage,
    lenses: dict[str, LensCamera],
    trajectory: Trajectory,
    shown: NDArray[np.float64],
    particle_radius: float,
    seed: int,
) -> Iterator[tuple[str, int, NDArray[np.uint8], NDArray[np.bool_]]]:
    surfaces = []
    for time in shown:
        positions, _, active = trajectory.at(float(time))
        surfaces.append(liquid_surface(positions[active], particle_radius))
    for k, (camera, lens) in enumerate(lenses.items()):
        view = View(stage, lens)
        noise = SensorNoise(lens.width, lens.height, (seed, 30, k))
        for t, surface in enumerate(surfaces):
            frame = view.with_liquid(surface)
            yield camera, t, noise.expose(frame.image), frame.mask


def _initial_points(views: list[View], seed: int) -> NDArray[np.float32]:
    """Points of the room [N, 7] that the training views see: x, y, z, r, g, b, and 0 for "not liquid"."""
    rng = np.random.default_rng([seed, 31])
    gathered = []
    for view in views:
        points, colors = view.seen_points()
        chosen = rng.choice(len(points), min(_POINTS_PER_VIEW, len(points)), replace=False)
        gathered.append(np.concatenate([points[chosen], colors[chosen], np.zeros((len(chosen), 1))], axis=1))
    return np.concatenate(gathered).astype(np.float32)


def _true_particles(trajectory: Trajectory, shown: NDArray[np.float64]) -> Particles:
    states = [trajectory.at(float(time)) for time in shown]
    active = np.stack([state[2] for state in states])
    positions = np.stack([state[0] for state in states]) * active[..., None]
    velocities = np.stack([state[1] for state in states]) * active[..., None]
    return Particles(positions, active, velocities)

"""Synthetic scenes: a simulated liquid seen by seven perfect pinhole cameras on one clock, with exact ground truth.

A session (`splashbench.synth.recording.session`) also tests the preparation; a scene isolates the methods. Nothing
about calibration, synchronisation or masks is wrong. Scene units are metres, y points up.
"""

from __future__ import annotations

import tempfile
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from splashbench.dyes import Dye, dye_named
from splashbench.errors import SplashbenchError
from splashbench.files import atomic_directory
from splashbench.files.ply import write_mesh
from splashbench.scene import Camera, Particles, Scene, SceneMeta, write_scene
from splashbench.scene.writer import write_frame
from splashbench.synth.imaging.geometry import Mesh, basin_mesh, bowl_mesh, dish_mesh, tank_mesh
from splashbench.synth.imaging.lens import LensCamera
from splashbench.synth.imaging.rendering import RoomView, TracedRoom, view_bytes
from splashbench.synth.imaging.room import CaptureRoom, dish_room, glossy_room, pour_room, tank_room
from splashbench.synth.liquid import simulation
from splashbench.synth.liquid.simulation import Pour
from splashbench.synth.liquid.surface import liquid_surface
from splashbench.synth.liquid.trajectory import Trajectory
from splashbench.synth.recording.plan import CAMERAS, GRAVITY, TEST, TRAIN, RecordingOptions, make_plan
from splashbench.synth.recording.video import SensorNoise
from splashbench.synth.workers import Workers, worker_count

_POINTS_PER_VIEW = 4000
_SOURCE_FRAME_MS = 1000 / 60
_LONGEST_SECONDS = 10.0
# The simulation runs on for a moment, so that the last frame too lies between two of its snapshots.
_AFTER_SECONDS = 0.02
# Pixels of all frames from which processes are worth their start, some seconds.
_WORTH_WORKERS = 5_000_000


@dataclass(frozen=True)
class SynthContainer:
    """What the liquid is poured into: its closed mesh, the room it stands in (given the seed), and if it is clear."""

    mesh: Callable[[], Mesh]
    room: Callable[[int], CaptureRoom]
    transparent: bool


BOWL = SynthContainer(bowl_mesh, pour_room, transparent=False)
TANK = SynthContainer(tank_mesh, tank_room, transparent=True)
GLOSSY_BASIN = SynthContainer(basin_mesh, glossy_room, transparent=False)
PAINTED_DISH = SynthContainer(dish_mesh, dish_room, transparent=False)


@dataclass(frozen=True)
class Recipe:
    """A pour, and the instants of it that the scene shows.

    Attributes:
        title: what there is to see.
        pour: what is poured; it is simulated for as long as the frames last.
        start: seconds from the start of the simulation to the first frame.
        steps_ms: milliseconds between frames, repeated from the beginning where there are more frames.
        container: what it is poured into.
    """

    title: str
    pour: Pour
    start: float
    steps_ms: tuple[float, ...]
    container: SynthContainer = BOWL

    def times(self, timesteps: int, step_ms: float | None = None) -> NDArray[np.float64]:
        """Instants [timesteps] in seconds of the simulation; `step_ms` replaces the recipe's own steps."""
        cycle = self.steps_ms if step_ms is None else (step_ms,)
        steps = np.resize(np.array(cycle) / 1000, timesteps - 1)
        return self.start + np.concatenate([[0.0], np.cumsum(steps)])


DEFAULT_SIZE = (480, 320)

# Out of sight of every camera, whatever the images' shape: none shows more above the bowl than one of 3:2.
_NOZZLE = (-0.08, 0.36, 0.0)
# With -78 degrees and 0.85 m/s, what splashes over the bowl's rim is drops: faster or flatter, a slosh goes over.
_NOZZLE_OVER_BOWL = (-0.065, 0.36, 0.0)
_NOZZLE_OVER_BASIN = (-0.085, 0.36, 0.0)
_NOZZLE_OVER_DISH = (-0.06, 0.36, 0.0)
# So low that nothing splashes; for liquid that is all there before the first frame.
_NOZZLE_IN_BOWL = (-0.04, 0.17, 0.0)

RECIPES: dict[str, Recipe] = {
    "opaque_bowl": Recipe(
        "a pour that splashes in an opaque bowl",
        Pour(emit_until=1.45, speed=0.85, nozzle=_NOZZLE_OVER_BOWL, angle_degrees=-78.0),
        0.1,
        (33.0,),
    ),
    "glass_tank": Recipe(
        "a pour into a glass tank, seen through its walls at uneven times",
        Pour(emit_until=2.4, particle_radius=0.0035, stream_diameter=0.028, nozzle=_NOZZLE),
        0.1,
        tuple(frames * _SOURCE_FRAME_MS for frames in (4, 3, 5, 4, 5, 3, 4)),
        TANK,
    ),
    "thin_stream": Recipe(
        "a stream a centimetre thick, at the limit of what the cameras resolve",
        Pour(emit_until=1.75, particle_radius=0.0025, stream_diameter=0.010, speed=0.9, nozzle=_NOZZLE),
        0.1,
        (40.0,),
    ),
    "still_pool": Recipe(
        "a pool coming to rest",
        Pour(emit_until=0.95, particle_radius=0.0035, stream_diameter=0.028, speed=0.8, nozzle=_NOZZLE_IN_BOWL),
        1.0,
        (100.0,),
    ),
    "glossy_bowl": Recipe(
        "a lively pour into a glossy basin without texture, in which the room is mirrored",
        Pour(emit_until=1.35, speed=1.1, stream_diameter=0.026, nozzle=_NOZZLE_OVER_BASIN, angle_degrees=-74.0),
        0.1,
        (33.0,),
        GLOSSY_BASIN,
    ),
    "clear_liquid": Recipe(
        "a clear liquid poured into a painted dish, whose pattern is seen through it",
        Pour(emit_until=1.6, speed=0.7, stream_diameter=0.022, nozzle=_NOZZLE_OVER_DISH, angle_degrees=-80.0),
        0.1,
        (40.0,),
        PAINTED_DISH,
    ),
}


def make_scene(
    name: str,
    out: Path,
    size: tuple[int, int] = DEFAULT_SIZE,
    timesteps: int = 50,
    seed: int = 0,
    particle_radius: float | None = None,
    step_ms: float | None = None,
    dye: str | None = None,
    times_alone: bool = False,
    replace_existing: bool = False,
    workers: int | None = None,
) -> Scene:
    """Make the scene `name` of `RECIPES` in the new folder `out`, with `timesteps` frames of `size` (width, height).

    `particle_radius` in metres replaces the recipe's own; `step_ms` milliseconds between all frames, its time steps;
    `dye`, a name or color as `dye_named` takes it, the liquid's. Two scenes that differ by it alone show one pour.
    `times_alone`: scene.json tells neither scale, gravity nor the container's mesh, as of footage that nobody measured.
    `workers`: processes that film, by default one for each core where that is worth their start. What they film does
    not depend on how many there are.
    Raises SplashbenchError for an unknown name, for frames that last too long, or when the liquid solver cannot run.
    """
    if name not in RECIPES:
        raise SplashbenchError(f"there is no synthetic scene {name!r}; choose one of {', '.join(RECIPES)}")
    if timesteps < 2:
        raise SplashbenchError(f"--timesteps {timesteps} will not do; give 2 or more")
    if step_ms is not None and not 0 < step_ms < np.inf:
        raise SplashbenchError(f"--step {step_ms:g} will not do; give milliseconds above 0")
    recipe = RECIPES[name]
    dyed = None if dye is None else dye_named(dye)
    shown = recipe.times(timesteps, step_ms)
    if shown[-1] - shown[0] > _LONGEST_SECONDS:
        raise SplashbenchError(
            f"{timesteps} frames would last {shown[-1] - shown[0]:.1f} s, and no scene lasts more than "
            f"{_LONGEST_SECONDS:.0f} s; give fewer --timesteps or a smaller --step"
        )
    radius = recipe.pour.particle_radius if particle_radius is None else particle_radius
    options = RecordingOptions(size=size, seed=seed, particle_radius=radius)
    plan = make_plan(options)
    pour = replace(
        recipe.pour,
        duration=float(shown[-1]) + _AFTER_SECONDS,
        azimuth_degrees=plan.pour.azimuth_degrees,
        particle_radius=options.particle_radius,
    )
    known: dict[str, Any] = {
        "metres_per_unit": 1.0,
        "gravity": GRAVITY,
        "container_mesh": "truth/container.ply",
        "container_pose": np.eye(4).tolist(),
        "container_transparent": recipe.container.transparent,
    }
    lenses = {camera: _pinhole(plan.recorders[camera].camera) for camera in CAMERAS}
    with (
        atomic_directory(Path(out), replace=replace_existing, holds="train_meta.json") as staging,
        tempfile.TemporaryDirectory(prefix="splashbench-") as scratch,
    ):
        running = simulation.start(pour, recipe.container.mesh(), Path(scratch))
        try:
            trajectory = running.finish()
        finally:
            running.stop()
        film = SceneFilm(name, dyed, seed, lenses, _Liquid(trajectory, shown, radius), staging, Path(scratch))
        with Workers(_worker_count(workers, lenses, timesteps), film, made=str(out)) as crew:
            views = dict(zip(CAMERAS, crew.each([(SceneFilm.see, (camera,)) for camera in CAMERAS], "empty room")))
            crew.each([(SceneFilm.reconstruct, (t,)) for t in range(timesteps)], "liquid surfaces")
            crew.film(dict.fromkeys(CAMERAS, timesteps), SceneFilm.shoot, "frames")
        write_scene(
            staging,
            cameras={camera: Camera(camera, *size, lens.K, lens.w2c) for camera, lens in lenses.items()},
            train=TRAIN,
            test=TEST,
            n_frames=timesteps,
            frames=(),
            shown=(),
            meta=SceneMeta(
                name=f"synthetic_{name}" + ("" if dye is None else f"_{dye.lstrip('#')}"),
                times=(shown - shown[0]).tolist(),
                **({} if times_alone else known),
                provenance={
                    "made_by": "splashbench synth scene",
                    "recipe": recipe.title,
                    "seed": seed,
                    "particle_radius": radius,
                    **({} if dye is None else {"dye": dye}),
                },
            ),
            initial_points=_initial_points([views[camera] for camera in TRAIN], seed),
            container_masks={camera: view.container_mask for camera, view in views.items()},
        )
        (staging / "truth").mkdir()
        _true_particles(trajectory, shown).save(staging / "truth" / "particles.npz")
        container = recipe.container.mesh()
        write_mesh(staging / "truth" / "container.ply", container.vertices, container.outward_faces)
    return Scene.open(out)


def _with_dye(room: CaptureRoom, dye: Dye | None) -> CaptureRoom:
    return room if dye is None else replace(room, dye=replace(room.dye, albedo=dye.albedo, absorption=dye.absorption))


def _pinhole(camera: LensCamera) -> LensCamera:
    return replace(camera, distortion=np.zeros(5))


@dataclass(frozen=True, eq=False)
class _Liquid:
    """What moves: instants `shown` [T] of a `trajectory` in seconds, and the radius of its particles in metres."""

    trajectory: Trajectory
    shown: NDArray[np.float64]
    particle_radius: float


@dataclass(frozen=True, eq=False)
class _EmptyRoom:
    """What a camera sees without liquid: container_mask bool [H, W], points [N, 3] and their colors [N, 3]."""

    container_mask: NDArray[np.bool_]
    points: NDArray[np.float32]
    colors: NDArray[np.float32]


class SceneFilm:
    """Films the scene `name`: a worker's own. Liquid surfaces lie in the folder `scratch`, images go to `staging`."""

    def __init__(
        self,
        name: str,
        dye: Dye | None,
        seed: int,
        lenses: dict[str, LensCamera],
        liquid: _Liquid,
        staging: Path,
        scratch: Path,
    ) -> None:
        self._name, self._dye, self._seed, self._lenses = name, dye, seed, lenses
        self._liquid, self._staging, self._scratch = liquid, staging, scratch
        self._room: TracedRoom | None = None
        self._set_up: tuple[str, RoomView, SensorNoise] | None = None

    def _traced(self) -> TracedRoom:
        if self._room is None:
            self._room = TracedRoom(_with_dye(RECIPES[self._name].container.room(self._seed), self._dye))
        return self._room

    def see(self, camera: str) -> _EmptyRoom:
        """The room without liquid, as `camera` sees it."""
        view = RoomView(self._traced(), self._lenses[camera], samples=1)
        return _EmptyRoom(view.container_mask, *view.seen_points())

    def _surface(self, t: int) -> Path:
        return self._scratch / f"surface_{t:06d}.npz"

    def reconstruct(self, t: int) -> None:
        """Make the liquid's surface at timestep `t`."""
        positions, _, active = self._liquid.trajectory.at(float(self._liquid.shown[t]))
        surface = liquid_surface(positions[active], self._liquid.particle_radius)
        if surface is not None:
            np.savez(self._surface(t), vertices=surface.vertices, faces=surface.faces, normals=surface.normals)

    def shoot(self, camera: str, frames: range) -> None:
        """Film some frames of `camera`, and write them with their masks."""
        if self._set_up is None or self._set_up[0] != camera:
            self._set_up = None  # large
            lens, number = self._lenses[camera], list(self._lenses).index(camera)
            noise = SensorNoise(lens.width, lens.height, (self._seed, 30, number))
            self._set_up = camera, RoomView(self._traced(), lens), noise
        _, view, noise = self._set_up
        for t in frames:
            surface = None
            if self._surface(t).exists():
                with np.load(self._surface(t)) as stored:
                    surface = Mesh(stored["vertices"], stored["faces"], stored["normals"])
            frame = view.with_liquid(surface)
            write_frame(self._staging, camera, t, noise.expose(frame.image, t), frame.mask)


def _worker_count(asked: int | None, lenses: dict[str, LensCamera], timesteps: int) -> int:
    """Processes that film: as many as `asked` for, else one for each core, where there is enough to film."""
    width, height = next((lens.width, lens.height) for lens in lenses.values())
    if asked is None and width * height * len(lenses) * timesteps < _WORTH_WORKERS:
        return 1
    most = 2 * len(lenses)  # more would set up cameras for a handful of frames
    return min(asked, most) if asked else worker_count(view_bytes(width, height), most)


def _initial_points(views: list[_EmptyRoom], seed: int) -> NDArray[np.float32]:
    """Points of the room [N, 7] that the training views see: x, y, z, r, g, b, and 0 for "not liquid"."""
    rng = np.random.default_rng([seed, 31])
    gathered = []
    for view in views:
        points, colors = view.points, view.colors
        chosen = rng.choice(len(points), min(_POINTS_PER_VIEW, len(points)), replace=False)
        gathered.append(np.concatenate([points[chosen], colors[chosen], np.zeros((len(chosen), 1))], axis=1))
    return np.concatenate(gathered).astype(np.float32)


def _true_particles(trajectory: Trajectory, shown: NDArray[np.float64]) -> Particles:
    states = [trajectory.at(float(time)) for time in shown]
    active = np.stack([state[2] for state in states])
    positions = np.stack([state[0] for state in states]) * active[..., None]
    velocities = np.stack([state[1] for state in states]) * active[..., None]
    return Particles(positions, active, velocities)

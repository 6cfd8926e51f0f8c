"""FLIP: liquid simulated from one observed state on, the paper's ablation "FLIP" ("Ablation Study"; supplement,
"One-Step Solver Comparison").

A FLIP/PIC solver (Zhu and Bridson 2005) with gravity, the container's walls and a free surface, and nothing that the
images do not show: no inflow, no viscosity, no surface tension. It needs the scene's gravity, its metric scale and the
frames' true times, as the paper's does ("gravity in the metric scale of the capture"). A step is kick, drift, kick:
half of gravity and a projection before the particles move and half after, which makes free fall exact. Lengths are
voxels of the transport grid, velocities voxels per second.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from splashbench.errors import SplashbenchError
from splashbench.observe.grid import Grid
from splashbench.observe.kernels import resample, sample
from splashbench.parallel import over_range
from splashbench.scene.scene import Scene, TrainingScene

from ..fields.jet import STANDARD_GRAVITY
from ..motion.advection import clamp_stretch
from ..motion.steps import FrameStep
from .grid import drift, extrapolate, open_shares, slide, to_faces, to_particles
from .pressure import apply_pressure, assemble, divergence, number_cells, solve

# Faces beyond the liquid that get a velocity: a particle moves at most one cell, and gradients look one cell around.
_LAYERS = 4
_FAR = 1e3
_HALF_DIAGONAL = 0.87  # of a cell: beyond it, no part of the cell can be in the liquid
_SMALL_LOOP = 1024


@dataclass(frozen=True)
class FlipSettings:
    """Settings of the solver.

    substeps_scale: multiplies the number of substeps. cfl: cells a particle may cross in one substep at scale 1.
    pressure_iterations, pressure_tolerance: the pressure solve ends after so many iterations, or once no cell's
    divergence exceeds this share of the largest. flip_ratio: 1 is pure FLIP, 0 pure PIC. grid_scale: cells of the
    solver per voxel and axis. particles_per_axis: of a filled cell.
    """

    substeps_scale: float = 1.0
    cfl: float = 1.0
    pressure_iterations: int = 200
    pressure_tolerance: float = 1e-5
    flip_ratio: float = 0.95
    grid_scale: int = 1
    particles_per_axis: int = 2


@dataclass
class FlipReport:
    """Of the last step: substeps, most pressure iterations, and the largest divergence left in a liquid cell (1/s)."""

    substeps: int = 0
    iterations: int = 0
    divergence: float = 0.0


class FlipSolver:
    """Moves particles as a liquid under gravity between walls; the grid's borders are open, and liquid may leave.

    grid_shape: nodes of the transport grid; its liquid cells are unit cubes about them. gravity: [3] voxels/s^2. solid:
    float32 [nx, ny, nz], signed distance to the walls in voxels, negative inside them, or None. Walls thinner than two
    cells may leak. Results depend on the order of the particles in their last bits only, never on the threads.
    """

    def __init__(
        self,
        grid_shape: tuple[int, int, int],
        gravity: np.ndarray,
        solid: np.ndarray | None = None,
        settings: FlipSettings | None = None,
    ) -> None:
        self.settings = settings or FlipSettings()
        self.report = FlipReport()
        scale = self.settings.grid_scale
        self._scale, self._grid_shape = scale, tuple(grid_shape)
        nx, ny, nz = ((n - 1) * scale + 1 for n in grid_shape)
        self._shape = nx, ny, nz
        self._gravity = np.asarray(gravity, dtype=np.float64) * scale
        faces = (3, nx + 1, ny + 1, nz + 1)
        if solid is None:
            self._solid = np.full((2, 2, 2), _FAR, np.float32)  # sampled beyond its nodes: far from walls everywhere
            self._shares = np.ones(faces, np.float32)
            self._walls, self._normals = np.zeros((0, 4), np.int32), np.zeros((0, 3))
            self._buried = np.zeros(self._shape, dtype=bool)
            return
        if solid.shape != self._grid_shape:
            raise ValueError(f"solid is {solid.shape}, the grid {self._grid_shape}")
        self._solid = resample(solid, self._shape, 1 / scale) * np.float32(scale)
        self._shares = np.empty(faces, np.float32)
        over_range(open_shares, faces[1], self._solid, self._shares)
        self._buried = self._solid < 0
        # Closed faces near the liquid's side of the walls, and the walls' normals there.
        closed = np.argwhere(self._shares == 0)
        places = closed[:, 1:] - 0.5 * np.eye(3)[closed[:, 0]]
        near = sample(self._solid, places) > -_LAYERS
        self._walls = np.ascontiguousarray(closed[near], np.int32)
        self._normals = _normals(self._solid, places[near])

    def fill(self, phi: np.ndarray, ratio: float, rng: np.random.Generator) -> np.ndarray:
        """Particles all through the liquid phi < 0 outside the walls, jittered: float32 [N, 3], transport voxels.

        phi: hull-grid field in transport voxels; ratio: hull voxels per transport voxel.
        """
        axes = (np.arange(n, dtype=np.float32) for n in self._grid_shape)
        cells = np.stack(np.meshgrid(*axes, indexing="ij"), -1).reshape(-1, 3)
        cells = cells[sample(phi, cells * np.float32(ratio)) < _HALF_DIAGONAL]
        per_axis = self.settings.particles_per_axis * self._scale
        places = np.stack(np.meshgrid(*[np.arange(per_axis, dtype=np.float32)] * 3, indexing="ij"), -1).reshape(-1, 3)
        jitter = rng.random((len(cells), len(places), 3), dtype=np.float32)
        particles = (cells[:, None] + (places + jitter) / np.float32(per_axis) - np.float32(0.5)).reshape(-1, 3)
        particles = particles[sample(phi, particles * np.float32(ratio)) < 0]
        return particles[sample(self._solid, particles * np.float32(self._scale)) > 0]

    def step(
        self, positions: np.ndarray, velocities: np.ndarray, dt: float, deformation: np.ndarray | None = None
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Positions and velocities [N, 3] after `dt` seconds, float64, and the deformation of the first M particles.

        deformation: [M, 3, 3], M <= N, or None for M = 0; F becomes (I + dt grad u) F substep by substep, and at the
        end its singular values are clamped (`clamp_stretch`). Particles outside the grid fall freely.
        """
        scale = self._scale
        x = np.array(positions, dtype=np.float64, order="C") * scale
        v = np.array(velocities, dtype=np.float64, order="C") * scale
        F = np.array(np.zeros((0, 3, 3)) if deformation is None else deformation, dtype=np.float64, order="C")
        self.report = FlipReport()
        remaining, pending = float(dt), 0.0
        while remaining > 1e-9 * dt:
            count = np.ceil(remaining / self._longest_substep(x, v) - 1e-9)
            duration = remaining / max(1.0, count)
            field = self._kick(x, v, pending + 0.5 * duration)
            fixed = (field, self._inside(x), self._solid, duration)
            over_range(drift, len(x), *fixed, x, v, F, smallest=_SMALL_LOOP)
            pending = 0.5 * duration
            remaining -= duration
            self.report.substeps += 1
        self._kick(x, v, pending)
        return x / scale, v / scale, clamp_stretch(F)

    def _inside(self, x: np.ndarray) -> np.ndarray:
        return np.asarray(((x >= -0.5) & (x <= np.array(self._shape) - 0.5)).all(axis=1))

    def _longest_substep(self, x: np.ndarray, v: np.ndarray) -> float:
        """Seconds in which no particle on the grid crosses more than cfl cells."""
        cfl = self.settings.cfl
        fastest = np.sqrt((v[self._inside(x)] ** 2).sum(axis=1).max(initial=0.0))
        fastest += np.sqrt(cfl * np.linalg.norm(self._gravity))
        return float(cfl / max(fastest, 1e-12) / self.settings.substeps_scale)

    def _kick(self, x: np.ndarray, v: np.ndarray, duration: float) -> np.ndarray:
        """Gravity for `duration` seconds and the pressure that makes the flow divergence-free, on `v` in place.

        Returns the divergence-free field that moves the particles.
        """
        settings = self.settings
        inside = self._inside(x)
        v[~inside] += duration * self._gravity
        positions, velocities = x[inside], v[inside]
        field, weight = np.zeros((2, *self._shares.shape))
        over_range(to_faces, 3, positions, velocities, field, weight)
        covered = weight > 0
        np.divide(field, weight, out=field, where=covered)
        change = -field
        for a in range(3):
            field[a] += duration * self._gravity[a]
        number = np.full(self._shape, -1, np.int32)
        cells = number_cells(positions, self._shares, self._buried, number)
        has_velocity = np.zeros(field.shape, np.uint8)
        if len(cells):
            system = assemble(cells, number, self._shares)
            right = -divergence(field, self._shares, cells)
            pressure, iterations = solve(*system, right, settings.pressure_iterations, settings.pressure_tolerance)
            apply_pressure(field, self._shares, cells, number, pressure, has_velocity)
            remaining = divergence(field, self._shares, cells)[system[2] > 0]
            self.report.iterations = max(self.report.iterations, iterations)
            self.report.divergence = float(np.abs(remaining).max(initial=0.0))
        # The change is carried beyond the liquid as a field of its own: in free flight it is the same everywhere,
        # whatever the velocities of the particles.
        has_velocity[~covered] = 0
        change += field
        over_range(extrapolate, 3, change, has_velocity.copy(), _LAYERS)
        over_range(extrapolate, 3, field, has_velocity, _LAYERS)
        slide(field, self._walls, self._normals)
        fixed = (field, change, positions, settings.flip_ratio)
        over_range(to_particles, len(positions), *fixed, velocities, smallest=_SMALL_LOOP)
        v[inside] = velocities
        return field


def _normals(solid: np.ndarray, points: np.ndarray) -> np.ndarray:
    """Unit gradients of `solid` at points [N, 3], float64 [N, 3]; zero where it has none."""
    gradient = np.empty((len(points), 3))
    for axis in range(3):
        step = np.eye(3)[axis]
        gradient[:, axis] = sample(solid, points + step) - sample(solid, points - step)
    length = np.linalg.norm(gradient, axis=1, keepdims=True)
    return gradient / np.maximum(length, 1e-9)


def metric_gravity(scene: Scene | TrainingScene) -> np.ndarray:
    """Gravity in scene units per second squared, float64 [3].

    Raises SplashbenchError where gravity, the metric scale or the frames' times are unknown.
    """
    facts = {
        "gravity": scene.gravity,
        "metres_per_unit": scene.metres_per_unit,
        "times": None if scene.times_source == "nominal" else scene.times_source,
    }
    missing = [name for name, value in facts.items() if value is None]
    if scene.gravity is None or scene.metres_per_unit is None or missing:
        raise SplashbenchError(
            f"scene {scene.name}: FLIP needs {' and '.join(missing)}, which the scene does not tell; add it to "
            "scene.json (`splashbench scene place-container` finds gravity and scale where the container has a mesh)"
        )
    return np.asarray(scene.gravity, dtype=np.float64) * STANDARD_GRAVITY / scene.metres_per_unit


def gravity_in_voxels(scene: Scene | TrainingScene, grid: Grid) -> np.ndarray:
    """Gravity in voxels of `grid` per second squared, float64 [3]; see `metric_gravity`."""
    return metric_gravity(scene) / grid.voxel


class FlipTransport:
    """Carriers through a simulation that starts from the first observed liquid and never looks at another frame.

    Carriers are particles of the liquid, which besides fills the whole hull: a hollow shell would collapse.
    """

    def __init__(
        self,
        solver: FlipSolver,
        phi: np.ndarray,
        ratio: float,
        ids: np.ndarray,
        positions: np.ndarray,
        rng: np.random.Generator,
    ) -> None:
        """phi, ratio: of the first liquid, see `FlipSolver.fill`. ids: int [N], ascending, of the carriers at positions
        [N, 3], transport voxels."""
        self._solver = solver
        self._ids = np.array(ids)
        self._positions = np.concatenate([positions, solver.fill(phi, ratio, rng)]).astype(np.float64)
        self._velocities: np.ndarray | None = None

    def forecast(
        self, ids: np.ndarray, deformation: np.ndarray, dt: float, observed: FrameStep
    ) -> tuple[np.ndarray, np.ndarray]:
        """Positions [N, 3] and F [N, 3, 3], float32, of the carriers `ids` after the next frame step of `dt` seconds.

        ids: ascending, of carriers of the start or of the call before; others leave the simulation. observed: the
        motion of the step, looked at in the first step only, for the velocities then.
        """
        if self._velocities is None:
            self._velocities = observed.velocity(self._positions) / dt
        keep = np.ones(len(self._positions), dtype=bool)
        keep[: len(self._ids)] = np.isin(self._ids, ids, assume_unique=True)
        moved = self._solver.step(self._positions[keep], self._velocities[keep], dt, deformation)
        self._positions, self._velocities, deformed = moved
        self._ids = np.array(ids)
        return self._positions[: len(ids)].astype(np.float32), deformed

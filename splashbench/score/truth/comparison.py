"""Metrics against the true particles of a synthetic scene: geometry and motion (docs/protocol.md, "Against the truth").

The grid is the one that the training masks give (observe/signed_distance.py), and every length is in its voxels. The
reconstruction is the submission's signed distance, else the liquid that its particles represent.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from splashbench.errors import SplashbenchError
from splashbench.observe import signed_distance_fields
from splashbench.observe.grid import Grid
from splashbench.scene import Particles, Scene, SignedDistance
from splashbench.score.image.views import Track
from splashbench.score.metrics import TRUTH_METRICS
from splashbench.score.particles.surface import particle_distance, spacing
from splashbench.score.particles.uniformity import DistanceFields
from splashbench.score.result import MetricValue, frame_mean, metric_value
from splashbench.score.settings import PROTOCOL_V1, Protocol
from splashbench.score.truth.level_set import Field, chamfer, filled, overlap, resampled, surface_points
from splashbench.score.truth.motion import FrameMotion, frame_motion, free_flight, known_velocities, relative

GEOMETRY_METRICS = ("surface_chamfer", "sdf_iou", "sdf_recall", "sdf_precision")
MOTION_METRICS = ("velocity_epe", "velocity_epe_relative", "airborne_epe_relative", "velocity_coverage")
NO_TRUTH = "the scene has no true particles"
#: Key of a scene's provenance that states the radius r of its true particles, scene units: each fills (2r)^3.
PARTICLE_RADIUS = "particle_radius"


def true_spacing(scene: Scene, true: Particles) -> float | None:
    """Spacing 2r of the true particles, scene units: as the provenance states it, else estimated.

    The estimate is the `spacing` in the frame with the most particles; None where no frame has enough of them.
    """
    stated = scene.meta.provenance.get(PARTICLE_RADIUS) if scene.meta else None
    if isinstance(stated, int | float) and math.isfinite(stated) and stated > 0:
        return 2.0 * float(stated)
    return spacing(true.at(int(true.active.sum(axis=1).argmax())).astype(np.float64))


def truth_grid(fields: DistanceFields) -> Grid:
    """The grid that the truth is compared on: that of the signed distances from the training masks."""
    nx, ny, nz = fields.phi.shape[1:]
    return Grid(np.asarray(fields.origin, dtype=np.float64), float(fields.voxel), (nx, ny, nz))


def true_distance(true: Particles, t: int, spacing_units: float, grid: Grid) -> Field:
    """Signed distance to the true liquid of frame `t` on `grid`: float32, voxels, clipped to +-2."""
    return particle_distance(_nodes(true.at(t), grid), spacing_units / grid.voxel, grid.shape)


def true_geometry(scene: Scene, fields: DistanceFields) -> SignedDistance | None:
    """The true liquid as a submission would hand it in; None where the scene has no truth."""
    true = scene.truth_particles()
    size = true_spacing(scene, true) if true is not None else None
    if true is None or size is None:
        return None
    grid = truth_grid(fields)
    frames = [
        SignedDistance.of(true_distance(true, t, size, grid)[None], grid.origin, grid.voxel).phi
        for t in range(scene.n_frames)
    ]
    return SignedDistance(np.concatenate(frames), grid.origin, grid.voxel)


def oracle_geometry(scene: Scene, protocol: Protocol = PROTOCOL_V1) -> SignedDistance | None:
    """The true liquid as the control `oracle` hands it in, on the grid of `protocol`.

    None where the scene has no truth, or its training masks give no hull, hence no grid.
    """
    try:
        return true_geometry(scene, signed_distance_fields(scene.training(), cells_longest_axis=protocol.grid_cells))
    except SplashbenchError:
        return None


def score_ground_truth(
    scene: Scene,
    submission: Any,
    particles: Particles | None,
    no_particles: str,
    fields: Callable[[], DistanceFields],
    protocol: Protocol,
    track: Track,
) -> dict[str, MetricValue]:
    """Every metric against the truth; `fields` is asked only where there is one.

    Args:
        particles: the submission's liquid particles, on the scene's frames, or None for the reason `no_particles`.
    """
    true = scene.truth_particles()
    if true is None:
        return _null(TRUTH_METRICS, NO_TRUTH)
    size = true_spacing(scene, true)
    if size is None:
        return _null(TRUTH_METRICS, "the true particles are too few in every frame to tell their spacing")
    try:
        grid = truth_grid(fields())
    except SplashbenchError as error:
        return _null(TRUTH_METRICS, f"no hull to take the grid from: {error}")
    geometry = submission.geometry()
    no_geometry = ""
    if geometry is not None and geometry.n_frames != scene.n_frames:
        no_geometry = f"the geometry has {geometry.n_frames} instants, the scene {scene.n_frames} frames"
    elif geometry is None and particles is None:
        no_geometry = f"no geometry, and {no_particles}"
    no_motion = "the frames' times are unknown" if scene.times_source == "nominal" else no_particles
    gravity, no_flight = _gravity(scene, true, protocol)
    shapes: list[dict[str, float | None]] = []
    motions: list[FrameMotion] = []
    for t in track(range(scene.n_frames), "scoring against the truth"):
        phi = true_distance(true, t, size, grid)
        surface = surface_points(phi)
        shapes.append({} if no_geometry else _shape(phi, surface, _reconstruction(geometry, particles, t, grid)))
        if particles is not None and not no_motion and t + 1 < scene.n_frames:
            motions.append(_motion(scene, true, particles, t, grid, surface, gravity))
    if no_geometry:
        values = _null(GEOMETRY_METRICS, no_geometry)
    else:
        empty = "no frame has true liquid that the grid can show"
        if any(shapes):  # precision alone may be missing then
            empty = "nothing is reconstructed where there is true liquid to compare"
        values = {name: frame_mean(name, [shape.get(name) for shape in shapes], empty) for name in GEOMETRY_METRICS}
    return values | (_null(MOTION_METRICS, no_motion) if no_motion else _motion_values(motions, no_flight))


def _null(names: Sequence[str], reason: str) -> dict[str, MetricValue]:
    return {name: metric_value(name, None, reason) for name in names}


def _nodes(points: NDArray[np.floating], grid: Grid) -> NDArray[np.float64]:
    """Scene units to node coordinates, in double precision."""
    return (np.asarray(points, dtype=np.float64) - grid.origin) / grid.voxel


def _within(nodes: NDArray[np.float64], grid: Grid) -> NDArray[np.bool_]:
    """Which of `nodes` [N, 3] lie on the grid."""
    return np.all((nodes >= 0) & (nodes <= np.array(grid.shape) - 1), axis=1)


def _gravity(scene: Scene, true: Particles, protocol: Protocol) -> tuple[NDArray[np.float64] | None, str]:
    """Acceleration of free fall [3], scene units per second squared; or None and what is missing."""
    if true.velocities is None:
        return None, "the true particles have no velocities"
    if scene.gravity is None or scene.metres_per_unit is None:
        return None, "the scene does not say gravity's direction or the metric scale (scene.json)"
    return scene.gravity * (protocol.gravity_m_s2 / scene.metres_per_unit), ""


def _reconstruction(geometry: SignedDistance | None, particles: Particles | None, t: int, grid: Grid) -> Field:
    """Signed distance to the reconstructed liquid of frame `t` on `grid`."""
    if geometry is not None:
        return resampled(geometry, t, grid)
    assert particles is not None
    nodes = _nodes(particles.at(t), grid)
    nodes = nodes[_within(nodes, grid)]
    size = spacing(nodes)
    # Too few particles to tell their spacing are lone drops, as small as the grid can show.
    return filled(particle_distance(nodes, size if size is not None else 0.0, grid.shape))


def _shape(true: Field, true_surface: NDArray[np.float64], reconstructed: Field) -> dict[str, float | None]:
    """The geometry metrics of one frame; none where there is no true liquid."""
    shared = overlap(true, reconstructed)
    if shared.true == 0:
        return {}
    return {
        "surface_chamfer": chamfer(true_surface, surface_points(reconstructed)),
        "sdf_iou": shared.iou,
        "sdf_recall": shared.recall,
        "sdf_precision": shared.precision,
    }


def _motion(
    scene: Scene,
    true: Particles,
    particles: Particles,
    t: int,
    grid: Grid,
    surface: NDArray[np.float64],
    gravity: NDArray[np.float64] | None,
) -> FrameMotion:
    per_step = (scene.times[t + 1] - scene.times[t]) / grid.voxel
    # Displacements are compared with displacements, velocities at an instant with such: over a step of free fall the
    # two differ by half of g dt^2, which is no error of the method.
    like = true if particles.velocities is not None else Particles(true.positions, true.active)
    true_rows, true_velocities = known_velocities(like, t, scene.times)
    rows, velocities = known_velocities(particles, t, scene.times)
    falling = None if gravity is None else free_flight(true, t, scene.times, gravity)
    airborne = np.zeros(len(true_rows), bool) if falling is None else falling[true_rows]
    true_nodes = _nodes(true.positions[t, true_rows], grid)
    inside = _within(true_nodes, grid)
    return frame_motion(
        true_nodes[inside],
        true_velocities[inside] * per_step,
        airborne[inside],
        surface,
        _nodes(particles.positions[t, rows], grid),
        velocities * per_step,
    )


def _motion_values(motions: list[FrameMotion], no_flight: str) -> dict[str, MetricValue]:
    """Pooled over all frames: a frame with three drops must not weigh as much as the whole splash."""
    none: NDArray[Any] = np.zeros(0)
    errors, moved = (
        np.concatenate([none, *(getattr(motion, name) for motion in motions)]) for name in ("errors", "moved")
    )
    airborne = np.concatenate([none, *(motion.airborne for motion in motions)]).astype(bool)
    near = sum(motion.near for motion in motions)
    if near == 0:
        return _null(MOTION_METRICS, "no true particle is near a surface over a step")
    out_of_reach = "no reconstructed particle with a velocity comes near a true one"
    pooled = {
        "velocity_epe": (float(errors.mean()) if len(errors) else None, "error", out_of_reach),
        "velocity_epe_relative": (
            relative(errors, moved),
            "relative",
            "the true liquid does not move" if len(errors) else out_of_reach,
        ),
        "airborne_epe_relative": (
            relative(errors[airborne], moved[airborne]),
            "relative_airborne",
            no_flight or (out_of_reach if len(errors) == 0 else "nothing is in free flight"),
        ),
        "velocity_coverage": (len(errors) / near, "coverage", ""),
    }
    values = {}
    for name, (value, of_frame, reason) in pooled.items():
        frames = tuple(getattr(motion, of_frame) for motion in motions)
        # The last frame has no step of its own; it is not counted as skipped.
        skipped = sum(frame is None for frame in frames)
        values[name] = metric_value(name, value, reason, skipped_frames=skipped, frames=(*frames, None))
    return values

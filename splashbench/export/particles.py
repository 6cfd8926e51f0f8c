"""A method's particles: a .ply of points for each timestep, and all of them in one .npz."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from splashbench.export.instants import all_or, timesteps
from splashbench.export.manifest import Manifest, export_folder, frame_files, nothing_of, write_manifest
from splashbench.export.placement import Placement
from splashbench.files import atomic_path
from splashbench.files.ply import write_vertices
from splashbench.progress import track
from splashbench.replay import Reconstruction

PARTICLES = "particles.npz"
_NO_VELOCITY = "the method hands in no velocities of its particles; the files have none"


def export_particles(
    reconstruction: Reconstruction,
    out: Path | str,
    times: NDArray[np.float64] | None = None,
    placement: Placement | None = None,
    *,
    replace: bool = False,
) -> Manifest:
    """Write the particles at `times` [F], timesteps in seconds (all by default), into the folder `out`.

    frames/frame0001.ply and so on have x y z, vx vy vz where velocities are known, and id: the number of the particle,
    by which it is followed from file to file. particles.npz has the same rows of all instants after one another:
    times [F], start [F + 1] (rows of instant f are start[f] to start[f + 1]), positions [M, 3], velocities [M, 3],
    ids [M]. placement: units and axes, the scene's own by default; velocities are in units per second.

    Raises SplashbenchError for a method without particles, for instants that are no timesteps, and for places that are
    taken.
    """
    instants, placed = all_or(reconstruction, times), placement or Placement()
    particles = reconstruction.particles()
    if particles is None:
        raise nothing_of(reconstruction, "particles", "export its mesh or its Gaussians (--format mesh or ply)")
    steps = timesteps(reconstruction, instants, "particles")
    files = frame_files(len(instants), "ply")
    kept: list[dict[str, NDArray]] = []
    with export_folder(reconstruction, out, replace) as staging:
        for name, t in zip(files, track(steps, "exporting particles", total=len(steps))):
            ids = np.flatnonzero(particles.active[t]).astype(np.int32)
            instant: dict[str, NDArray] = {"ids": ids}
            instant["positions"] = placed.points(particles.positions[t][ids]).astype(np.float32)
            tables: dict[tuple[str, ...], NDArray] = {("x", "y", "z"): instant["positions"]}
            if particles.velocities is not None:
                instant["velocities"] = placed.points(particles.velocities[t][ids]).astype(np.float32)
                tables["vx", "vy", "vz"] = instant["velocities"]
            write_vertices(staging / name, {**tables, ("id",): ids[:, None]})
            kept.append(instant)
        counts = [len(each["ids"]) for each in kept]
        arrays = {key: np.concatenate([each[key] for each in kept]) for key in kept[0]}
        start = np.concatenate([[0], np.cumsum(counts)]).astype(np.int64)
        with atomic_path(staging / PARTICLES) as temporary, temporary.open("wb") as stream:
            np.savez_compressed(stream, allow_pickle=False, times=instants, start=start, **arrays)
        return write_manifest(
            staging,
            reconstruction,
            "particles",
            instants,
            placed,
            [*files, PARTICLES],
            counts={"particles": counts},
            notes=[_NO_VELOCITY] if particles.velocities is None else [],
        )

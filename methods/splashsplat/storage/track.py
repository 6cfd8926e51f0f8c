"""A track as it is stored: carriers by rows.py, the motion and phi in whole numbers."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from splashbench.native import memory
from splashbench.observe.grid import Grid

from ..carriers.population import Carriers
from ..carriers.precision import Precision
from ..carriers.subframe import Track
from ..fields.sparse_frames import Frames
from ..motion.fall import falls_of, table_of
from ..motion.steps import Motion
from ..motion.velocity import Factor
from .rows import StoredRows, read_rows, store_rows, stored_order, whole_velocities

#: Arrays of the files of a track, each with its number of dimensions; `deformation` is optional.
CARRIERS: Mapping[str, int] = {"births": 1, "lives": 1, "cells": 1, "within": 2, "residuals": 2}
DEFORMATION: Mapping[str, int] = {"deformation": 3}
MOTION: Mapping[str, int] = {"velocities": 5, "jets": 2, "turn": 2}
DISTANCE: Mapping[str, int] = {"phi": 4}  # of format 6 and before


def stored_track(track: Track, times: np.ndarray, carried: bool, precision: Precision) -> Track:
    """`track` in the precision in which it is stored, its carriers numbered anew; its phi is in stored steps already.

    times: [T] of the frames, seconds. carried: whether the motion is what moved the carriers; else their F is stored.
    precision: of places and velocities.
    """
    carriers = stored_order(track.carriers, track.grid.shape, precision.steps)
    coarse = replace(track, carriers=carriers, precision=precision)
    rows, moves = carrier_arrays(coarse, coarse.carriers, carried), motion_arrays(coarse)
    phi = coarse.phi
    del coarse, carriers
    memory.give_back()
    motion = _read_motion(moves, track.grid, times, track.motion.factor, precision)
    carriers = _read_carriers(rows, moves, motion, phi, track.grid, precision)
    return Track(track.grid, carriers, motion, phi, precision)


def track_arrays(track: Track, carried: bool) -> dict[str, dict[str, np.ndarray]]:
    """What is stored of a track but phi, by file. Of one that `stored_track` gave, this loses nothing."""
    return {
        "carriers": carrier_arrays(track, track.carriers, carried),
        "motion": motion_arrays(track),
    }


def motion_arrays(track: Track) -> dict[str, np.ndarray]:
    """What is stored of the motion of `track`."""
    jets, turn = table_of(track.motion.falls)
    return {"velocities": whole_velocities(track.motion.velocities, track.precision), "jets": jets, "turn": turn}


def carrier_arrays(track: Track, carriers: Carriers, carried: bool) -> dict[str, np.ndarray]:
    """What is stored of `carriers`, those of `track` or some of them."""
    control = whole_velocities(track.motion.velocities, track.precision)
    rows = dict(vars(store_rows(carriers, control, track.motion, track.grid, track.precision.steps)))
    if not carried:
        rows["deformation"] = carriers.deformation.astype(np.float16)
    return rows


def read_track(
    arrays: Mapping[str, Mapping[str, np.ndarray]],
    phi: Frames,
    grid: Grid,
    times: np.ndarray,
    factor: Factor,
    precision: Precision,
) -> Track:
    """The track of what `track_arrays` gave, and of its packed phi. Raises ValueError where it does not fit
    together."""
    n_frames = len(times)
    control = arrays["motion"]["velocities"]
    if control.shape[0] != max(n_frames - 1, 0) or control.shape[4] != 3 or min(control.shape[1:4]) < 2:
        raise ValueError(f"velocities of shape {control.shape} do not fit {n_frames} frames")
    births = arrays["carriers"]["births"]
    if births.shape != (n_frames,):
        raise ValueError(f"births of shape {births.shape} do not fit {n_frames} frames")
    if phi.shape != (n_frames, *grid.shape):
        raise ValueError(f"phi is of shape {phi.shape}, not of {n_frames} frames on {grid.shape} nodes")
    motion = _read_motion(arrays["motion"], grid, times, factor, precision)
    carriers = _read_carriers(arrays["carriers"], arrays["motion"], motion, phi, grid, precision)
    return Track(grid, carriers, motion, phi, precision)


def _read_motion(
    arrays: Mapping[str, np.ndarray], grid: Grid, times: np.ndarray, factor: Factor, precision: Precision
) -> Motion:
    falls = falls_of(arrays["jets"], arrays["turn"], grid, times)
    return Motion(arrays["velocities"].astype(np.float32) / np.float32(precision.velocity_steps), factor, falls)


def _read_carriers(
    arrays: Mapping[str, np.ndarray],
    moves: Mapping[str, np.ndarray],
    motion: Motion,
    phi: Frames,
    grid: Grid,
    precision: Precision,
) -> Carriers:
    rows = StoredRows(**{name: arrays[name] for name in CARRIERS})
    carriers = read_rows(rows, moves["velocities"], motion, phi, grid, precision.steps)
    deformation = arrays.get("deformation")
    if deformation is not None:
        if deformation.shape != carriers.deformation.shape:
            raise ValueError(f"deformation of shape {deformation.shape} does not fit {len(carriers.ids)} rows")
        carriers = replace(carriers, deformation=deformation)
    return carriers

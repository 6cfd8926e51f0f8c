"""A reader of fitted liquids that uses nothing of splashbench, written from storage/FORMAT.md alone."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np


def read(directory: Path) -> dict[str, list[np.ndarray] | np.ndarray]:
    """Of every frame the carriers' numbers and places (voxels), phi (voxels), and the carriers' values [N, D]."""
    header = json.loads((directory / "liquid.json").read_text())
    rows, motion, distance, look = (
        np.load(directory / f"{name}.npz") for name in ("carriers", "motion", "distance", "appearance")
    )
    shape = np.array(header["grid"]["shape"])
    factor = np.broadcast_to(np.array(header["factor"], dtype=float), 3)
    births = np.repeat(np.arange(len(rows["births"])), rows["births"])
    ends = births + rows["lives"]
    cells = np.stack(np.unravel_index(np.cumsum(rows["cells"].astype(int)), shape), axis=1)
    steps = header["steps"]
    place = cells * steps + rows["within"]
    moves = iter(rows["residuals"].astype(int))
    numbers, places = [], []
    for t in range(len(header["times"])):
        for number in np.flatnonzero((births < t) & (ends > t)):
            velocity = _velocity(motion["velocities"][t - 1], factor, place[number] / steps)
            led = place[number] + np.rint(velocity / 2).astype(int)
            place[number] = np.clip(led + next(moves), 0, shape * steps - 1)
        numbers.append(np.flatnonzero((births <= t) & (ends > t)))
        places.append(place[numbers[-1]] / steps)
    assert next(moves, None) is None
    phi = np.cumsum(distance["phi"].astype(int), axis=0) / 4 + 1 / 8
    values = np.zeros((len(rows["lives"]), len(look["center"])))
    for level in range(6):
        values[look["coarseness"] == level] = 2**level * (look[f"coefficients.{level}"].T @ look["basis"].astype(float))
    return {"ids": numbers, "places": places, "phi": phi, "values": values + look["center"]}


def _velocity(control: np.ndarray, factor: np.ndarray, place: np.ndarray) -> np.ndarray:
    """In half a step a frame at `place` [3] (voxels), linear between control nodes."""
    nodes = np.array(control.shape[:3])
    at = np.clip((place - (factor - 1) / 2) / factor, 0, nodes - 1)
    low = np.minimum(at.astype(int), nodes - 2)
    share = at - low
    total = np.zeros(3)
    for corner in np.ndindex(2, 2, 2):
        weight = np.prod(np.where(np.array(corner) == 1, share, 1 - share))
        total = total + weight * control[tuple(low + corner)]
    return total

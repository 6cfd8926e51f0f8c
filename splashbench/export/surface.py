"""The liquid's surface as a closed mesh: marching cubes of a signed distance, in three steps that keep it closed.

Values are undone of their rounding first, so that none is 0: at nodes that lie in the surface itself marching cubes
makes triangles without area, and holes (scikit-image issue 8116). The grid is framed by a layer without liquid, where
surfaces end that reach its border. Last, the vertices move by one small distance along their normals, so that the mesh
encloses the volume in which the distance is negative: flat triangles bridge the hollows of thin sheets.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import product

import numpy as np
from numpy.typing import NDArray

from splashbench.scene import SignedDistance
from splashbench.scene.geometry import MAX_STEPS

# What 0 and -1 stand for, in the steps of SignedDistance: 0 is [0, .5], and -1 is (-1.5, 0), as what is below 0 stays
# so. All other steps stand for half a step to either side.
_AT_ZERO, _BELOW_ZERO = 0.25, -0.75
# How far vertices may move for the volume's sake, voxels, and the depth from which they may move so far. Less deep ones
# move by less, at most .4 of their depth: the two sides of the thinnest sheets must not pass each other.
_FARTHEST, _FREE = 0.1, 0.25
_ROUNDS = 4
# What is off a grid line by more lies on none, cells; an area that is none.
_ON_EDGE, _NO_AREA = 1e-4, 1e-30
# Lines per cell and axis that its volume is integrated along.
_SAMPLES = 4


@dataclass(frozen=True)
class SurfaceMesh:
    """A closed mesh of triangles, whose corners run counter-clockwise seen from outside.

    Attributes:
        vertices: [V, 3] float64, scene units. faces: [F, 3] int32, indices into them.
        normals: [V, 3] float64, unit vectors that point out of the liquid.
    """

    vertices: NDArray[np.float64]
    faces: NDArray[np.int32]
    normals: NDArray[np.float64]


def surface_mesh(distance: SignedDistance) -> SurfaceMesh:
    """The mesh around all liquid of a signed distance at one instant; empty where there is no liquid.

    Raises ValueError for several instants.
    """
    if distance.n_frames != 1:
        raise ValueError(f"the distance has {distance.n_frames} instants, not one")
    steps = distance.phi[0]
    if not (steps < 0).any():
        return SurfaceMesh(np.zeros((0, 3)), np.zeros((0, 3), np.int32), np.zeros((0, 3)))
    from skimage.measure import marching_cubes

    field, corner = _framed(steps)
    # "descent" has the corners run counter-clockwise from outside where inside is below the level.
    vertices, faces, _, _ = marching_cubes(field, 0.0, gradient_direction="descent")
    faces = np.ascontiguousarray(faces, dtype=np.int32)
    depths = _depths(field, vertices)
    vertices = _with_volume(vertices.astype(np.float64), faces, depths, volume_below(field))
    normals = _normals(vertices, faces)
    return SurfaceMesh(distance.origin + (vertices + corner) * distance.voxel, faces, normals)


def _framed(steps: NDArray[np.int8]) -> tuple[NDArray[np.float32], NDArray[np.int64]]:
    """The part of `steps` that has liquid, unrounded, in a frame without any; and which node its corner is, [3]."""
    where = np.nonzero(steps < 0)
    low = np.array([axis.min() for axis in where]) - 1
    high = np.array([axis.max() for axis in where]) + 2
    inside = tuple(slice(max(a, 0), b) for a, b in zip(low, high))
    part = steps[inside].astype(np.float32)
    part[steps[inside] == 0] = _AT_ZERO
    part[steps[inside] == -1] = _BELOW_ZERO
    missing = [(int(a < 0), int(b > n)) for a, b, n in zip(low, high, steps.shape)]
    return np.pad(part, missing, constant_values=MAX_STEPS), low.astype(np.int64)


def volume_below(field: NDArray[np.floating], samples: int = _SAMPLES) -> float:
    """The volume in which `field` [nx, ny, nz], trilinear between nodes, is negative, in cells of the grid.

    Cells of one sign are full or empty. Of the others, samples^2 lines along the axis on which the field changes most
    are cut exactly where it is 0. Counting nodes would take sheets of one node's thickness for a voxel thick, whatever
    their distances say, and counting points within cells errs for all cells of a level surface alike.
    """
    shape = [n - 1 for n in field.shape]
    corners = [field[tuple(slice(o, o + n) for o, n in zip(offset, shape))] for offset in product((0, 1), repeat=3)]
    below = np.zeros(shape, np.int8)
    for corner in corners:
        below += corner < 0
    mixed = (below > 0) & (below < 8)
    values = np.stack([corner[mixed] for corner in corners], axis=1).reshape(-1, 2, 2, 2).astype(np.float64)
    slopes = np.abs([np.diff(values, axis=axis).sum(axis=(1, 2, 3)) for axis in (1, 2, 3)]).argmax(axis=0)
    places = (np.arange(samples) + 0.5) / samples
    weights = np.stack([1 - places, places])
    total = float((below == 8).sum())
    for axis in range(3):
        steep = np.moveaxis(values[slopes == axis], 1 + axis, 3)
        start, end = np.moveaxis(np.einsum("nabc,ai,bj->nijc", steep, weights, weights), 3, 0)
        # The share of a line between both ends where a linear function is negative.
        low, high = np.minimum(start, end), np.maximum(start, end)
        share = np.where(low < 0, 1.0, 0.0)
        crossed = (low < 0) & (high > 0)
        share[crossed] = low[crossed] / (low[crossed] - high[crossed])
        total += float(share.sum()) / samples**2
    return total


def _depths(field: NDArray[np.float32], vertices: NDArray[np.float32]) -> NDArray[np.float64]:
    """How far vertices [V, 3] of marching cubes lie from the node within the liquid whose edge they cut: [V], cells.

    It is 0 for the few that lie on no edge, in the middle of a cell.
    """
    nearest = np.rint(vertices)
    off = np.abs(vertices - nearest)
    axis = off.argmax(axis=1)
    low = nearest.astype(np.int64)
    rows = np.arange(len(vertices))
    low[rows, axis] = np.floor(vertices[rows, axis])
    fraction = vertices[rows, axis] - low[rows, axis]
    depths = np.where(field[tuple(low.T)] < 0, fraction, 1 - fraction)
    return np.where((off > _ON_EDGE).sum(axis=1) > 1, 0.0, depths)


def _with_volume(
    vertices: NDArray[np.float64], faces: NDArray[np.int32], depths: NDArray[np.float64], volume: float
) -> NDArray[np.float64]:
    """The vertices moved along their normals, so that the mesh encloses `volume`: all as far, but near nodes less."""
    freedom = np.minimum(depths / _FREE, 1)[:, None]
    moved = 0.0
    for _ in range(_ROUNDS):
        areas = _vertex_areas(vertices, faces)
        sizes = np.linalg.norm(areas, axis=1, keepdims=True)
        slope = float((sizes * freedom).sum()) / 3
        if slope <= 0:
            break
        step = (volume - _enclosed(vertices, faces)) / slope
        step = float(np.clip(step, -_FARTHEST - moved, _FARTHEST - moved))
        vertices = vertices + step * freedom * areas / np.maximum(sizes, _NO_AREA)
        moved += step
    return vertices


def _normals(vertices: NDArray[np.float64], faces: NDArray[np.int32]) -> NDArray[np.float64]:
    """Unit normals [V, 3]: means over a vertex's faces, weighted by area."""
    areas = _vertex_areas(vertices, faces)
    return np.asarray(areas / np.maximum(np.linalg.norm(areas, axis=1, keepdims=True), _NO_AREA))


def _vertex_areas(vertices: NDArray[np.float64], faces: NDArray[np.int32]) -> NDArray[np.float64]:
    """Of each vertex the sum of its faces' area vectors, [V, 3]: along the normal; a third is the volume's slope."""
    a, b, c = (vertices[corner] for corner in faces.T)
    areas = np.cross(b - a, c - a) / 2
    return np.stack(
        [
            sum(np.bincount(corner, weights=areas[:, axis], minlength=len(vertices)) for corner in faces.T)
            for axis in range(3)
        ],
        axis=1,
    )


def _enclosed(vertices: NDArray[np.float64], faces: NDArray[np.int32]) -> float:
    """The volume within a closed mesh."""
    middle = vertices.mean(axis=0)  # far from it, tetrahedra are large and cancel badly
    a, b, c = (vertices[corner] - middle for corner in faces.T)
    return float(np.einsum("ij,ij->", a, np.cross(b, c)) / 6)

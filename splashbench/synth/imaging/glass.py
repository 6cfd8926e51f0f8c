"""Clear glass between the camera and the room: what it lets through, and what it mirrors.

The glass is one closed mesh with thick walls. It absorbs light on the way through (Beer-Lambert; soda-lime glass is
faintly green). Each of its faces mirrors the surroundings (Fresnel's reflectance after Schlick 1994). Along its edges
it is ground: pale, and only half clear. It does not refract: rays go straight on, so that masks, cameras and truth
agree to the pixel. It casts no shadow.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from splashbench.synth.imaging.geometry import Mesh
from splashbench.synth.imaging.raycast import FAR, Tracer
from splashbench.synth.imaging.shading import surroundings

Vectors = NDArray[np.float32]
Lengths = NDArray[np.float32]
Distance = Lengths | np.float32 | float

#: Walls that one ray can cross: an open box, one convex body less another, has two.
WALLS = 2
ABSORPTION = np.array([16.0, 4.0, 7.0], np.float32)  # per metre of red, green and blue light
_REFLECTANCE_HEAD_ON = 0.04  # of glass in air
_GROUND_WIDTH = np.float32(0.0012)  # metres to either side of an edge
_GROUND_CLEAR = np.float32(0.5)
_GROUND_LIGHT = np.array([0.25, 0.33, 0.31], np.float32)
_SHARP_COSINE = 0.7  # between the normals of two faces: less is an edge of the body
_BEYOND = np.float32(2e-5)  # metres behind a face at which the search for the next one begins


@dataclass(frozen=True, eq=False)
class Panes:
    """The walls of glass along R rays, the nearest first.

    `distance` [R, WALLS] metres to where each begins, FAR where there is none; `transmitted` and `mirrored`
    [R, WALLS, 3]: the share of the light from behind that comes through, and the light that is added.
    """

    distance: Lengths
    transmitted: Vectors
    mirrored: Vectors

    @property
    def met(self) -> NDArray[np.bool_]:
        """Which rays [R] meet glass at all."""
        return self.distance[:, 0] < FAR

    def of(self, rays: NDArray[np.int_]) -> Panes:
        """The walls along some of the rays."""
        return Panes(self.distance[rays], self.transmitted[rays], self.mirrored[rays])

    def through(self, color: Vectors, begin: Distance, end: Distance) -> Vectors:
        """Light `color` [R, 3] after the walls that begin at distances between `begin` and `end`, metres."""
        for k in reversed(range(WALLS)):
            between = (self.distance[:, k] >= begin) & (self.distance[:, k] < end)
            color = np.where(between[:, None], color * self.transmitted[:, k] + self.mirrored[:, k], color)
        return color


class Glass:
    """A body of glass, ready to be looked through."""

    def __init__(self, mesh: Mesh) -> None:
        self._tracer = Tracer([(mesh.vertices, mesh.faces)])
        a, b, c = (mesh.vertices[mesh.faces[:, k]] for k in range(3))
        normals = np.cross(b - a, c - a)
        self._normals = (normals / np.linalg.norm(normals, axis=1, keepdims=True)).astype(np.float32)
        self._edges = mesh.vertices[_sharp_edges(mesh.faces, self._normals)]

    def along(self, eye: Vectors, directions: Vectors) -> Panes:
        """The walls that rays from `eye` [3] along unit `directions` [R, 3] cross."""
        n = len(directions)
        panes = Panes(
            np.full((n, WALLS), FAR, np.float32),
            np.ones((n, WALLS, 3), np.float32),
            np.zeros((n, WALLS, 3), np.float32),
        )
        rays, reach = np.arange(n), np.zeros(n, np.float32)
        for k in range(WALLS):
            rays, entry, way_in = self._faces(eye, directions, rays, reach, inwards=True)
            through, leaving, way_out = self._faces(eye, directions, rays, entry + _BEYOND, inwards=False)
            crossed = np.isin(rays, through)
            rays, entry, way_in = rays[crossed], entry[crossed], way_in[crossed]
            light = directions[rays]
            first, first_mirrored = _face(light, way_in)
            second, second_mirrored = _face(light, way_out)
            absorbed = np.exp(-ABSORPTION * (leaving - entry)[:, None])
            panes.distance[rays, k] = entry
            transmitted = absorbed * (1 - first) * (1 - second)
            # What the far face mirrors crosses the wall twice.
            mirrored = first_mirrored + absorbed**2 * (1 - first) ** 2 * second_mirrored
            ground = self._near_edge(eye + entry[:, None] * light)[:, None]
            panes.transmitted[rays, k] = np.where(ground, _GROUND_CLEAR * transmitted, transmitted)
            panes.mirrored[rays, k] = np.where(ground, mirrored + _GROUND_LIGHT, mirrored)
            reach = leaving + _BEYOND
        return panes

    def _near_edge(self, points: Vectors) -> NDArray[np.bool_]:
        """Which points [R, 3] lie in the ground strip along an edge."""
        near = np.zeros(len(points), bool)
        for start, end in self._edges:
            way = end - start
            along = np.clip((points - start) @ way / (way @ way), 0, 1)
            gap = points - start - along[:, None] * way
            near |= np.einsum("ij,ij->i", gap, gap) < _GROUND_WIDTH**2
        return near

    def _faces(
        self, eye: Vectors, directions: Vectors, rays: NDArray[np.int_], reach: Lengths, inwards: bool
    ) -> tuple[NDArray[np.int_], Lengths, Vectors]:
        """The next face beyond `reach` of those `rays` that meet one and cross it the way asked for.

        A ray that cuts an edge more finely than single precision can tell meets faces out of turn, and is left out.
        Returns the rays, the distances from the eye, and the faces' outward normals.
        """
        towards = directions[rays]
        hits = self._tracer.nearest(eye + reach[:, None] * towards, towards)
        normal = self._normals[np.maximum(hits.triangle, 0)]
        right_way = (np.einsum("ij,ij->i", normal, towards) < 0) == inwards
        crossed = (hits.geometry >= 0) & right_way
        return rays[crossed], (reach + hits.distance)[crossed], normal[crossed]


def _sharp_edges(faces: NDArray[np.int32], normals: Vectors) -> NDArray[np.int64]:
    """Vertex indices [E, 2] of the edges at which a closed mesh bends sharply."""
    edges = np.sort(np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]]), axis=1)
    order = np.lexsort((edges[:, 1], edges[:, 0]))
    owner = np.tile(np.arange(len(faces)), 3)[order].reshape(-1, 2)  # closed: every edge has two faces
    bend = np.einsum("ij,ij->i", normals[owner[:, 0]], normals[owner[:, 1]])
    return edges[order][::2][bend < _SHARP_COSINE].astype(np.int64)


def _face(directions: Vectors, normals: Vectors) -> tuple[Vectors, Vectors]:
    """Reflectance [R, 1] of faces with these normals, and the light [R, 3] they mirror."""
    cosine = np.einsum("ij,ij->i", directions, normals)[:, None]
    reflectance = _REFLECTANCE_HEAD_ON + (1 - _REFLECTANCE_HEAD_ON) * (1 - np.abs(cosine)) ** 5
    mirrored = surroundings((directions - 2 * cosine * normals).astype(np.float32))
    return reflectance.astype(np.float32), (reflectance * mirrored).astype(np.float32)

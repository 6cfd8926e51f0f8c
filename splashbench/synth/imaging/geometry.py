"""Where everything in a synthetic capture stands: the bowl or tank, the arc of cameras and the rectangles of the room.

World coordinates are metres with y up; the container stands on the table (y = 0) at the origin. The arc follows the
paper's rig (Sec. 4, "Capture and calibration"): seven cameras over 77 degrees, and the test views lie between
training views.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

ARC_DEGREES = 77.0
ARC_RADIUS = 0.95
ARC_ELEVATION_DEGREES = 22.0
# Place along the arc (0..6) of the cameras with ids 1..7; ids 6 and 7 are the test views.
ARC_ORDER = (0, 2, 3, 5, 6, 1, 4)
LOOK_AT = np.array([0.0, 0.11, 0.0])

BOWL_RIM_RADIUS = 0.108
BOWL_RIM_HEIGHT = 0.088
_BOWL_WALL = 0.009
_BOWL_FOOT_RADIUS = 0.05
_BOWL_FOOT_HEIGHT = 0.008

TANK_SIZE = np.array([0.22, 0.14, 0.16])  # of the outside: width, height, depth
TANK_WALL = 0.005


@dataclass(frozen=True, eq=False)
class Mesh:
    """A triangle mesh: `vertices` [V, 3] metres, `faces` [F, 3], unit `normals` [V, 3]."""

    vertices: NDArray[np.float32]
    faces: NDArray[np.int32]
    normals: NDArray[np.float32]


@dataclass(frozen=True, eq=False)
class Quad:
    """A textured rectangle: `corner` [3] and its two sides `side_u`, `side_v` [3], at right angles to each other.

    `texture` [h, w, 3] float32, linear albedo; its columns run along `side_u` and its rows along `side_v`.
    """

    corner: Array
    side_u: Array
    side_v: Array
    texture: NDArray[np.float32]

    def mesh(self) -> tuple[NDArray[np.float32], NDArray[np.int32]]:
        """Its four vertices and two triangles."""
        c, u, v = self.corner, self.side_u, self.side_v
        vertices = np.array([c, c + u, c + u + v, c + v], np.float32)
        return vertices, np.array([[0, 1, 2], [0, 2, 3]], np.int32)


def bowl_mesh(segments: int = 72, rings: int = 20) -> Mesh:
    """A thick, footed bowl as a closed surface of revolution about the y axis, its foot on y = 0."""
    s = np.linspace(0.0, 1.0, rings)
    inner = np.stack([(BOWL_RIM_RADIUS - _BOWL_WALL) * s, 0.013 + (BOWL_RIM_HEIGHT - 0.013) * s**2.2], axis=1)
    angle = np.linspace(np.pi, 0.0, 7)[1:-1]  # the rounded lip, from the inside to the outside
    half = _BOWL_WALL / 2
    lip = np.stack([BOWL_RIM_RADIUS - half + half * np.cos(angle), BOWL_RIM_HEIGHT + half * np.sin(angle)], axis=1)
    back = s[::-1]
    outer_radius = _BOWL_FOOT_RADIUS + (BOWL_RIM_RADIUS - _BOWL_FOOT_RADIUS) * back
    outer = np.stack([outer_radius, _BOWL_FOOT_HEIGHT + (BOWL_RIM_HEIGHT - _BOWL_FOOT_HEIGHT) * back**1.7], axis=1)
    foot = np.array([[_BOWL_FOOT_RADIUS, 0.0], [_BOWL_FOOT_RADIUS / 2, 0.0], [0.0, 0.0]])
    return revolve(np.concatenate([inner, lip, outer, foot]), segments)


def tank_mesh() -> Mesh:
    """A rectangular tank, open above, its walls and floor of one thickness: a closed mesh, its floor on y = 0."""
    corners = np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]]) / 2  # x, z: anticlockwise seen from below

    def ring(size: Array, y: float) -> Array:
        x, z = (corners * size).T
        return np.column_stack([x, np.full(4, y), z])

    outside, height = TANK_SIZE[[0, 2]], float(TANK_SIZE[1])
    inside = outside - 2 * TANK_WALL
    rings = [ring(outside, 0.0), ring(outside, height), ring(inside, height), ring(inside, TANK_WALL)]
    vertices = np.concatenate(rings)
    faces = [[0, 1, 2], [0, 2, 3], [12, 14, 13], [12, 15, 14]]
    # From the floor's edge up the outside, over the rim and down the inside.
    for low in (0, 4, 8):
        for k in range(4):
            a, b = low + k, low + (k + 1) % 4
            faces += [[a, a + 4, b + 4], [a, b + 4, b]]
    triangles = np.array(faces)
    return Mesh(vertices.astype(np.float32), triangles.astype(np.int32), _vertex_normals(vertices, triangles))


def revolve(profile: Array, segments: int) -> Mesh:
    """Turn `profile` [P, 2] (radius, height; first and last on the axis) about the y axis into a closed mesh."""
    theta = np.linspace(0.0, 2 * np.pi, segments, endpoint=False)
    middle = profile[1:-1]
    ring_points = np.stack(
        [
            middle[:, :1] * np.cos(theta),
            np.broadcast_to(middle[:, 1:], (len(middle), segments)),
            middle[:, :1] * np.sin(theta),
        ],
        axis=-1,
    )
    poles = np.array([[0.0, profile[0, 1], 0.0], [0.0, profile[-1, 1], 0.0]])
    vertices = np.concatenate([poles[:1], ring_points.reshape(-1, 3), poles[1:]])
    here = np.arange(segments)
    there = (here + 1) % segments
    faces = [np.stack([np.zeros(segments, int), 1 + here, 1 + there], axis=1)]
    for ring in range(len(middle) - 1):
        low, high = 1 + ring * segments, 1 + (ring + 1) * segments
        faces.append(np.stack([low + here, high + here, high + there], axis=1))
        faces.append(np.stack([low + here, high + there, low + there], axis=1))
    last = 1 + (len(middle) - 1) * segments
    faces.append(np.stack([last + here, np.full(segments, len(vertices) - 1), last + there], axis=1))
    triangles = np.concatenate(faces)
    # The profile runs from the inside over the lip to the outside: this winding makes the normals point out of the
    # clay.
    return Mesh(vertices.astype(np.float32), triangles.astype(np.int32), _vertex_normals(vertices, triangles))


def _vertex_normals(vertices: Array, faces: NDArray[np.int_]) -> NDArray[np.float32]:
    """Area-weighted unit vertex normals [V, 3]."""
    a, b, c = (vertices[faces[:, k]] for k in range(3))
    face_normals = np.cross(b - a, c - a)
    normals = np.zeros_like(vertices)
    for k in range(3):
        np.add.at(normals, faces[:, k], face_normals)
    return (normals / np.linalg.norm(normals, axis=1, keepdims=True)).astype(np.float32)


def look_at(eye: Array, target: Array, roll_degrees: float = 0.0) -> Array:
    """World-to-camera [4, 4] from `eye` to `target` (OpenCV axes, world y up), rolled about the viewing axis."""
    forward = (target - eye) / np.linalg.norm(target - eye)
    right = np.cross(forward, [0.0, 1.0, 0.0])
    right /= np.linalg.norm(right)
    down = np.cross(forward, right)
    cos, sin = np.cos(np.radians(roll_degrees)), np.sin(np.radians(roll_degrees))
    rotation = np.stack([cos * right + sin * down, cos * down - sin * right, forward])
    w2c = np.eye(4)
    w2c[:3, :3] = rotation
    w2c[:3, 3] = -rotation @ eye
    return w2c


def arc_point(fraction: float, radius: float = ARC_RADIUS, elevation_degrees: float = ARC_ELEVATION_DEGREES) -> Array:
    """A point [3] of the arc: `fraction` 0 is its first camera's place and 1 its last one's."""
    azimuth = np.radians((fraction - 0.5) * ARC_DEGREES)
    elevation = np.radians(elevation_degrees)
    direction = [np.sin(azimuth) * np.cos(elevation), np.sin(elevation), np.cos(azimuth) * np.cos(elevation)]
    return LOOK_AT + radius * np.array(direction)


def box_quads(centre: Array, size: Array, yaw_degrees: float, textures: list[NDArray[np.float32]]) -> list[Quad]:
    """The four walls and the lid of a box standing on the table at `centre` (x, z), `size` (x, y, z) metres."""
    cos, sin = np.cos(np.radians(yaw_degrees)), np.sin(np.radians(yaw_degrees))
    x, y, z = np.array([cos, 0.0, sin]) * size[0], np.array([0.0, size[1], 0.0]), np.array([-sin, 0.0, cos]) * size[2]
    base = np.array([centre[0], 0.0, centre[1]]) - x / 2 - z / 2
    top = base + y
    rectangles = [(top, x, -y), (top + z, x, -y), (top, z, -y), (top + x, z, -y), (top, x, z)]
    return [Quad(corner, u, v, texture) for (corner, u, v), texture in zip(rectangles, textures)]

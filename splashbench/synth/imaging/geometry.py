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


@dataclass(frozen=True)
class BowlShape:
    """A bowl in metres: its rim, its foot, its wall, and how steeply the wall rises.

    `floor` is the height of the inside at the axis; from there the height grows with the radius to the power
    `inner_power` on the inside and `outer_power` on the outside, above a foot `foot_height` high.
    """

    rim_radius: float = 0.108
    rim_height: float = 0.088
    wall: float = 0.009
    foot_radius: float = 0.05
    foot_height: float = 0.008
    floor: float = 0.013
    inner_power: float = 2.2
    outer_power: float = 1.7


BOWL = BowlShape()
#: Wider and lower than `BOWL`, with a flat floor and a steep wall.
BASIN = BowlShape(0.122, 0.078, 0.008, 0.088, 0.006, 0.012, inner_power=4.5, outer_power=1.6)
#: A round dish, lower and steeper still.
DISH = BowlShape(0.128, 0.064, 0.007, 0.108, 0.004, 0.009, inner_power=8.0, outer_power=1.5)

TANK_SIZE = np.array([0.22, 0.14, 0.16])  # of the outside: width, height, depth
TANK_WALL = 0.005


@dataclass(frozen=True, eq=False)
class Mesh:
    """A triangle mesh: `vertices` [V, 3] metres, `faces` [F, 3], unit `normals` [V, 3]."""

    vertices: NDArray[np.float32]
    faces: NDArray[np.int32]
    normals: NDArray[np.float32]

    @property
    def outward_faces(self) -> NDArray[np.int32]:
        """Of a closed mesh: its faces with corners anticlockwise seen from outside, as files of meshes have them."""
        a, b, c = (self.vertices[self.faces[:, k]].astype(np.float64) for k in range(3))
        inside_out = np.einsum("ij,ij->", a, np.cross(b, c)) < 0  # six times the signed volume
        return self.faces[:, [0, 2, 1]] if inside_out else self.faces


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


def bowl_mesh(shape: BowlShape = BOWL, segments: int = 72, rings: int = 20) -> Mesh:
    """A thick, footed bowl as a closed surface of revolution about the y axis, its foot on y = 0."""
    rim, height, foot_radius, foot_height = shape.rim_radius, shape.rim_height, shape.foot_radius, shape.foot_height
    s = np.linspace(0.0, 1.0, rings)
    inside = shape.floor + (height - shape.floor) * s**shape.inner_power
    inner = np.stack([(rim - shape.wall) * s, inside], axis=1)
    angle = np.linspace(np.pi, 0.0, 7)[1:-1]  # the rounded lip, from the inside to the outside
    half = shape.wall / 2
    lip = np.stack([rim - half + half * np.cos(angle), height + half * np.sin(angle)], axis=1)
    back = s[::-1]
    outside = foot_height + (height - foot_height) * back**shape.outer_power
    outer = np.stack([foot_radius + (rim - foot_radius) * back, outside], axis=1)
    foot = np.array([[foot_radius, 0.0], [foot_radius / 2, 0.0], [0.0, 0.0]])
    return revolve(np.concatenate([inner, lip, outer, foot]), segments)


def basin_mesh() -> Mesh:
    """The bowl `BASIN`, finely enough for a smooth mirror."""
    return bowl_mesh(BASIN, segments=96, rings=48)


def dish_mesh() -> Mesh:
    """The bowl `DISH`."""
    return bowl_mesh(DISH, segments=96, rings=48)


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
    # The profile of a bowl runs from the inside over the lip to the outside, so that normals point into the clay. To
    # the renderer both sides are one, and other corners first would round differently; files have `outward_faces`.
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

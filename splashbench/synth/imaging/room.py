"""A synthetic capture's room: textured table and walls, bowl or tank; in the static scene clutter and the board.

The rooms of the scenes `glossy_bowl` and `clear_liquid` have a table, walls, light, bowl and liquid of their own.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from splashbench.dyes import DYES
from splashbench.synth.imaging.geometry import (
    BASIN,
    BOWL,
    DISH,
    BowlShape,
    Mesh,
    Quad,
    basin_mesh,
    bowl_mesh,
    box_quads,
    dish_mesh,
    tank_mesh,
)
from splashbench.synth.imaging.shading import BLUE, DAYLIGHT, Glaze, Light, PouredDye, light_from
from splashbench.synth.imaging.texture import Albedo, Color, banded, board_albedo, mottled, printed

Array = NDArray[np.float64]

TABLE_HALF_SIDE = 1.3
WALL_HEIGHT = 1.0
WALL_DISTANCE = 0.85
BOARD_YAW_DEGREES = 7.0
BOARD_LIFT = 0.001  # metres above the table, so that the two surfaces do not fight
_MARGIN_SQUARES = 0.35
TABLE_COLOR = (0.33, 0.27, 0.21)
WALL_COLOR = (0.36, 0.37, 0.34)
BOWL_COLOR = (0.66, 0.42, 0.24)


@dataclass(frozen=True)
class Surfaces:
    """Colour and contrast of the table and of the walls; `stream` of the random numbers that draw them."""

    table: Color = TABLE_COLOR
    table_contrast: float = 0.22
    wall: Color = WALL_COLOR
    wall_contrast: float = 0.28
    stream: int = 1


WORKSHOP = Surfaces()
_PALE_BENCH = Surfaces((0.46, 0.47, 0.48), 0.13, (0.42, 0.33, 0.22), 0.20, stream=40)
_BLUE_LINEN = Surfaces((0.37, 0.43, 0.50), 0.18, (0.45, 0.42, 0.44), 0.22, stream=42)

# Lamplight from the left, and light from a cloudy sky.
_LAMP = light_from((-0.50, 0.78, 0.38), (0.72, 0.63, 0.50), (0.52, 0.55, 0.60), (0.55, 0.55, 0.62))
_OVERCAST = light_from((0.20, 0.90, 0.38), (0.42, 0.43, 0.45), (0.72, 0.74, 0.78), (-0.30, 0.75, 0.59))

_CRIMSON = PouredDye(np.array([0.46, 0.045, 0.05], np.float32), np.array([8.0, 60.0, 50.0], np.float32))
_AMBER = PouredDye(DYES["amber"].albedo, DYES["amber"].absorption, tints_shadow=True)
_TEAL_GLAZE = (0.07, 0.17, 0.18)


@dataclass(frozen=True, eq=False)
class CaptureRoom:
    """What does not move: rectangles, and the bowl with its albedo per vertex [V, 3] (None where cleared away).

    Attributes:
        bowl_shape: what `bowl` is the mesh of.
        bowl_texture: albedo [h, w, 3] wrapped about the y axis, in place of `bowl_albedo`: columns by azimuth, rows
            by radius plus height.
        glaze: the bowl's clear coat, None where it is matte.
        glass: a clear container in the bowl's place.
        clear_liquid: the liquid lets light through.
    """

    quads: list[Quad]
    bowl: Mesh | None
    bowl_albedo: Albedo | None
    glass: Mesh | None = None
    clear_liquid: bool = False
    bowl_shape: BowlShape = BOWL
    bowl_texture: Albedo | None = None
    glaze: Glaze | None = None
    light: Light = DAYLIGHT
    dye: PouredDye = BLUE


@lru_cache(maxsize=1)
def bare_quads(seed: int, surfaces: Surfaces = WORKSHOP) -> tuple[Quad, ...]:
    """The table and the three walls behind it."""
    rng = np.random.default_rng([seed, surfaces.stream])
    a, d, h = TABLE_HALF_SIDE, WALL_DISTANCE, WALL_HEIGHT
    table = mottled(rng, (1792, 1792), surfaces.table, surfaces.table_contrast, persistence=0.92)
    quads = [Quad(np.array([-a, 0, -a]), np.array([2 * a, 0, 0]), np.array([0, 0, 2 * a]), table)]
    walls = [
        (np.array([-a, h, -d]), np.array([2 * a, 0, 0])),
        (np.array([-a, h, a]), np.array([0, 0, -a - d])),
        (np.array([a, h, -d]), np.array([0, 0, a + d])),
    ]
    for corner, along in walls:
        texture = mottled(rng, (768, 1536), surfaces.wall, surfaces.wall_contrast, persistence=0.92)
        quads.append(Quad(corner, along, np.array([0.0, -h, 0.0]), texture))
    return tuple(quads)


def pour_room(seed: int) -> CaptureRoom:
    """The room of the recording: the bowl on the table."""
    bowl = bowl_mesh()
    rng = np.random.default_rng([seed, 2])
    # A fired glaze: darker towards the foot, with a faint speckle.
    shade = 0.86 + 0.14 * np.clip(bowl.vertices[:, 1:2] / 0.08, 0, 1)
    speckle = 1 + 0.03 * rng.standard_normal((len(bowl.vertices), 1))
    albedo = np.array(BOWL_COLOR) * shade * speckle
    return CaptureRoom(list(bare_quads(seed)), bowl, albedo.astype(np.float32))


def tank_room(seed: int) -> CaptureRoom:
    """The same room with the glass tank on the table, for a liquid that is clear too."""
    return CaptureRoom(list(bare_quads(seed)), None, None, glass=tank_mesh(), clear_liquid=True)


def glossy_room(seed: int) -> CaptureRoom:
    """Another table, other walls, lamplight: a basin of one colour under a glaze, for an opaque crimson liquid."""
    basin = basin_mesh()
    albedo = np.broadcast_to(np.array(_TEAL_GLAZE, np.float32), basin.vertices.shape)
    quads = list(bare_quads(seed, _PALE_BENCH))
    return CaptureRoom(quads, basin, albedo, bowl_shape=BASIN, glaze=Glaze(), light=_LAMP, dye=_CRIMSON)


def dish_room(seed: int) -> CaptureRoom:
    """A pale blue tablecloth under a cloudy sky: a round dish with a painted pattern, for a clear amber liquid."""
    dish = dish_mesh()
    pattern = banded(np.random.default_rng([seed, 43]), (512, 1536), (0.66, 0.64, 0.58), (0.05, 0.09, 0.26))
    return CaptureRoom(
        list(bare_quads(seed, _BLUE_LINEN)),
        dish,
        None,
        clear_liquid=True,
        bowl_shape=DISH,
        bowl_texture=pattern,
        light=_OVERCAST,
        dye=_AMBER,
    )


def static_room(seed: int, board: dict[str, Any]) -> CaptureRoom:
    """The room of the static recordings: no bowl, printed clutter all around, the board lying near the middle."""
    rng = np.random.default_rng([seed, 3])
    quads = list(bare_quads(seed))
    for k in range(11):
        # Boxes stand in a ring behind and beside the board, lower towards the cameras, so that every view sees the
        # board.
        azimuth = np.radians(-205 + 230 * k / 10 + rng.uniform(-6, 6))
        distance = rng.uniform(0.36, 0.62)
        centre = distance * np.array([np.cos(azimuth), np.sin(azimuth)])
        height = rng.uniform(0.05, 0.22) if centre[1] < 0 else rng.uniform(0.02, 0.05)
        size = np.array([rng.uniform(0.08, 0.15), height, rng.uniform(0.08, 0.15)])
        textures = [printed(rng, (192, 192), tuple(rng.uniform(0.15, 0.6, 3))) for _ in range(5)]
        quads += box_quads(centre, size, float(rng.uniform(0, 90)), textures)
    pose = board_pose(board)
    quads.append(board_quad(board, pose))
    return CaptureRoom(quads, None, None)


def board_pose(board: dict[str, Any]) -> Array:
    """Board-to-world [4, 4] of the board on the table: x to the right, y towards the cameras, printed side up."""
    yaw = np.radians(BOARD_YAW_DEGREES)
    x = np.array([np.cos(yaw), 0.0, -np.sin(yaw)])
    y = np.array([np.sin(yaw), 0.0, np.cos(yaw)])
    pose = np.eye(4)
    pose[:3, :3] = np.stack([x, y, np.cross(x, y)], axis=1)
    half = np.array([board["squares_x"], board["squares_y"]]) * board["square_metres"] / 2
    pose[:3, 3] = np.array([0.0, BOARD_LIFT, -0.03]) - half[0] * x - half[1] * y
    return pose


def board_quad(board: dict[str, Any], pose: Array) -> Quad:
    """The board as a textured rectangle, its white margin included."""
    size = board["square_metres"]
    margin = _MARGIN_SQUARES * size
    corner = pose[:3, 3] - margin * (pose[:3, 0] + pose[:3, 1])
    along_x = (board["squares_x"] * size + 2 * margin) * pose[:3, 0]
    along_y = (board["squares_y"] * size + 2 * margin) * pose[:3, 1]
    return Quad(corner, along_x, along_y, board_albedo(board, _MARGIN_SQUARES))

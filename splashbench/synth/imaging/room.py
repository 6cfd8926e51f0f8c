"""A synthetic capture's room: textured table and walls, bowl or tank; in the static scene clutter and the board."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from splashbench.synth.imaging.geometry import Mesh, Quad, bowl_mesh, box_quads, tank_mesh
from splashbench.synth.imaging.texture import Albedo, board_albedo, mottled, printed

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


@dataclass(frozen=True, eq=False)
class CaptureRoom:
    """What does not move: rectangles, and the bowl with its albedo per vertex [V, 3] (None where cleared away).

    `glass` is a clear container in the bowl's place; `clear_liquid` says that the liquid lets light through.
    """

    quads: list[Quad]
    bowl: Mesh | None
    bowl_albedo: Albedo | None
    glass: Mesh | None = None
    clear_liquid: bool = False


@lru_cache(maxsize=1)
def bare_quads(seed: int) -> tuple[Quad, ...]:
    """The table and the three walls behind it."""
    rng = np.random.default_rng([seed, 1])
    a, d, h = TABLE_HALF_SIDE, WALL_DISTANCE, WALL_HEIGHT
    table = mottled(rng, (1792, 1792), TABLE_COLOR, 0.22, persistence=0.92)
    quads = [Quad(np.array([-a, 0, -a]), np.array([2 * a, 0, 0]), np.array([0, 0, 2 * a]), table)]
    walls = [
        (np.array([-a, h, -d]), np.array([2 * a, 0, 0])),
        (np.array([-a, h, a]), np.array([0, 0, -a - d])),
        (np.array([a, h, -d]), np.array([0, 0, a + d])),
    ]
    for corner, along in walls:
        texture = mottled(rng, (768, 1536), WALL_COLOR, 0.28, persistence=0.92)
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

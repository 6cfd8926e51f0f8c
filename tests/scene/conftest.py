"""A synthetic scene in NeuroFluid's layout: a falling ball of liquid, drawn here by formula and by nothing of ours."""

from __future__ import annotations

import json
import pickle
import shutil
from collections.abc import Iterable
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

STEP = 0.02
RADIUS = 0.5
FIELD_OF_VIEW = 0.32
AZIMUTHS = {"view_1": -40, "view_2": -15, "view_3": 20, "view_4": 40, "view_5": 5}
_TARGET, _DISTANCE, _ELEVATION = np.array([0.0, 0.0, 0.6]), 11.0, 18.0
_SAMPLES = 4  # per pixel and axis


class Bomb:
    """What a pickle does when it is opened."""

    def __reduce__(self) -> tuple:
        return (Path.touch, (Path("opened"),))


def ball_center(number: int) -> np.ndarray:
    """Centre [3] of the ball in the frame of this number: free flight, z up, off the cameras' common axis."""
    time = number * STEP
    return np.array([0.45, -0.2, 1.0]) + np.array([0.6, 0.3, 1.5]) * time + np.array([0, 0, -9.81]) * time**2 / 2


def particles(number: int) -> dict[str, np.ndarray]:
    """Positions and velocities [N, 3] of a lattice in the ball, one radius of a particle below its surface."""
    steps = np.arange(-0.5, 0.501, 0.05)
    lattice = np.stack(np.meshgrid(steps, steps, steps), axis=-1).reshape(-1, 3)
    inside = lattice[np.linalg.norm(lattice, axis=1) < RADIUS - 0.025]
    velocity = np.array([0.6, 0.3, 1.5 - 9.81 * number * STEP])
    return {"pos": ball_center(number) + inside, "vel": np.tile(velocity, (len(inside), 1))}


def camera_to_world(azimuth: float) -> np.ndarray:
    """Blender's matrix [4, 4] of a camera that looks at the target: columns right, up, backward, position."""
    a, e = np.radians([azimuth, _ELEVATION])
    backward = np.array([np.sin(a) * np.cos(e), -np.cos(a) * np.cos(e), np.sin(e)])
    right = np.array([np.cos(a), np.sin(a), 0.0])
    matrix = np.eye(4)
    matrix[:3] = np.stack([right, np.cross(backward, right), backward, _TARGET + _DISTANCE * backward], axis=1)
    return matrix


def draw(matrix: np.ndarray, center: np.ndarray, size: int) -> np.ndarray:
    """RGBA uint8 [size, size, 4] of the ball; alpha is the share of a pixel that it covers, colours are not blended."""
    focal = 0.5 * size / np.tan(0.5 * FIELD_OF_VIEW)
    down, across = np.mgrid[: size * _SAMPLES, : size * _SAMPLES] / _SAMPLES + 0.5 / _SAMPLES
    local = np.stack([(across - size / 2) / focal, -(down - size / 2) / focal, -np.ones_like(across)], axis=-1)
    rays = local @ matrix[:3, :3].T
    rays /= np.linalg.norm(rays, axis=-1, keepdims=True)
    offset = center - matrix[:3, 3]
    along = rays @ offset
    room = RADIUS**2 - (offset @ offset - along**2)
    hit = room > 0
    normals = (along - np.sqrt(np.maximum(room, 0)))[..., None] * rays - offset
    light = np.clip(normals @ np.array([0.3, -0.5, 0.8]) / RADIUS, 0, 1)
    colours = np.array([30, 90, 160]) + light[..., None] * np.array([40, 80, 90])
    blocks = (size, _SAMPLES, size, _SAMPLES)
    covered = hit.reshape(blocks).sum(axis=(1, 3))
    total = np.where(hit[..., None], colours, 0).reshape(*blocks, 3).sum(axis=(1, 3))
    rgb = total / np.maximum(covered, 1)[..., None]
    return np.dstack([rgb, covered * 255 / _SAMPLES**2]).round().astype(np.uint8)


def write_view(scene: Path, view: str, split: str, numbers: Iterable[int], size: int = 64) -> None:
    """Write one view's JSON, images and particles; files carry the simulation's frame number."""
    matrix = camera_to_world(AZIMUTHS[view])
    (scene / view / split / "particles").mkdir(parents=True)
    frames = []
    for number in numbers:
        Image.fromarray(draw(matrix, ball_center(number), size)).save(scene / view / split / f"r_{number:03d}.png")
        np.savez(scene / view / split / "particles" / f"{number:04d}.npz", **particles(number))
        frames.append(
            {
                "file_path": f"./{split}/r_{number:03d}",
                "rotation": 0.0,
                "transform_matrix": matrix.tolist(),
                "particle_path": f"particles/{number:04d}.npz",
            }
        )
    data = {"camera_angle_x": FIELD_OF_VIEW, "bounding_box": "../box.pt", "frames": frames}
    (scene / view / f"transforms_{split}.json").write_text(json.dumps(data))


@pytest.fixture(scope="session")
def watersphere(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The scene as downloaded, read-only: seven training frames, six test frames, a pickle beside them."""
    scene = tmp_path_factory.mktemp("neurofluid") / "WaterSphere"
    for view in AZIMUTHS:
        split, frames = ("test", range(6)) if view == "view_5" else ("train", range(7))
        write_view(scene, view, split, frames)
    (scene / "box.pt").write_bytes(pickle.dumps(Bomb()))
    return scene


@pytest.fixture
def watersphere_copy(watersphere: Path, tmp_path: Path) -> Path:
    """A copy that the test may damage."""
    return Path(shutil.copytree(watersphere, tmp_path / "WaterSphere"))

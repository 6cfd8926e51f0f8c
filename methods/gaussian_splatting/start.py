"""Where the baselines start: points of the static scene, and of the liquid's visual hull in every frame.

The paper starts every method from points sampled from the mask-derived hull of the training views (supplement,
"Baselines"). What is no liquid starts from the scene's sparse points, or from the training views' pixels lifted to
their depth (scaffold_gs/anchors.py).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree
from splashbench_methods.scaffold_gs.anchors import seed_anchors, sparse_anchors
from splashbench_methods.scaffold_gs.plate import make_plate

from splashbench.errors import SplashbenchError
from splashbench.observe import signed_distance_fields
from splashbench.scene import TrainingScene

# Of the hull's grid, along its longest side.
_HULL_CELLS = 96
# Points come from this near below the hull's surface, in voxels: what lies deeper is not seen.
_SKIN = 3.0
_PLATE_SIDE = 800


@dataclass(frozen=True)
class Start:
    """Points to start from: positions [N, 3] and spacing [N] in scene units, colors [N, 3] in [0, 1].

    spacing: mean distance to the three nearest points of the same instant. frame: [N] timestep of a point of the
    liquid, -1 for one of the static scene.
    """

    positions: NDArray[np.float32]
    colors: NDArray[np.float32]
    spacing: NDArray[np.float32]
    frame: NDArray[np.int64]

    def __len__(self) -> int:
        return len(self.positions)


def static_points(
    scene: TrainingScene, count: int, source: Literal["pixels", "points"], rng: np.random.Generator
) -> Start:
    """At most `count` points of what is no liquid: lifted pixels, or the scene's sparse points where it has some."""
    sparse = scene.initial_points()
    if source == "points" and sparse is not None and len(sparse):
        seed = sparse_anchors(sparse, count)
    else:
        plates = [make_plate(scene, name, _PLATE_SIDE) for name in scene.train]
        plates = [plate for plate in plates if plate.seen.any()]
        if not plates:
            raise SplashbenchError(f"{scene.name}: the masks cover every training image whole; correct them")
        seed = seed_anchors(sparse, plates, count, rng)
    return Start(seed.positions, seed.colors, seed.spacing, np.full(len(seed.positions), -1))


def hull_points(scene: TrainingScene, count: int, rng: np.random.Generator, largest_only: bool = False) -> Start:
    """Some `count` points below the surface of the liquid's hull, in the colours of the views.

    They are spread evenly over the frames or, with `largest_only`, all of the frame in which there is most of it.
    """
    parts: list[Start] = []
    try:
        fields = signed_distance_fields(scene, cells_longest_axis=_HULL_CELLS)
    except SplashbenchError:
        if any(scene.mask(name, t).any() for name in scene.train for t in range(scene.n_frames)):
            raise
        return _joined(parts)  # no liquid in any frame: the static scene is all there is
    skins = [np.argwhere((phi < 0) & (phi > -_SKIN)) for phi in fields.phi]
    frames = [int(np.argmax([len(skin) for skin in skins]))] if largest_only else range(scene.n_frames)
    per_frame = -(-count // len(frames))
    for t in frames:
        skin = skins[t]
        if len(skin) == 0:
            continue
        chosen = skin[rng.permutation(len(skin))[:per_frame]]
        offsets = rng.uniform(-0.5, 0.5, chosen.shape)
        positions = np.asarray(fields.origin + (chosen + offsets) * fields.voxel, np.float32)
        parts.append(
            Start(positions, seen_colors(scene, positions, t), _spacing(positions), np.full(len(positions), t))
        )
    return _joined(parts)


def seen_colors(scene: TrainingScene, positions: NDArray[np.float32], t: int) -> NDArray[np.float32]:
    """Median colours [N, 3] in [0, 1] of the pixels that show `positions` [N, 3] in the training views at `t`."""
    seen = []
    for name, camera in scene.cameras.items():
        pixels, _ = camera.project(positions)
        column = np.clip(np.nan_to_num(pixels[:, 0]), 0, camera.width - 1).astype(int)
        row = np.clip(np.nan_to_num(pixels[:, 1]), 0, camera.height - 1).astype(int)
        seen.append(scene.image(name, t)[row, column] / np.float32(255))
    return np.asarray(np.median(seen, axis=0), np.float32)


def _spacing(positions: NDArray[np.float32]) -> NDArray[np.float32]:
    if len(positions) < 2:
        return np.full(len(positions), 1e-2, np.float32)
    distance = cKDTree(positions).query(positions, k=min(4, len(positions)))[0][:, 1:].mean(axis=1)
    return np.asarray(np.maximum(distance, 1e-6), np.float32)


def _joined(parts: list[Start]) -> Start:
    if not parts:
        nothing = np.empty((0, 3), np.float32)
        return Start(nothing, nothing, np.empty(0, np.float32), np.empty(0, np.int64))
    names = ("positions", "colors", "spacing", "frame")
    return Start(*(np.concatenate([getattr(part, name) for part in parts]) for name in names))


def joined(*parts: Start) -> Start:
    """All points of `parts`."""
    return _joined(list(parts))


def camera_extent(scene: TrainingScene) -> float:
    """Scene units: 1.1 times the radius of the training cameras about their centre, the yardstick of learning rates."""
    centers = np.stack([camera.center for camera in scene.cameras.values()])
    radius = float(np.linalg.norm(centers - centers.mean(axis=0), axis=1).max())
    return 1.1 * radius if radius > 0 else 1.0

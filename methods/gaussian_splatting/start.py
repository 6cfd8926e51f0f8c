"""Where the baselines start: points of the static scene, and of the liquid's visual hull in every frame.

The paper starts every method from points sampled from the mask-derived hull of the training views (supplement,
"Baselines"). What is no liquid starts from the scene's sparse points, or from the training views' pixels lifted to
their depth (scaffold_gs/anchors.py).
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Literal, Protocol

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.spatial import cKDTree
from splashbench_methods.scaffold_gs.anchors import seed_anchors, sparse_anchors
from splashbench_methods.scaffold_gs.plate import make_plate

from splashbench.adapter.contract import Run
from splashbench.errors import SplashbenchError
from splashbench.observe.initial_points import initial_points
from splashbench.render.torch_threads import one_torch_thread
from splashbench.scene import TrainingScene

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


class StartSettings(Protocol):
    """What a method's settings say of its start; see settings.py."""

    static: Literal["pixels", "points"]
    static_points: int
    hull_points: int


@contextmanager
def started(
    scene: TrainingScene, settings: StartSettings, run: Run, largest_only: bool = False
) -> Iterator[tuple[Start, np.random.Generator]]:
    """All points that a fit starts from, and the generator of its random numbers; within, torch is seeded as well.

    largest_only: see `hull_points`.
    """
    rng = np.random.default_rng(run.seed)
    run.progress(0, "collecting points")
    with one_torch_thread(), torch.random.fork_rng(devices=[]):
        torch.manual_seed(run.seed)
        with run.stage("start"):
            static = static_points(scene, settings.static_points, settings.static, rng)
            start = joined(static, hull_points(scene, settings.hull_points, largest_only))
        yield start, rng


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


def hull_points(scene: TrainingScene, count: int, largest_only: bool = False) -> Start:
    """Some `count` points on the surface of the liquid's hull, in the colours of the views; none without liquid.

    They are spread evenly over the frames or, with `largest_only`, all of the frame in which the views see most of it.
    """
    seen = [sum(int(scene.mask(name, t).sum()) for name in scene.train) for t in range(scene.n_frames)]
    if not any(seen) or count < 1:
        return _joined([])
    frames = [int(np.argmax(seen))] if largest_only else range(scene.n_frames)
    clouds = initial_points(scene, -(-count // len(frames))).liquid
    return _joined([_cloud(clouds[t], t) for t in frames])


def _cloud(points: NDArray[np.float64], t: int) -> Start:
    """The start of timestep `t` from `points` [n, 6], positions and colours."""
    positions, colors = points[:, :3].astype(np.float32), points[:, 3:].astype(np.float32)
    return Start(positions, colors, _spacing(positions), np.full(len(points), t))


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

"""Where the baselines start: points of the static scene, and of the liquid's visual hull in every frame.

The paper starts every method from points sampled from the mask-derived hull of the training views (supplement,
"Baselines"). What is no liquid starts from the scene's sparse points, or from the training views' pixels lifted to
their depth (anchor_seeds.py). Views of one colour throughout, such as those of synthetic liquid over white, show
nothing whose depth could be told: that colour then lies behind everything, without any points.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from typing import Literal, Protocol

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from splashbench.background.clean_plate import make_clean_plate
from splashbench.errors import SplashbenchError
from splashbench.gaussians.anchor_seeds import seed_anchors, sparse_anchors
from splashbench.gaussians.torch_threads import one_torch_thread
from splashbench.harness.contract import Run
from splashbench.observe.initial_points import initial_points
from splashbench.scene import TrainingScene

_PLATE_SIDE = 800
# Grey levels by which pixels of one colour may differ, as after JPEG.
_PLAIN = 3


@dataclass(frozen=True)
class StartingPoints:
    """Points to start from: positions [N, 3] and spacing [N] in scene units, colors [N, 3] in [0, 1].

    spacing: mean distance to the three nearest points of the same instant. frame: [N] timestep of a point of the
    liquid, -1 for one of the static scene. backdrop: colour [3] in [0, 1] that lies behind everything, or None.
    """

    positions: NDArray[np.float32]
    colors: NDArray[np.float32]
    spacing: NDArray[np.float32]
    frame: NDArray[np.int64]
    backdrop: NDArray[np.float32] | None = None

    def __len__(self) -> int:
        return len(self.positions)

    def backdrop_tensor(self) -> torch.Tensor | None:
        """The backdrop as a model takes it."""
        return None if self.backdrop is None else torch.from_numpy(self.backdrop)


class InitializationSettings(Protocol):
    """What a method's settings say of its start; see settings.py."""

    static: Literal["pixels", "points"]
    static_points: int
    hull_points: int


@contextmanager
def initialization(
    scene: TrainingScene, settings: InitializationSettings, run: Run, largest_only: bool = False
) -> Iterator[tuple[StartingPoints, np.random.Generator]]:
    """All points that a fit starts from, and the generator of its random numbers; within, torch is seeded as well.

    largest_only: see `hull_points`.
    """
    rng = np.random.default_rng(run.seed)
    run.progress(0, "collecting points")
    with one_torch_thread(), torch.random.fork_rng(devices=[]):
        torch.manual_seed(run.seed)
        with run.stage("start"):
            static = static_points(scene, settings.static_points, settings.static, rng, run)
            start = joined(static, hull_points(scene, settings.hull_points, largest_only))
        if not len(start):
            remedy = "correct the masks" if settings.hull_points else "raise hull_points"
            raise SplashbenchError(
                f"{scene.name}: there is nothing to start from, no points of liquid and one colour elsewhere; {remedy}"
            )
        yield start, rng


def static_points(
    scene: TrainingScene, count: int, source: Literal["pixels", "points"], rng: np.random.Generator, run: Run
) -> StartingPoints:
    """At most `count` points of what is no liquid: lifted pixels or, by `source`, the scene's sparse points.

    Pixels, too, where a scene has no sparse points, which the user is told; no points but a backdrop where the views
    show one colour besides the liquid.
    """
    sparse = scene.initial_points()
    if source == "points" and sparse is not None and len(sparse):
        seed = sparse_anchors(sparse, count)
    else:
        plates = [make_clean_plate(scene, name, _PLATE_SIDE) for name in scene.train]
        plates = [plate for plate in plates if plate.seen.any()]
        if not plates:
            raise SplashbenchError(f"{scene.name}: the masks cover every training image whole; correct them")
        backdrop = plain_color([plate.image[plate.seen] for plate in plates])
        if backdrop is not None:
            return replace(_joined([]), backdrop=backdrop)
        if source == "points":
            run.progress(0, "no sparse points: pixels lifted instead")
        seed = seed_anchors(sparse, plates, count, rng)
    return StartingPoints(seed.positions, seed.colors, seed.spacing, np.full(len(seed.positions), -1))


def plain_color(views: Sequence[NDArray[np.uint8]]) -> NDArray[np.float32] | None:
    """The colour [3] in [0, 1] of all pixels of `views`, [n, 3] each, where they have but one; else None."""
    color = np.median(views[0], axis=0).astype(np.int16)
    plain = all(bool((np.abs(pixels.astype(np.int16) - color) <= _PLAIN).all()) for pixels in views)
    return (color / 255).astype(np.float32) if plain else None


def hull_points(scene: TrainingScene, count: int, largest_only: bool = False) -> StartingPoints:
    """Some `count` points on the surface of the liquid's hull, in the colours of the views; none without liquid.

    They are spread evenly over the frames or, with `largest_only`, all of the frame in which the views see most of it.
    """
    seen = [sum(int(scene.mask(name, t).sum()) for name in scene.train) for t in range(scene.n_frames)]
    if not any(seen) or count < 1:
        return _joined([])
    frames = [int(np.argmax(seen))] if largest_only else range(scene.n_frames)
    clouds = initial_points(scene, -(-count // len(frames))).liquid
    return _joined([_cloud(clouds[t], t) for t in frames])


def _cloud(points: NDArray[np.float64], t: int) -> StartingPoints:
    """The start of timestep `t` from `points` [n, 6], positions and colours."""
    positions, colors = points[:, :3].astype(np.float32), points[:, 3:].astype(np.float32)
    return StartingPoints(positions, colors, _spacing(positions), np.full(len(points), t))


def _spacing(positions: NDArray[np.float32]) -> NDArray[np.float32]:
    if len(positions) < 2:
        return np.full(len(positions), 1e-2, np.float32)
    distance = cKDTree(positions).query(positions, k=min(4, len(positions)))[0][:, 1:].mean(axis=1)
    return np.asarray(np.maximum(distance, 1e-6), np.float32)


def _joined(parts: list[StartingPoints]) -> StartingPoints:
    if not parts:
        nothing = np.empty((0, 3), np.float32)
        return StartingPoints(nothing, nothing, np.empty(0, np.float32), np.empty(0, np.int64))
    names = ("positions", "colors", "spacing", "frame")
    backdrop = next((part.backdrop for part in parts if part.backdrop is not None), None)
    tables = {name: np.concatenate([getattr(part, name) for part in parts]) for name in names}
    return StartingPoints(**tables, backdrop=backdrop)


def joined(*parts: StartingPoints) -> StartingPoints:
    """All points of `parts`."""
    return _joined(list(parts))


def camera_extent(scene: TrainingScene) -> float:
    """Scene units: 1.1 times the radius of the training cameras about their centre, the yardstick of learning rates."""
    centers = np.stack([camera.center for camera in scene.cameras.values()])
    radius = float(np.linalg.norm(centers - centers.mean(axis=0), axis=1).max())
    return 1.1 * radius if radius > 0 else 1.0

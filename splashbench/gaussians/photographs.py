"""The training photographs in the order in which a fit takes them: whole images, masks aside.

The paper trains its baselines without masks. A step takes some views of one timestep, so that a model works out what
these share only once; every photograph comes once before any comes again.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from splashbench.scene import Camera, TrainingScene

# Photographs are kept in memory up to so many bytes; the others are read again each time.
_KEPT_BYTES = 1 << 30


@dataclass(frozen=True)
class TrainingPhotograph:
    """One training view at one timestep: uint8 image [H, W, 3], its camera, and its time in [0, 1]."""

    camera: Camera
    time: float
    image: NDArray[np.uint8]


def unit_time(scene: TrainingScene, seconds: float) -> float:
    """`seconds` on the scene's clock as a share of the recording; a camera of its own clock may be a little outside."""
    first, last = float(scene.times[0]), float(scene.times[-1])
    return (seconds - first) / (last - first) if last > first else 0.0


class Photographs:
    """The photographs of `scene`, shrunk so that no side exceeds `longest_side` pixels."""

    def __init__(self, scene: TrainingScene, longest_side: int, views_per_step: int, rng: np.random.Generator) -> None:
        self._scene, self._rng, self._per_step = scene, rng, views_per_step
        self._cameras = {}
        for name, camera in scene.cameras.items():
            factor = min(1.0, longest_side / max(camera.width, camera.height))
            self._cameras[name] = camera if factor == 1.0 else camera.scaled(factor)
        self._kept: dict[tuple[str, int], NDArray[np.uint8]] = {}
        self._kept_bytes = 0
        self._queue: list[list[tuple[str, int]]] = []

    @property
    def left(self) -> int:
        """Photographs that have not come yet in this round, those of the next step among them; never 0."""
        return sum(map(len, self._queue)) or len(self)

    def __len__(self) -> int:
        return len(self._cameras) * self._scene.n_frames

    def next(self) -> list[TrainingPhotograph]:
        """Views of one timestep."""
        if not self._queue:
            self._queue = self._epoch()
        return [self.photograph(name, t) for name, t in self._queue.pop()]

    def some(self, count: int) -> list[TrainingPhotograph]:
        """At most `count` photographs, chosen at random, apart from the order of `next`."""
        pairs = [(name, t) for name in self._cameras for t in range(self._scene.n_frames)]
        return [self.photograph(*pairs[i]) for i in self._rng.permutation(len(pairs))[:count]]

    def _epoch(self) -> list[list[tuple[str, int]]]:
        groups = []
        names = list(self._cameras)
        for t in range(self._scene.n_frames):
            order = [names[i] for i in self._rng.permutation(len(names))]
            for start in range(0, len(order), self._per_step):
                groups.append([(name, t) for name in order[start : start + self._per_step]])
        return [groups[i] for i in self._rng.permutation(len(groups))]

    def photograph(self, name: str, t: int) -> TrainingPhotograph:
        """Training view `name` at timestep `t`."""
        camera = self._cameras[name]
        time = unit_time(self._scene, float(self._scene.camera_times[name][t]))
        return TrainingPhotograph(camera, time, self._image(name, t, camera))

    def _image(self, name: str, t: int, camera: Camera) -> NDArray[np.uint8]:
        image = self._kept.get((name, t))
        if image is None:
            image = self._scene.image(name, t)
            if image.shape[:2] != (camera.height, camera.width):
                small = cv2.resize(image, (camera.width, camera.height), interpolation=cv2.INTER_AREA)
                image = np.asarray(small, np.uint8)
            if self._kept_bytes + image.nbytes <= _KEPT_BYTES:
                self._kept[name, t] = image
                self._kept_bytes += image.nbytes
        return image

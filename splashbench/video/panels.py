"""Panels: the pictures that stand beside each other in a video, each a layer of a submission, or the photographs."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from splashbench.replay import Reconstruction
from splashbench.scene import Camera, Scene
from splashbench.video.layers import Layer, Shot
from splashbench.video.scales import Scale


class Panel(Protocol):
    """What stands in one place of a video."""

    @property
    def title(self) -> str:
        """What it shows."""

    @property
    def scale(self) -> Scale | None:
        """Of its colours; None where they are those of a photograph."""

    def note(self, time: float) -> str:
        """What is to be said at `time` (seconds) besides the title, or ""."""

    def picture(self, camera: Camera, time: float) -> NDArray[np.uint8]:
        """What `camera` sees at `time` (seconds), uint8 [H, W, 3]."""


class Photographs:
    """A scene camera's photographs, between timesteps the nearest in time."""

    title = "photograph"
    scale: Scale | None = None

    def __init__(self, scene: Scene, view: str) -> None:
        self._scene, self._view = scene, view
        # The last picture, and of which timestep and size it is: slow motion shows each for many frames.
        self._last: tuple[tuple[int, int, int], NDArray[np.uint8]] | None = None

    def _nearest(self, time: float) -> int:
        return int(np.abs(self._scene.camera_times[self._view] - time).argmin())

    def moment(self, time: float) -> str:
        """When the photograph nearest to `time` was taken: seconds, or its number where times are an order alone."""
        t = self._nearest(time)
        nominal = self._scene.times_source == "nominal"
        return f"timestep {t}" if nominal else f"{self._scene.camera_times[self._view][t]:.3f} s"

    def note(self, time: float) -> str:
        """As `Panel.note` says."""
        return f"taken at {self.moment(time)}"

    def picture(self, camera: Camera, time: float) -> NDArray[np.uint8]:
        """As `Panel.picture` says, at the size of `camera`."""
        key = (self._nearest(time), camera.width, camera.height)
        if self._last is None or self._last[0] != key:
            picture = self._read(key[0], camera)
            picture.flags.writeable = False
            self._last = (key, picture)
        return self._last[1]

    def _read(self, t: int, camera: Camera) -> NDArray[np.uint8]:
        pixels = self._scene.image(self._view, t)
        if pixels.shape[:2] == (camera.height, camera.width):
            return pixels
        import cv2

        interpolation = cv2.INTER_AREA if camera.width < pixels.shape[1] else cv2.INTER_CUBIC
        return np.asarray(cv2.resize(pixels, (camera.width, camera.height), interpolation=interpolation))


@dataclass(frozen=True)
class Rendered:
    """A layer of a submission. photographs: with which its layer compares, or None."""

    title: str
    source: Reconstruction
    layer: Layer
    scale: Scale | None = None
    photographs: Photographs | None = None

    def shot(self, camera: Camera, time: float) -> Shot:
        """What the layer is painted from."""
        photograph = None if self.photographs is None else self.photographs.picture(camera, time)
        return Shot(self.source, camera, time, photograph)

    def note(self, time: float) -> str:
        """As `Panel.note` says."""
        return "" if self.photographs is None else f"photograph of {self.photographs.moment(time)}"

    def picture(self, camera: Camera, time: float) -> NDArray[np.uint8]:
        """As `Panel.picture` says."""
        return self.layer.paint(self.shot(camera, time), self.scale)

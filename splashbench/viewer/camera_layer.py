"""Cameras as frusta, with their photographs of the timestep that is shown."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from threading import RLock
from typing import Any

import numpy as np
from numpy.typing import NDArray

from splashbench.scene import Camera
from splashbench.viewer.geometry import quaternion, vertical_fov
from splashbench.viewer.layers import Job, Layer, Moment

#: Colours of training and of test cameras.
TRAINING, TEST = (214, 134, 0), (0, 114, 178)
# Photographs are kept small, all of them together: bytes, and pixels along the longer side.
_CACHE_BYTES, _LARGEST, _SMALLEST = 48 << 20, 240, 48


class CameraLayer(Layer):
    """Frusta of all cameras. Hidden while somebody looks through one, as photographs would stand in the way.

    Args:
        scene: viser's scene. place: name of the node that the layer's stand under.
        cameras: name -> Camera. train: names of the training cameras.
        photograph: the photograph of a camera at a timestep, uint8 [H, W, 3], or None where there is none.
        size: of a frustum, scene units: from the camera's place to its photograph.
        clicked: called with client and camera name when somebody clicks a frustum.
    """

    def __init__(
        self,
        scene: Any,
        place: str,
        lock: RLock,  # type: ignore[valid-type]
        cameras: Mapping[str, Camera],
        train: tuple[str, ...],
        photograph: Callable[[str, int], NDArray[np.uint8] | None],
        n_frames: int,
        size: float,
        clicked: Callable[[Any, str], None],
        on: bool = True,
    ) -> None:
        super().__init__("cameras", "cameras", lock, on)
        self._scene, self._place, self._cameras, self._train = scene, place, cameras, train
        self._photograph, self._n_frames, self._size, self._clicked = photograph, n_frames, size, clicked
        each = math.sqrt(_CACHE_BYTES / (3 * n_frames * len(cameras)))
        self._side = int(np.clip(each, _SMALLEST, _LARGEST))
        # Timesteps whose photographs are kept: of long recordings those nearest to the shown one.
        self._most = max(2, _CACHE_BYTES // (3 * self._side**2 * len(cameras)))
        self._small: dict[int, dict[str, NDArray[np.uint8] | None]] = {}
        self._nodes: dict[str, tuple[Any, Any]] = {}
        self._shown: int | None = None
        self._looked_through = False

    def look_through(self, looks: bool) -> None:
        """Whether somebody looks through one of them."""
        with self._lock:
            self._looked_through = looks
            self._set_visible()

    def _set_visible(self) -> None:
        for nodes in self._nodes.values():
            for node in nodes:
                node.visible = self.on and not self._looked_through

    def show(self, moment: Moment) -> None:
        """Show the frusta, with the photographs of `moment` once all of them are there."""
        self._set_visible()
        small = self._small.get(moment.t, {})
        if not self.on or self._shown == moment.t or len(small) < len(self._cameras) or not self._nodes:
            return
        for name, (frustum, _) in self._nodes.items():
            if small[name] is not None:
                frustum.image = small[name]
        self._shown = moment.t

    def urgent(self, moment: Moment) -> Job | None:
        """The frusta, then a photograph of `moment`."""
        if not self.on:
            return None
        if not self._nodes:
            return self._build
        return self._missing(moment.t)

    def ahead(self, moment: Moment) -> Job | None:
        """The next photograph that is missing."""
        if not self.on:
            return None
        # A timestep that was begun is completed, also where there is no room to begin another.
        begins = len(self._small) < self._most
        steps = ((moment.t + k) % self._n_frames for k in range(self._n_frames))
        jobs = (self._missing(t) for t in steps if begins or t in self._small)
        return next((job for job in jobs if job is not None), None)

    def _missing(self, t: int) -> Job | None:
        small = self._small.get(t, {})
        name = next((name for name in self._cameras if name not in small), None)
        return None if name is None else lambda: self._read(name, t)

    def _read(self, name: str, t: int) -> None:
        image = self._photograph(name, t)
        with self._lock:
            self._small.setdefault(t, {})[name] = None if image is None else smaller(image, self._side)
            if len(self._small) > self._most:
                del self._small[max(self._small, key=lambda other: abs(other - t))]

    def _build(self) -> None:
        nodes = {}
        for name, camera in self._cameras.items():
            color = TRAINING if name in self._train else TEST
            fov, aspect = vertical_fov(camera), camera.width / camera.height * camera.K[1, 1] / camera.K[0, 0]
            frustum = self._scene.add_camera_frustum(
                f"{self._place}/{name}",
                fov=fov,
                aspect=aspect,
                # viser scales frusta to one volume; this one's photograph is `size` away.
                scale=self._size * (math.tan(fov / 2) ** 2 * aspect / 3) ** (1 / 3),
                thickness=1.5,
                thickness_units="screen",
                color=color,
                format="jpeg",
                wxyz=quaternion(camera.w2c[:3, :3].T),
                position=camera.center,
                visible=False,
                cast_shadow=False,
                receive_shadow=False,
            )
            frustum.on_click(lambda event, name=name: self._clicked(event.client, name))
            label = self._scene.add_label(
                f"{self._place}/{name} name",
                name if name in self._train else f"{name} (test)",
                position=camera.center,
                anchor="bottom-center",
                font_screen_scale=0.8,
                visible=False,
            )
            nodes[name] = (frustum, label)
        with self._lock:
            self._nodes = nodes
            self._shown = None

    @property
    def loading(self) -> tuple[int, int] | None:
        """Timesteps whose photographs are there, and T."""
        with self._lock:
            there = sum(len(small) == len(self._cameras) for small in self._small.values())
        wanted = min(self._n_frames, self._most)
        return (there, wanted) if self.on and there < wanted else None


def smaller(image: NDArray[np.uint8], side: int) -> NDArray[np.uint8]:
    """`image` [H, W, 3] with at most `side` pixels along its longer side."""
    import cv2

    height, width = image.shape[:2]
    factor = side / max(height, width)
    if factor >= 1:
        return image
    size = (max(1, round(width * factor)), max(1, round(height * factor)))
    return np.asarray(cv2.resize(image, size, interpolation=cv2.INTER_AREA), dtype=np.uint8)

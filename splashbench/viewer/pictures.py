"""Pictures by the method's own renderer: what each client's camera sees, behind the rest of the scene.

For methods that hand out no Gaussians, and to see what is scored. A picture is made quickly and small while something
moves, and again at the size of the window once nothing does.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass
from threading import RLock
from typing import Any

import numpy as np
from numpy.typing import NDArray

from splashbench.scene import Camera
from splashbench.viewer.geometry import View, client_view
from splashbench.viewer.layers import Job, Layer, Moment

# Pixels: of a picture's width while something moves, to begin with, at the least and at the most; and at rest.
_FIRST, _LEAST, _MOST, _REST = 240, 96, 640, 1280
# Seconds that a picture may take while something moves.
_QUICK = 0.2


@dataclass(frozen=True)
class _Made:
    """What a client shows."""

    view: View
    t: int
    width: int

    def is_of(self, view: View, t: int) -> bool:
        return self.t == t and self.view.near(view)


class PictureLayer(Layer):
    """A picture behind each client's scene.

    Args:
        clients: viser's clients by number.
        ground: what is behind the scene without a picture, uint8 [1, 1, 3] or None.
        picture: what a camera sees at a timestep, uint8 [H, W, 3], or None.
    """

    def __init__(
        self,
        lock: RLock,  # type: ignore[valid-type]
        clients: Callable[[], dict[int, Any]],
        picture: Callable[[Camera, int], NDArray[np.uint8] | None],
        ground: Callable[[], NDArray[np.uint8] | None],
        on: bool = False,
    ) -> None:
        super().__init__("picture", "rendered by the method", lock, on)
        self._clients, self._picture, self._ground = clients, picture, ground
        self._made: dict[int, _Made] = {}
        self._width = _FIRST

    def show(self, moment: Moment) -> None:
        """Take the pictures away where they are not wanted; an old one stays until the next is made."""
        if not self.on:
            self.clear()

    def clear(self) -> None:
        """Take the pictures away."""
        clients = self._clients() if self._made else {}
        for number in self._made:
            if number in clients:
                clients[number].scene.set_background_image(self._ground(), format="png")
        self._made.clear()

    def urgent(self, moment: Moment) -> Job | None:
        """The picture of a client that shows another view or timestep; at rest, then the finer one."""
        quick = self._job(moment, lambda made, view, width: made is None or not made.is_of(view, moment.t))
        if quick is not None or moment.playing:
            return quick
        return self._job(moment, lambda made, view, width: made is not None and made.width < width, rest=True)

    def _job(self, moment: Moment, wanted: Callable[[_Made | None, View, int], bool], rest: bool = False) -> Job | None:
        if not self.on:
            return None
        for number, client in self._clients().items():
            view, window = client_view(client), int(client.camera.image_width)
            width = min(_REST if rest else self._width, window)
            if window > 0 and wanted(self._made.get(number), view, width):
                return lambda number=number, client=client: self._make(number, client, view, moment.t, width)  # type: ignore[misc]
        return None

    def _make(self, number: int, client: Any, view: View, t: int, width: int) -> None:
        start = time.perf_counter()
        height = max(1, round(width / float(client.camera.aspect)))
        image = self._picture(view.camera("view", width, height), t)
        seconds = time.perf_counter() - start
        if width <= self._width:
            # Time grows with the pixels, the square of the width.
            factor = np.clip((_QUICK / max(seconds, 1e-3)) ** 0.5, 0.5, 1.5)
            self._width = int(np.clip(self._width * factor, _LEAST, _MOST))
        with self._lock:
            if self.on:
                client.scene.set_background_image(image, format="jpeg", jpeg_quality=90)
                self._made[number] = _Made(view, t, width)

"""A picture of the viewer without anybody looking: `splashbench view ... --screenshot`."""

from __future__ import annotations

import time
from contextlib import ExitStack
from typing import Any

import numpy as np
from numpy.typing import NDArray

from splashbench.errors import SplashbenchError
from splashbench.viewer.browser import Browser
from splashbench.viewer.server import address_of
from splashbench.viewer.viewer import Viewer

# Seconds until everything is made, and until the browser shows the same twice.
_MADE_SECONDS, _DRAWN_SECONDS = 300.0, 120.0
# Mean difference of two pictures, of 255, that are the same: images are decoded and sorted a little later.
_SAME = 0.02


def still(viewer: Viewer, size: tuple[int, int], camera: str | None = None) -> NDArray[np.uint8]:
    """What `viewer`, which has started, shows in a headless browser, uint8 [H, W, 3]; halves side by side.

    Args:
        size: width and height of the picture, pixels.
        camera: look through this one.

    Raises SplashbenchError where there is no browser, or it draws nothing in time.
    """
    width, height = size[0] // len(viewer.halves), size[1]
    with ExitStack() as stack:
        for half in viewer.halves:
            address = address_of("127.0.0.1", half.server.get_port())
            stack.enter_context(Browser(address, (width, height)))
        client = _first_client(viewer)
        if camera is not None:
            viewer.go_to_camera(client, camera)
        viewer.settle(at_once=True)
        if not viewer.wait_ready(_MADE_SECONDS):
            raise SplashbenchError(f"the scene was not made within {_MADE_SECONDS:g} s; show fewer layers")
        return _settled(viewer, client)


def _first_client(viewer: Viewer) -> Any:
    end = time.monotonic() + _DRAWN_SECONDS
    while time.monotonic() < end:
        clients = [half.clients() for half in viewer.halves]
        if all(clients):
            return clients[0][0]
        time.sleep(0.05)
    raise SplashbenchError(f"the browser did not come to look within {_DRAWN_SECONDS:g} s; does it draw WebGL?")


def _settled(viewer: Viewer, client: Any) -> NDArray[np.uint8]:
    """The picture, once it stays the same."""
    before: NDArray[np.uint8] | None = None
    end = time.monotonic() + _DRAWN_SECONDS
    while time.monotonic() < end:
        try:
            shot = viewer.screenshot(client)
        except (RuntimeError, TimeoutError) as error:
            raise SplashbenchError(f"the browser drew no picture ({error}); does it draw WebGL?") from None
        if before is not None and np.abs(shot.astype(np.float32) - before).mean() < _SAME and shot.std() > 0:
            return shot
        before = shot
        time.sleep(0.3)
    raise SplashbenchError(f"the picture did not come to rest within {_DRAWN_SECONDS:g} s; show fewer layers")

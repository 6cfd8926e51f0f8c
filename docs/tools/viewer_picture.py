"""Pictures of the viewer for README.md and docs/viewer.md: its window in a headless Chromium, controls included.

    python docs/tools/viewer_picture.py SCENE SUBMISSION          docs/images/viewer.png
    python docs/tools/viewer_picture.py SCENE SUBMISSION OTHER    docs/images/viewer_halves.png

They are of splashsplat's preset `best`, and of hull_points, on the synthetic scene opaque_bowl at 240x160, told masks
alone.
"""

from __future__ import annotations

import argparse
import io
import math
import threading
import time
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

from splashbench.viewer.browser import Browser
from splashbench.viewer.exhibit import open_exhibit
from splashbench.viewer.geometry import View
from splashbench.viewer.panel import Panel
from splashbench.viewer.viewer import Viewer

IMAGES = Path(__file__).parents[1] / "images"
SIZE = (1200, 750)
TIME = 0.9
# Where viser's notes that there is no graphics card are closed, pixels: of one window, of two halves.
CLOSE = {1: [(288, 100)], 2: [(582, 117), (1020, 117)]}


def main() -> None:
    """Draw one of them into docs/images."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("scene", type=Path)
    parser.add_argument("submissions", type=Path, nargs="+")
    arguments = parser.parse_args()
    exhibits = [open_exhibit(place, arguments.scene) for place in arguments.submissions]
    viewer = Viewer(exhibits, send_ahead=False)
    Panel(viewer)
    viewer.seek(exhibits[0].nearest(TIME))
    viewer.start()
    threading.Thread(target=viewer.run, daemon=True).start()
    with Browser(viewer.address, SIZE) as browser:
        while not all(half.clients() for half in viewer.halves):
            time.sleep(0.1)
        clients = [half.clients()[0] for half in viewer.halves]
        if len(exhibits) == 1:
            viewer.halves[0].set_view(clients[0], behind_the_cameras(viewer.halves[0].overview))
        time.sleep(3)
        for x, y in CLOSE[len(exhibits)]:
            for kind in ("mousePressed", "mouseReleased"):
                browser.call("Input.dispatchMouseEvent", type=kind, x=x, y=y, button="left", clickCount=1)
        viewer.settle(at_once=True)
        viewer.wait_idle(120)
        content = at_rest(browser, clients)
    viewer.stop()
    out = IMAGES / ("viewer.png" if len(exhibits) == 1 else "viewer_halves.png")
    image = Image.open(io.BytesIO(content)).convert("RGB")
    image.quantize(256, dither=Image.Dither.FLOYDSTEINBERG).save(out, optimize=True)
    print(f"wrote {out.name}, {out.stat().st_size} bytes")


def behind_the_cameras(start: View) -> View:
    """A view that has the cameras in it, and the liquid on the left, as the panel stands on the right."""
    offset = start.position - start.look_at
    size = float(np.linalg.norm(offset))
    side = np.cross(start.up, offset)
    target = start.look_at + 0.14 * size * side / np.linalg.norm(side) - 0.3 * size * start.up
    return replace(start, position=target + 2.15 * offset, look_at=target, fov=math.radians(38))


def at_rest(browser: Browser, clients: list[Any]) -> bytes:
    """The window once it stays the same."""
    before = b""
    for _ in range(60):
        for client in clients:
            client.get_render(16, 16, timeout=60)  # returns once the page has taken in all that it was sent
        after = browser.screenshot()
        if after == before:
            break
        before = after
        time.sleep(1)
    return before


if __name__ == "__main__":
    main()

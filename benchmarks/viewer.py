"""How fast the viewer starts and plays, and what it takes: measured on made-up Gaussians, or on a submission.

    python benchmarks/viewer.py [--frames 50] [--gaussians 12000] [--minutes 10] [--browser] [--json FILE]
    python benchmarks/viewer.py --submission SUBMISSION [--scene SCENE]

Each figure is of a server process of its own, which sends all timesteps ahead.

start_seconds       from the start of the process until every timestep is ready for a browser to take.
start_mib           the process's resident memory then.
shown_per_second    timesteps that the server shows in a second, of those that are due (`due_per_second`), while a
                    client takes everything and draws nothing.
late_ms             median and largest delay between the time a timestep is due and the server's message.
minutes, mib        resident memory after so many minutes of playing, `--minutes` in all.
browser             with `--browser`: pictures a second that a headless Chromium draws without a graphics card, with all
                    timesteps sent ahead and with one at a time. It is the slowest client there is.
"""

from __future__ import annotations

import argparse
import json
import statistics
import subprocess
import sys
import threading
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import psutil
from numpy.typing import NDArray

from splashbench.files import write_json
from splashbench.scene import Camera, ContainerMesh, Gaussians, Particles, SignedDistance, look_at
from splashbench.viewer.browser import Browser
from splashbench.viewer.exhibit import Exhibit, open_exhibit
from splashbench.viewer.viewer import Viewer

FPS = 30.0
PLAYED_SECONDS = 20.0
# Promised of 50 timesteps of 12 000 Gaussians.
TARGETS = {"start_seconds": 10.0, "start_mib": 500e6 / 2**20}
#: Counts the pictures that a page draws: where it shows Gaussians alone, each draws all of them by one call.
COUNTER = """
window.pictures = 0;
const draw = WebGL2RenderingContext.prototype.drawElementsInstanced;
WebGL2RenderingContext.prototype.drawElementsInstanced = function (...words) {
  window.pictures++;
  return draw.apply(this, words);
};
"""


class MadeUp(Exhibit):
    """`frames` timesteps of `number` Gaussians in a ball that swings to and fro, filmed by three cameras."""

    has_gaussians = True

    def __init__(self, frames: int, number: int) -> None:
        self.name, self.place = "made up", Path("made up")
        self.times, self.real_times = np.arange(frames) / FPS, True
        self.gravity, self.metres_per_unit = np.array([0.0, -1.0, 0.0]), 1.0
        K = np.array([[800.0, 0, 450], [0, 800, 300], [0, 0, 1]])
        eyes = {"1": (-1, 0.5, 2), "2": (0, 0.5, 2.2), "3": (1, 0.5, 2)}
        self.cameras = {name: Camera(name, 900, 600, K, look_at(eye)) for name, eye in eyes.items()}
        self.train = tuple(self.cameras)
        self._number = number

    def _some_points(self) -> NDArray:
        return self.gaussians(0).means

    def gaussians(self, t: int) -> Gaussians:
        """The ball at timestep `t`; large enough for none to be merged."""
        rng = np.random.default_rng(t)
        means = rng.normal(0, 0.1, (self._number, 3)) + np.array([0.1 * np.sin(t / 8), 0, 0])
        factors = np.tile(np.eye(3) * 0.006, (self._number, 1, 1))
        return Gaussians(means, factors, rng.uniform(0.3, 0.9, self._number), rng.uniform(size=(self._number, 3)))  # type: ignore[arg-type]

    def photograph(self, camera: str, t: int) -> None:
        """None."""

    def container(self) -> ContainerMesh | None:
        """None."""
        return None

    def distance(self, t: int) -> SignedDistance | None:
        """None."""
        return None

    def _particles(self) -> Particles | None:
        return None


def memory() -> float:
    """Resident memory of this process, MiB."""
    return psutil.Process().memory_info().rss / 2**20


def exhibit_of(arguments: argparse.Namespace) -> Exhibit:
    """What is shown."""
    if arguments.submission:
        return open_exhibit(arguments.submission, arguments.scene)
    return MadeUp(arguments.frames, arguments.gaussians)


def serve(arguments: argparse.Namespace) -> dict[str, Any]:
    """What the server process measures; `arguments.started` is when it was started."""
    on = ["liquid", "background"] if arguments.submission else ["liquid"]
    viewer = Viewer([exhibit_of(arguments)], send_ahead=arguments.ahead, on=on)
    viewer.start()
    while not viewer.wait_idle(1.0):
        pass
    figures: dict[str, Any] = {"start_seconds": time.time() - arguments.started, "start_mib": memory()}
    threading.Thread(target=viewer.run, daemon=True).start()
    try:
        if arguments.browser:
            figures["pictures_per_second"] = drawn(viewer)
        else:
            with Reader(viewer.port):
                figures |= played(viewer) | lasting(viewer, arguments.minutes)
    finally:
        viewer.stop()
    return figures


class Reader:
    """A client that takes everything the server on `port` sends, and draws nothing."""

    def __init__(self, port: int) -> None:
        self._port = port

    def __enter__(self) -> Reader:
        import viser
        from websockets.sync.client import connect

        self._socket: Any = connect(
            f"ws://127.0.0.1:{self._port}", subprotocols=[f"viser-v{viser.__version__}"], max_size=None
        )
        threading.Thread(target=self._read, daemon=True).start()
        return self

    def _read(self) -> None:
        from websockets.exceptions import ConnectionClosed

        try:
            while True:
                self._socket.recv()
        except ConnectionClosed:
            pass

    def __exit__(self, *_: object) -> None:
        self._socket.close()


def played(viewer: Viewer) -> dict[str, Any]:
    """How many timesteps are shown while it plays, and how late."""
    shown: list[float] = []
    stage = viewer.halves[0].stage
    original: Callable[..., None] = stage.show

    def watched(moment: Any) -> None:
        original(moment)
        shown.append(time.monotonic())

    stage.show = watched  # type: ignore[method-assign]
    viewer.clock.seek(0)
    viewer.clock.play()
    viewer.changed()
    began = time.monotonic()
    time.sleep(PLAYED_SECONDS)
    viewer.clock.pause()
    stage.show = original  # type: ignore[method-assign]
    times = viewer.halves[0].stage.exhibit.times
    due = 1 / float(np.diff(times).mean())
    # Steps come at whole multiples of one over the rate: what is left over is the delay.
    phases = np.array([(at - began) * due for at in shown if at > began + 1])
    late = (phases - np.floor(phases)) / due * 1000
    late = late - late.min()
    return {
        "due_per_second": due,
        "shown_per_second": len(phases) / (PLAYED_SECONDS - 1),
        "late_ms": [statistics.median(late), float(late.max())],
    }


def lasting(viewer: Viewer, minutes: float) -> dict[str, Any]:
    """Memory while it plays for `minutes`."""
    if not minutes:
        return {}
    viewer.clock.play()
    viewer.changed()
    found = [[0.0, memory()]]
    began = time.monotonic()
    while (passed := (time.monotonic() - began) / 60) < minutes:
        time.sleep(min(60.0, (minutes - passed) * 60))
        found.append([(time.monotonic() - began) / 60, memory()])
    return {"minutes": [round(at, 2) for at, _ in found], "mib": [held for _, held in found]}


def drawn(viewer: Viewer) -> float:
    """Pictures a second of a headless browser while it plays."""
    with Browser("about:blank", (900, 600)) as browser:
        browser.call("Page.addScriptToEvaluateOnNewDocument", source=COUNTER)
        browser.call("Page.navigate", url=viewer.address)
        while not viewer.halves[0].clients():
            time.sleep(0.2)
        viewer.clock.play()
        viewer.changed()
        time.sleep(20)
        before, began = browser.evaluate("window.pictures"), time.monotonic()
        time.sleep(PLAYED_SECONDS)
        after = browser.evaluate("window.pictures")
        return float(after - before) / (time.monotonic() - began)


def child(arguments: argparse.Namespace, **changes: Any) -> dict[str, Any]:
    """The figures of a server process."""
    values = vars(arguments) | changes | {"started": time.time(), "json": None}
    words = {name: str(value) if isinstance(value, Path) else value for name, value in values.items()}
    done = subprocess.run(
        [sys.executable, __file__, "--child", json.dumps(words)], check=True, stdout=subprocess.PIPE, text=True
    )
    return dict(json.loads(done.stdout.splitlines()[-1]))


def main() -> None:
    """Measure, and print the figures."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--frames", type=int, default=50)
    parser.add_argument("--gaussians", type=int, default=12_000, help="of each timestep")
    parser.add_argument("--submission", type=Path, help="show this instead")
    parser.add_argument("--scene", type=Path, help="of the submission")
    parser.add_argument("--minutes", type=float, default=0.0, help="play on for so long, and watch the memory")
    parser.add_argument("--browser", action="store_true", help="also what a headless browser draws")
    parser.add_argument("--json", type=Path)
    parser.add_argument("--child", help=argparse.SUPPRESS)
    arguments = parser.parse_args()
    if arguments.child:
        words = json.loads(arguments.child)
        for name in ("submission", "scene"):
            words[name] = Path(words[name]) if words[name] else None
        print(json.dumps(serve(argparse.Namespace(**words))))
        return
    figures = child(arguments, ahead=True, browser=False)
    if arguments.browser:
        figures["browser"] = {
            name: child(arguments, ahead=ahead, browser=True, minutes=0)["pictures_per_second"]
            for name, ahead in (("all timesteps ahead", True), ("one at a time", False))
        }
    for name, value in figures.items():
        target = f"   (promised: at most {TARGETS[name]:.4g})" if name in TARGETS else ""
        print(f"{name:20} {json.dumps(value)}{target}")
    if arguments.json:
        write_json(arguments.json, figures)


if __name__ == "__main__":
    main()

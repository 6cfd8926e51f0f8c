"""The viewer in a real browser: it draws, follows the clock and its boxes, and asks nobody but its own server."""

from __future__ import annotations

import io
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from PIL import Image

from splashbench.cli.main import main
from splashbench.errors import SplashbenchError
from splashbench.files import read_image
from splashbench.harness.runner import run_method
from splashbench.viewer.exhibit import open_exhibit
from splashbench.viewer.geometry import client_view

pytest.importorskip("viser", reason="comes with the extra [view]")

from splashbench.viewer.browser import Browser, find_browser
from splashbench.viewer.panel import Panel
from splashbench.viewer.viewer import Viewer

FEW = {"hull_cells": 48, "transport_cells": 32, "control_cells": 8, "iterations": 30}
SIZE = (680, 360)
#: Pixels of the panel, docked on the right.
PANEL = 330
#: What viser's own page complains of: its splats have no bounding sphere, and it forgets pictures that it replaced.
ITS_OWN = ("computeBoundingSphere(): Computed radius is NaN", "ERR_FILE_NOT_FOUND blob:http://127.0.0.1")


@pytest.fixture(scope="module", autouse=True)
def _browser() -> None:
    try:
        find_browser()
    except SplashbenchError as error:
        pytest.skip(str(error))


@pytest.fixture(scope="module")
def fit(balls_directory: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A small fit of the balls; not to be changed."""
    out = tmp_path_factory.mktemp("fit") / "splashsplat"
    run_method("splashsplat", balls_directory, out, preset="quick", overrides=FEW, timing_frames=0)
    return out


class Session:
    """A viewer of `places` with a browser before it."""

    def __init__(self, places: list[Path], scene: Path | None) -> None:
        self.viewer = Viewer([open_exhibit(place, scene) for place in places], send_ahead=False)
        Panel(self.viewer)
        if len(places) == 1:
            self.viewer.halves[0].server.gui.main_panel.dock_right()
        self.viewer.seek(4)
        self.viewer.start()
        threading.Thread(target=self.viewer.run, daemon=True).start()
        self.browser = Browser(self.viewer.address, SIZE).__enter__()
        self.until(lambda: all(half.clients() for half in self.viewer.halves))
        self.done()
        # The note that it draws without a graphics card.
        closed = "(b => b && b.click())(document.querySelector('.mantine-Notification-closeButton'))"
        self.browser.evaluate(closed)

    def until(self, what: Callable[[], Any], seconds: float = 60.0, seen: object = "nothing was noted") -> None:
        end = time.monotonic() + seconds
        while not what():
            assert time.monotonic() < end, f"it never came: {seen}"
            time.sleep(0.1)

    def done(self) -> None:
        assert self.viewer.wait_idle(60)

    def picture(self) -> NDArray[np.float32]:
        """The window once it stands still, without the panel."""
        before = None
        self.done()
        for _ in range(60):
            for half in self.viewer.halves:  # returns once the page has taken in all that it was sent
                half.clients()[0].get_render(16, 16, timeout=60)
            image = np.asarray(Image.open(io.BytesIO(self.browser.screenshot())).convert("RGB"), np.float32)
            image = image[:, : SIZE[0] - PANEL]
            if before is not None and np.abs(image - before).mean() < 0.05:
                return image
            before = image
            time.sleep(0.2)
        raise AssertionError("the picture never came to rest")

    def complaints(self) -> list[str]:
        self.browser.evaluate("1")  # takes in what it said meanwhile
        return [text for text in self.browser.complaints if not any(own in text for own in ITS_OWN)]

    def close(self) -> None:
        self.browser.__exit__()
        self.viewer.stop()


@pytest.fixture(scope="module")
def session(fit: Path, balls_directory: Path) -> Iterator[Session]:
    session = Session([fit], balls_directory)
    yield session
    session.close()


def click(session: Session, words: str) -> None:
    """Press the button with these words, as a user does."""
    pressed = session.browser.evaluate(
        f"""(() => {{ const found = [...document.querySelectorAll("button")].find(b => b.textContent === "{words}");
        if (found) found.click(); return Boolean(found); }})()"""
    )
    assert pressed, f"there is no button {words}"


def tick(session: Session, words: str) -> None:
    """Press the box that is labelled so."""
    pressed = session.browser.evaluate(
        f"""(() => {{ const labels = [...document.querySelectorAll("label")];
        const label = labels.find(each => each.textContent.trim() === "{words}");
        const box = label && document.getElementById(label.htmlFor);
        if (box) box.click(); return Boolean(box); }})()"""
    )
    assert pressed, f"there is no box {words}"


def differ(first: NDArray[np.float32], second: NDArray[np.float32]) -> int:
    """Pixels that differ by far: viser draws coarser or finer as it has time, which shows along edges."""
    return int((np.abs(first - second).max(axis=-1) > 60).sum())


def test_it_draws_the_fit_and_follows_the_clock(session: Session) -> None:
    first = session.picture()
    assert first.std() > 10
    click(session, "step ▶")
    session.until(lambda: session.viewer.clock.tick() == 5)
    session.done()
    second = session.picture()
    moved = differ(first, second)
    assert 300 < moved < 0.3 * first[..., 0].size  # the balls moved, the room did not
    session.viewer.seek(4)
    session.viewer.changed()
    session.until(lambda: session.viewer.halves[0].stage.moment.t == 4)
    session.done()
    assert differ(session.picture(), first) < moved / 4


@pytest.mark.slow
def test_boxes_take_layers_away_and_bring_them_back(session: Session) -> None:
    before = session.picture()
    for box in ("liquid", "background"):
        layer = session.viewer.halves[0].stage.layers[box]
        tick(session, box)
        session.until(lambda layer=layer: not layer.on)  # type: ignore[misc]
        session.done()
        without = session.picture()
        away = differ(without, before)
        assert away > 300, box
        tick(session, box)
        session.until(lambda layer=layer: layer.on)  # type: ignore[misc]
        session.done()
        assert differ(session.picture(), before) < away / 4, box


def test_play_and_pause(session: Session) -> None:
    session.viewer.set_speed(1 / 4)
    click(session, "play")
    session.until(lambda: session.viewer.clock.playing)
    session.until(lambda: session.browser.evaluate("document.body.textContent.includes('pause')"))
    click(session, "pause")
    session.until(lambda: not session.viewer.clock.playing)
    session.viewer.seek(4)
    session.viewer.changed()


def test_it_shows_what_the_method_renders(session: Session) -> None:
    """Gaussians in the browser against the method's own renderer, through one of the cameras."""
    (client,) = session.viewer.halves[0].clients()
    session.viewer.seek(4)
    session.viewer.changed()
    session.viewer.go_to_camera(client, "3")
    half = session.viewer.halves[0]
    camera = half.stage.exhibit.cameras["3"]
    session.until(lambda: np.allclose(client_view(client).position, camera.center))
    half.settle(at_once=True)
    half.stage.switch("grid", False)
    session.viewer.changed()
    session.done()

    seen = {"there": False, "decibels": 0.0}

    def shown_as_rendered() -> bool:
        view = client_view(client)  # anew each time: a busy browser may yet tell of where it stood before
        window = (int(client.camera.image_width), int(client.camera.image_height))
        expected = half.stage.exhibit.picture(view.camera("3", *window), 4)
        assert expected is not None
        seen["there"] = bool(np.allclose(view.position, camera.center))
        seen["decibels"] = _decibels(session.viewer.screenshot(client), expected)
        return seen["there"] and seen["decibels"] > 35

    session.until(shown_as_rendered, seconds=300, seen=seen)  # long, as other tests keep the machine busy meanwhile
    half.stage.switch("grid", True)
    session.viewer.go_free(client)


def _decibels(first: NDArray[np.uint8], second: NDArray[np.uint8]) -> float:
    return float(-10 * np.log10(((first.astype(np.float32) - second) ** 2).mean() / 255**2))


def test_it_asks_nobody_but_its_own_server_and_does_not_complain(session: Session) -> None:
    assert session.complaints() == []
    port = session.viewer.port
    strangers = [
        address
        for address in session.browser.requests
        if not address.startswith(("data:", f"http://127.0.0.1:{port}/", f"blob:http://127.0.0.1:{port}/"))
        and not address.startswith(f"ws://127.0.0.1:{port}")
    ]
    assert strangers == []
    assert len(session.browser.requests) > 1


def test_slow_drawing_makes_no_smaller_pictures(session: Session) -> None:
    """viser lowers the resolution where drawing is slow, which a picture of a stated size must not show."""
    assert any(address.endswith("/?fixedDpr=1") for address in session.browser.requests)


@pytest.mark.slow
def test_two_halves_have_one_camera(fit: Path, balls_directory: Path) -> None:
    session = Session([fit, balls_directory], balls_directory)
    try:
        left, right = (half.clients()[0] for half in session.viewer.halves)
        session.until(lambda: client_view(left).near(client_view(right)))
        camera = session.viewer.halves[0].stage.exhibit.cameras["2"]
        session.viewer.go_to_camera(left, "2")
        for client in (left, right):
            session.until(lambda client=client: np.allclose(client_view(client).position, camera.center, atol=1e-3))  # type: ignore[misc]
        widths = [client.camera.image_width for client in (left, right)]
        # The panel takes a part of the left frame; the pictures are equally wide.
        assert abs((widths[0] - 320) - widths[1]) <= 4, widths
        # What the address asks for reaches both.
        for half in session.viewer.halves:
            assert any(f":{half.server.get_port()}/?fixedDpr=1" in each for each in session.browser.requests)
        assert session.complaints() == []
    finally:
        session.close()


@pytest.mark.slow
def test_a_screenshot_from_the_command_line(
    fit: Path, balls_directory: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "view.png"
    words = ["view", str(fit), "--scene", str(balls_directory), "--time", "0.2", "--camera", "3", "--size", "450x300"]
    assert main([*words, "--screenshot", str(out), "--json"]) == 0
    image = read_image(out)
    assert image.shape == (300, 450, 3)
    assert image.std() > 10
    printed = capsys.readouterr()
    assert '"file"' in printed.out
    assert printed.err == f"wrote {out} (450x300)\n"
    # Through that camera the photograph looks alike.
    scene = open_exhibit(balls_directory)
    photograph = scene.photograph("3", scene.nearest(0.2))
    assert photograph is not None
    small = np.asarray(Image.fromarray(image).resize((96, 64), Image.Resampling.BOX))
    assert _decibels(small, photograph) > 15

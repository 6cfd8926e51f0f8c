"""The viewer without a browser: what it shows when, two halves with one camera, and what clients may ask."""

from __future__ import annotations

import json
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from splashbench.errors import SplashbenchError
from splashbench.viewer.geometry import client_view
from splashbench.viewer.half import Half
from splashbench.viewer.layers import Moment
from splashbench.viewer.panel import SENDING, Panel, _plain
from splashbench.viewer.server import free_port
from splashbench.viewer.viewer import Viewer, on_white

from .conftest import MadeUp

pytest.importorskip("viser", reason="comes with the extra [view]")


class Camera:
    """A client's camera: it reports what it was told, as a browser does."""

    def __init__(self) -> None:
        self.position, self.look_at = np.array([3.0, 3, 3]), np.zeros(3)
        self.up_direction, self.fov = np.array([0.0, 1, 0]), 0.8
        self.image_width, self.image_height, self.aspect = 600, 400, 1.5
        self.min_orbit_distance = 0.0
        self.callback: Callable[[Any], None] = lambda camera: None

    def on_update(self, callback: Callable[[Any], None]) -> None:
        self.callback = callback

    def move(self, x: float) -> None:
        """Somebody drags it."""
        self.position = np.array([x, 0.5, 2.0])
        self.callback(self)


class Client:
    """A browser that looks, as far as the viewer knows. seconds: that it takes for a picture."""

    def __init__(self, number: int, seconds: float = 0.0) -> None:
        self.client_id, self.camera, self.seconds = number, Camera(), seconds
        self.told: list[tuple[str, str]] = []
        self.downloads: list[tuple[str, bytes]] = []
        self.scene = self
        self.background: Any = None

    @contextmanager
    def atomic(self) -> Iterator[None]:
        yield

    def get_render(self, height: int, width: int, **_: Any) -> np.ndarray:
        time.sleep(self.seconds)
        return np.full((height, width, 4), [10 * self.client_id, 0, 0, 255], np.uint8)

    def add_notification(self, title: str, text: str, **_: Any) -> None:
        self.told.append((title, text))

    def send_file_download(self, name: str, content: bytes, **_: Any) -> None:
        self.downloads.append((name, content))

    def set_background_image(self, image: Any, **_: Any) -> None:
        self.background = image


def join(viewer: Viewer, half: int, client: Client, arrives: bool = True) -> Client:
    """Let `client` look at a half; arrives: whether it reports that it looks from where it was let."""
    viewer.halves[half].server._connected_clients[client.client_id] = client
    viewer.halves[half]._welcome(client)
    if arrives:
        client.camera.callback(client.camera)
    return client


@pytest.fixture
def viewer() -> Iterator[Viewer]:
    viewer = Viewer([MadeUp()], send_ahead=True)
    Panel(viewer)
    viewer.start()
    yield viewer
    viewer.stop()


@pytest.fixture
def pair() -> Iterator[Viewer]:
    second = MadeUp(number=60)
    second.name = "second"
    viewer = Viewer([MadeUp(), second], send_ahead=False)
    Panel(viewer)
    viewer.start()
    yield viewer
    viewer.stop()


def done(viewer: Viewer) -> None:
    assert viewer.wait_idle(30)


def visible(viewer: Viewer, half: int = 0) -> set[str]:
    """Names of the scene nodes that are shown, below the exhibit's."""
    nodes = viewer.halves[half].server.scene._handle_from_node_name
    top = f"/exhibit {viewer.halves[half].chosen}/"
    return {name.removeprefix(top) for name, node in nodes.items() if name.startswith(top) and node.visible}


def liquid(viewer: Viewer, half: int = 0) -> set[str]:
    return {name for name in visible(viewer, half) if name.startswith("liquid/")}


def test_each_timestep_has_its_node_and_playing_shows_one_after_the_other(viewer: Viewer) -> None:
    done(viewer)
    assert liquid(viewer) == {"liquid/timestep 0"}
    viewer.step(1)
    viewer.tick()
    assert liquid(viewer) == {"liquid/timestep 1"}
    viewer.seek(3)
    viewer.tick()
    assert liquid(viewer) == {"liquid/timestep 3"}


def test_it_plays_in_real_time(viewer: Viewer) -> None:
    done(viewer)
    shown = []
    original = viewer.halves[0].stage.show

    def watch(moment: Any) -> None:
        original(moment)
        shown.append((time.monotonic(), moment.t))

    viewer.halves[0].stage.show = watch  # type: ignore[method-assign]
    viewer.clock.loop = False
    viewer.set_speed(1 / 4)  # on a busy machine too, a step is late by less than it lasts
    start = time.monotonic()
    viewer.play_or_pause()
    runner = threading.Thread(target=viewer.run, args=(2.4,))
    runner.start()
    runner.join()
    steps = {}
    for at, t in shown:
        steps.setdefault(t, at - start)
    assert list(steps) == [0, 1, 2, 3]
    for t, due in enumerate([0.0, 0.4, 1.2, 1.6]):
        assert due - 0.01 <= steps[t] < due + 0.39, steps
    assert not viewer.clock.playing


def test_the_panel_says_what_it_shows(viewer: Viewer) -> None:
    done(viewer)
    panel = viewer.display
    assert isinstance(panel, Panel)
    viewer.seek(2)
    viewer.tick()
    assert panel._slider.value == 2
    assert panel._seconds.content == "0.300 s, timestep 2 of 0 to 3"
    assert "made up" in panel._head.content
    assert "1 unit = 50 cm" in panel._head.content
    viewer.play_or_pause()
    viewer.tick()
    assert panel._buttons.options[1] == "pause"


def test_a_failed_layer_is_unticked_and_told(viewer: Viewer, monkeypatch: pytest.MonkeyPatch) -> None:
    done(viewer)

    def broken(t: int) -> None:
        raise RuntimeError("line one\nline two")

    monkeypatch.setattr(viewer.halves[0].stage.exhibit, "distance", broken)
    viewer.switch(viewer.halves[0], "surface", True)
    viewer.changed()
    done(viewer)
    panel = viewer.display
    assert isinstance(panel, Panel)
    assert not panel._boxes[0]["surface"].value
    assert panel._boxes[0]["surface"].disabled
    viewer.display.refresh()
    assert "surface cannot be shown: RuntimeError: line one line two" in panel._status.content
    assert liquid(viewer) == {"liquid/timestep 0"}


def test_layers_by_name(made_up: MadeUp) -> None:
    viewer = Viewer([made_up], on=["particles", "grid"], send_ahead=False)
    try:
        viewer.start()
        done(viewer)
        assert visible(viewer) - {"particles"} == {"particles/timestep 0", "grid", "grid size"}
    finally:
        viewer.stop()
    with pytest.raises(SplashbenchError, match="there is no layer 'liqiud'; choose of liquid, background, particles"):
        Viewer([made_up], on=["liqiud"])


def test_a_port_that_failed_is_free_again(made_up: MadeUp) -> None:
    port = free_port("127.0.0.1", None)
    for _ in range(2):
        with pytest.raises(SplashbenchError, match="no layer"):
            Viewer([made_up], port=port, on=["x"])


def test_a_page_that_connects_while_the_viewer_is_built_is_welcome(
    made_up: MadeUp, monkeypatch: pytest.MonkeyPatch
) -> None:
    client = Client(0)

    class Awaited(Half):
        def __init__(self, *words: Any) -> None:
            super().__init__(*words)
            self._welcome(client)
            client.camera.callback(client.camera)
            client.camera.move(0.7)

    monkeypatch.setattr("splashbench.viewer.viewer.Half", Awaited)
    Viewer([made_up], send_ahead=True).stop()
    np.testing.assert_allclose(client.camera.position, [0.7, 0.5, 2.0])


def test_a_tick_reads_the_clock_once(viewer: Viewer, monkeypatch: pytest.MonkeyPatch) -> None:
    done(viewer)
    reads = iter([(1, 0.1, True), (2, 0.3, True)])
    monkeypatch.setattr(viewer.clock, "read", lambda: next(reads))
    monkeypatch.setattr(viewer.clock, "tick", lambda: pytest.fail("another read"))
    viewer.tick()
    assert viewer.halves[0].stage.moment == Moment(1, True)
    assert isinstance(viewer.display, Panel)
    assert viewer.display._slider.value == 1


def test_what_fails_as_it_is_shown_does_not_end_the_worker(viewer: Viewer, monkeypatch: pytest.MonkeyPatch) -> None:
    done(viewer)
    stage = viewer.halves[0].stage

    def broken() -> None:
        monkeypatch.undo()
        raise RuntimeError("it went away")

    monkeypatch.setattr(stage, "done", broken)
    viewer.switch(viewer.halves[0], "surface", True)
    viewer.changed()
    done(viewer)
    assert stage.layers["surface"].fault == "RuntimeError: it went away"
    viewer.switch(viewer.halves[0], "particles", True)
    viewer.changed()
    done(viewer)
    assert "particles/timestep 0" in visible(viewer)


def test_a_panel_that_fails_does_not_end_the_worker(
    viewer: Viewer, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    done(viewer)

    def broken() -> None:
        monkeypatch.undo()
        raise RuntimeError("no panel")

    monkeypatch.setattr(viewer.display, "refresh", broken)
    viewer._wake()
    end = time.monotonic() + 20
    while viewer.display.refresh is broken and time.monotonic() < end:
        time.sleep(0.01)
    viewer.switch(viewer.halves[0], "particles", True)
    viewer.changed()
    done(viewer)
    assert "particles/timestep 0" in visible(viewer)
    assert "the viewer could not do that: RuntimeError: no panel" in capsys.readouterr().err


def test_times_that_do_not_rise_are_one_line() -> None:
    with pytest.raises(SplashbenchError, match="made_up: the times of the timesteps do not rise; fix its times"):
        Viewer([MadeUp(times=np.array([0.0, 0.2, 0.2]))])


# Two halves.


def test_each_half_shows_its_own_at_the_same_time(pair: Viewer) -> None:
    done(pair)
    counts = []
    for half in (0, 1):
        node = pair.halves[half].server.scene._handle_from_node_name[f"/exhibit {half}/liquid/shown"]
        counts.append(int((node.buffer[:, 7] >> 24 > 0).sum()))
    assert counts == [40, 60]
    pair.seek(2)
    pair.tick()
    assert [half.stage.moment.t for half in pair.halves] == [2, 2]


def test_one_camera_moves_both(pair: Viewer) -> None:
    left, right = join(pair, 0, Client(0)), join(pair, 1, Client(1))
    left.camera.move(0.7)
    np.testing.assert_allclose(right.camera.position, [0.7, 0.5, 2.0])
    right.camera.callback(right.camera)  # it reports that, and nothing goes back
    right.camera.move(-0.4)
    np.testing.assert_allclose(left.camera.position, [-0.4, 0.5, 2.0])


def test_a_late_report_of_an_earlier_view_moves_nobody_back(pair: Viewer) -> None:
    left, right = join(pair, 0, Client(0)), join(pair, 1, Client(1))
    left.camera.move(0.5)
    left.camera.move(0.6)
    right.camera.position = np.array([0.5, 0.5, 2.0])  # what it was told first
    right.camera.callback(right.camera)
    np.testing.assert_allclose(left.camera.position, [0.6, 0.5, 2.0])


def test_a_new_client_looks_from_where_the_others_do(pair: Viewer) -> None:
    left = join(pair, 0, Client(0))
    left.camera.move(0.9)
    right = Client(1)
    join(pair, 1, right)
    np.testing.assert_allclose(right.camera.position, [0.9, 0.5, 2.0])


def test_the_first_report_of_a_page_that_opens_is_no_move(pair: Viewer) -> None:
    left, right = join(pair, 0, Client(0)), Client(1)
    before = client_view(left)
    join(pair, 1, right, arrives=False)
    right.camera.position = np.array([3.0, 3.0, 3.0])  # viser's own, before it was told
    right.camera.callback(right.camera)
    assert client_view(left).near(before)


def test_a_half_shows_the_other_exhibit(pair: Viewer) -> None:
    pair.choose(pair.halves[0], 1)
    pair.changed()
    done(pair)
    assert "liquid/shown" in visible(pair, 0)
    assert pair.halves[0].stage.exhibit.name == "second"
    nodes = pair.halves[0].server.scene._handle_from_node_name
    assert not nodes["/exhibit 0"].visible
    assert nodes["/exhibit 1"].visible


def test_choosing_one_and_back_keeps_what_is_behind_it(pair: Viewer, monkeypatch: pytest.MonkeyPatch) -> None:
    for number in (1, 0):
        pair.choose(pair.halves[0], number)
        pair.changed()
        done(pair)
    told: list[Any] = []
    scene = pair.halves[0].server.scene
    monkeypatch.setattr(scene, "set_background_image", lambda image, **_: told.append(image))
    for number in (1, 0):
        pair.choose(pair.halves[0], number)
        assert told[-1].tolist() == [[[200, 150, 100]]], number


def test_an_exhibit_of_fewer_timesteps_is_shown_at_the_same_time() -> None:
    short = MadeUp(times=np.array([0.0, 0.3]))
    viewer = Viewer([MadeUp(), short], send_ahead=False, on=["particles", "velocity", "cameras"])
    try:
        viewer.start()
        viewer.seek(3)
        viewer.tick()
        done(viewer)
        shown = []
        stage = viewer.halves[0].stages[1]
        original = stage.show
        stage.show = lambda moment: (shown.append(moment.t), original(moment))  # type: ignore[method-assign,assignment,func-returns-value]
        viewer.choose(viewer.halves[0], 1)
        assert set(shown) == {1}
    finally:
        viewer.stop()


def test_a_screenshot_has_both_halves(pair: Viewer) -> None:
    left = join(pair, 0, Client(1))
    join(pair, 1, Client(2))
    shot = pair.screenshot(left)
    assert shot.shape == (400, 1200, 3)
    assert shot[0, 0, 0] == 10
    assert shot[0, -1, 0] == 20


# What clients ask for.


def test_through_a_camera_and_back(viewer: Viewer) -> None:
    client = join(viewer, 0, Client(0))
    done(viewer)
    viewer.go_to_camera(client, "2")
    np.testing.assert_allclose(client.camera.position, [1.0, 0.5, 2.0])
    assert not any(name.startswith("cameras/") for name in visible(viewer))
    client.camera.callback(client.camera)  # it is there now
    assert not any(name.startswith("cameras/") for name in visible(viewer))
    client.camera.move(0.3)
    assert "cameras/2" in visible(viewer)
    viewer.go_free(client)
    assert client_view(client).near(viewer.halves[0].overview)
    with pytest.raises(SplashbenchError, match="no camera '7'"):
        viewer.go_to_camera(client, "7")


@pytest.mark.parametrize(("seconds", "ahead"), [(0.0, True), (0.4, False)])
def test_timesteps_are_sent_ahead_to_clients_that_draw_fast(made_up: MadeUp, seconds: float, ahead: bool) -> None:
    viewer = Viewer([made_up])
    try:
        viewer.start()
        join(viewer, 0, Client(0, seconds))
        done(viewer)
        assert liquid(viewer) == {"liquid/timestep 0" if ahead else "liquid/shown"}
        viewer.set_sending(not ahead)
        viewer.changed()
        done(viewer)
        assert liquid(viewer) == {"liquid/shown" if ahead else "liquid/timestep 0"}
    finally:
        viewer.stop()
    assert list(SENDING.values()) == [None, True, False]


def test_the_methods_own_picture_is_behind_each_client(viewer: Viewer) -> None:
    client = join(viewer, 0, Client(0))
    viewer.switch(viewer.halves[0], "picture", True)
    viewer.seek(3)
    viewer.tick()
    viewer.changed()
    done(viewer)
    assert client.background.shape == (400, 600, 3)  # at rest as large as the window
    assert client.background[0, 0, 0] == 60
    viewer.switch(viewer.halves[0], "picture", False)
    assert client.background.shape == (1, 1, 3)  # what shows through the gaps of the background


def test_without_making_ahead_the_picture_is_as_large_as_the_window(made_up: MadeUp) -> None:
    viewer = Viewer([made_up], send_ahead=False, on=["picture"], makes_ahead=False)
    try:
        client = join(viewer, 0, Client(0))
        viewer.start()
        assert viewer.wait_ready(30)
        assert client.background.shape == (400, 600, 3)
    finally:
        viewer.stop()


def test_a_path_is_recorded_played_and_saved(viewer: Viewer, monkeypatch: pytest.MonkeyPatch) -> None:
    client = join(viewer, 0, Client(0))
    with pytest.raises(SplashbenchError, match="two key frames"):
        viewer.save_path(client, 1.0)
    for x, t in ((0.0, 0), (1.0, 3)):
        client.camera.move(x)
        viewer.seek(t)
        viewer.edit_path(client, "add")
    viewer.edit_path(client, "add")
    viewer.edit_path(client, "undo")
    viewer.save_path(client, 0.5)
    (name, content) = client.downloads[0]
    path = json.loads(content)
    assert name == "camera_path.json"
    assert len(path["camera_path"]) == 16
    assert [path["camera_path"][k]["time"] for k in (0, -1)] == pytest.approx([0.0, 0.4])
    assert path["render_width"] / path["render_height"] == pytest.approx(1.5, abs=0.01)
    original = viewer._go

    def slowly(*words: Any) -> None:
        original(*words)
        time.sleep(0.6)  # frames are left out, but not the last

    monkeypatch.setattr(viewer, "_go", slowly)
    viewer.play_path(client, 0.5)
    np.testing.assert_allclose(client.camera.position, [1.0, 0.5, 2.0], atol=1e-6)
    assert viewer.clock.tick() == 3
    viewer.edit_path(client, "clear")
    assert viewer.keyframes == []


def test_a_folder_takes_screenshots(made_up: MadeUp, tmp_path: Path) -> None:
    viewer = Viewer([made_up], send_ahead=False, save_to=tmp_path / "shots")
    try:
        Panel(viewer)
        client = join(viewer, 0, Client(3))
        viewer.save_screenshot(client)
        assert (tmp_path / "shots" / "view_001.png").is_file()
        assert client.downloads == []
        assert "view_001.png" in client.told[0][1]
    finally:
        viewer.stop()


def test_a_button_that_fails_tells_its_client(viewer: Viewer) -> None:
    class Event:
        client = join(viewer, 0, Client(0))

    panel = viewer.display
    assert isinstance(panel, Panel)
    panel._guarded(lambda event: viewer.save_path(event.client, 1.0))(Event())
    assert Event.client.told == [("That did not work", "a camera path needs two key frames or more; add another")]


def test_names_of_strangers_are_letters_in_the_panel() -> None:
    assert _plain("<img src=x> **a** [b](c)") == r"\<img src=x\> \*\*a\*\* \[b\](c)"


def test_white_is_behind_what_is_transparent() -> None:
    rgba = np.array([[[200, 100, 0, 0], [200, 100, 0, 255], [0, 0, 0, 128]]], np.uint8)
    assert on_white(rgba).tolist() == [[[255, 255, 255], [200, 100, 0], [127, 127, 127]]]

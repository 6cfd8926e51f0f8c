"""The viewer: exhibits on one or two halves of a window, one clock and one worker. The panel stands before it."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from typing import Any, Protocol, cast

import numpy as np
from numpy.typing import NDArray

from splashbench.errors import SplashbenchError, one_line
from splashbench.viewer.clock import PlayClock
from splashbench.viewer.exhibit import Exhibit, require_same_rig
from splashbench.viewer.geometry import View, client_picture, client_view, view_of
from splashbench.viewer.half import Half
from splashbench.viewer.keyframes import FPS, MOST_KEYFRAMES, Keyframe, path_through
from splashbench.viewer.layers import Layer, Moment
from splashbench.viewer.server import address_of, free_port, on_free_port, start_server
from splashbench.viewer.stage import Stage
from splashbench.viewer.window import WindowServer
from splashbench.viewer.worker import Worker

# Seconds: between looks at the clock while it plays, at the least, and while it does not.
_TICK, _REST = 1 / 120, 0.1
# A client that takes longer for a small picture draws without a graphics card.
_FAST_SECONDS, _PROBES = 0.25, 3
# For what is shown to be made, before that is asked.
_MADE_SECONDS = 60.0
_PATH_WIDTH = 1280


class Display(Protocol):
    """What tells the user what the viewer does: the panel."""

    def show_time(self, t: int, seconds: float, playing: bool) -> None:
        """Timestep `t` is shown."""

    def show_layers(self, half: Half) -> None:
        """Other layers are shown in `half`."""

    def show_camera(self, name: str | None) -> None:
        """Somebody looks through the camera `name`, or none."""

    def refresh(self) -> None:
        """What is loaded, and what is shown coarser than it is, may have changed."""

    def refresh_soon(self) -> None:
        """As `refresh`, many times a second."""

    def tell(self, client: Any, title: str, text: str) -> None:
        """Something was done for `client`."""


class Silent:
    """A display that tells nothing."""

    def __getattr__(self, name: str) -> Callable[..., None]:
        return lambda *words: None


class Viewer:
    """Shows one or two exhibits in a browser.

    Args:
        exhibits: what is shown; two of one scene stand side by side, each in its half, with the same camera.
        host, port: what to listen on; port None: the first that is free.
        send_ahead: whether all timesteps are sent at once; None: to clients that draw fast.
        on: names of the layers that are shown at first; None: what suits each exhibit.
        save_to: the folder for screenshots and paths; None: the browser saves them.
        makes_ahead: whether what may be shown later is made, too.

    Raises SplashbenchError where it cannot listen, exhibits do not go together, or a layer's name is unknown.
    """

    def __init__(
        self,
        exhibits: Sequence[Exhibit],
        host: str = "127.0.0.1",
        port: int | None = None,
        send_ahead: bool | None = None,
        on: Sequence[str] | None = None,
        save_to: Path | None = None,
        makes_ahead: bool = True,
    ) -> None:
        self._makes_ahead = makes_ahead
        if len(exhibits) == 2:
            require_same_rig(*exhibits)
        try:
            self.clock = PlayClock(exhibits[0].times.tolist())
        except ValueError as error:
            raise SplashbenchError(f"{exhibits[0].place}: {error}; fix its times") from None
        self._host, self.save_to = host, save_to
        self.display: Display = cast(Display, Silent())
        self._send_ahead = send_ahead
        self.keyframes: list[Keyframe] = []
        self._path_played: threading.Event | None = None
        self._changed = threading.Event()
        self._shown: tuple[int, bool] | None = None
        self._looked_through: str | None = None
        self._window: WindowServer | None = None
        self._servers: list[Any] = []
        self.halves: list[Half] = []
        self._worker = Worker(self._next_job)
        # Whether all of what is shown is made; how often somebody said that there may be more to make.
        self._ready, self._ready_lock, self._calls = threading.Event(), threading.Lock(), 0
        try:
            # From here on pages may connect.
            self.port = self._serve(exhibits, port)
            for number, server in enumerate(self._servers):
                self.halves.append(Half(server, exhibits, number, self._clicked, self._moved, self._connected))
            if on is not None:
                self._choose_layers(on)
        except BaseException:
            self._stop_servers()
            raise
        for half in self.halves:
            for stage in half.stages:
                stage.send_ahead(bool(send_ahead))

    @property
    def address(self) -> str:
        """Where a browser on this machine finds it."""
        return address_of(self._host, self.port)

    def _serve(self, exhibits: Sequence[Exhibit], port: int | None) -> int:
        """Start a server for each exhibit, and before two of them the window with both; returns the port to open."""
        names = [exhibit.name for exhibit in exhibits]
        if len(exhibits) == 1:
            self._servers.append(on_free_port(self._host, port, None, partial(self._server, "splashbench")))
            return int(self._servers[0].get_port())
        start = free_port(self._host, port) + 1
        for label in ("splashbench", names[1]):
            self._servers.append(on_free_port(self._host, None, start, partial(self._server, label)))
            start = self._servers[-1].get_port() + 1
        ports = [server.get_port() for server in self._servers]
        self._window = on_free_port(self._host, port, None, lambda free: WindowServer(self._host, free, ports, names))
        return self._window.port

    def _server(self, label: str, port: int) -> Any:
        return start_server(self._host, port, label)

    def _choose_layers(self, names: Sequence[str]) -> None:
        known = [name for half in self.halves for stage in half.stages for name in stage.layers]
        for name in names:
            if name not in known:
                raise SplashbenchError(f"there is no layer {name[:40]!r}; choose of {', '.join(dict.fromkeys(known))}")
        for half in self.halves:
            for stage in half.stages:
                for name in stage.layers:
                    stage.switch(name, name in names)

    # Running.

    def start(self) -> None:
        """Begin to make what is shown."""
        self._worker.start()
        self.tick()
        self.display.refresh()

    def run(self, seconds: float | None = None) -> None:
        """Follow the clock, for `seconds` or until interrupted."""
        end = None if seconds is None else time.monotonic() + seconds
        while end is None or time.monotonic() < end:
            self._changed.clear()
            self.tick()
            self.settle()
            until = self.clock.until_next()
            self._changed.wait(_REST if until is None else max(_TICK, min(until, _REST)))

    def settle(self, at_once: bool = False) -> None:
        """Make what is shown for where clients look from, once they have been there for a moment."""
        if any([half.settle(at_once) for half in self.halves]):  # noqa: C419 (each of them)
            self._wake()

    def tick(self) -> None:
        """Show the timestep whose turn it is."""
        t, seconds, playing = self.clock.read()
        if (t, playing) == self._shown:
            return
        self._shown = (t, playing)
        for half in self.halves:
            half.stage.show(Moment(half.stage.exhibit.nearest(seconds), playing))
        self.display.show_time(t, seconds, playing)
        self._wake()

    def changed(self) -> None:
        """Something was changed by hand: look at the clock, at what is missing and at what is said."""
        self._changed.set()
        self._wake()
        self.display.refresh()

    def _wake(self) -> None:
        """There may be something to make."""
        with self._ready_lock:
            self._calls += 1
            self._ready.clear()
        self._worker.wake()

    def wait_ready(self, seconds: float) -> bool:
        """Wait until all of what is shown is made, for `seconds` at the most; whether it is."""
        return self._ready.wait(seconds)

    def wait_idle(self, seconds: float) -> bool:
        """Wait until what may be shown later is made, too."""
        return self._worker.wait_idle(seconds)

    def stop(self) -> None:
        """End, with all of its threads."""
        if self._path_played is not None:
            self._path_played.set()
        self._worker.stop()
        self._ready.set()  # whoever waits need not wait longer
        self._stop_servers()

    def _stop_servers(self) -> None:
        for server in self._servers:
            server.stop()
        if self._window is not None:
            self._window.stop()

    def _next_job(self) -> Callable[[], None] | None:
        calls = self._calls
        for urgent in (True, False):
            for half in self.halves:
                stage = half.stage
                for layer, job in stage.jobs(urgent):
                    return lambda half=half, stage=stage, layer=layer, job=job: self._work(half, stage, layer, job)  # type: ignore[misc]
            if urgent:
                with self._ready_lock:
                    if calls == self._calls:  # else there may be more by now
                        self._ready.set()
            if not self._makes_ahead:
                break
        self.display.refresh()
        return None

    def _work(self, half: Half, stage: Stage, layer: Layer, job: Callable[[], None]) -> None:
        """Run a job, and show what it made. What fails takes its layer out: the rest is still worth looking at."""
        try:
            job()
            stage.done()
            self.display.refresh_soon()
        except Exception as error:  # a method's code, or a stranger's files
            said = str(error) if isinstance(error, SplashbenchError) else f"{type(error).__name__}: {error}"
            stage.fail(layer, one_line(said)[:500])
            self.display.show_layers(half)
            self.display.refresh_soon()

    # What the panel asks for.

    def seek(self, t: int) -> None:
        """Go to timestep `t`."""
        self.clock.seek(t)

    def step(self, number: int) -> None:
        """Pause, `number` timesteps on."""
        self.clock.step(number)

    def play_or_pause(self) -> None:
        """Play where it is paused, and the other way."""
        if self.clock.playing:
            self.clock.pause()
        else:
            self.clock.play()

    def set_speed(self, speed: float) -> None:
        """Play at `speed` times the recording's."""
        self.clock.speed = speed

    def switch(self, half: Half, name: str, on: bool) -> None:
        """Show or hide a layer in `half`."""
        half.stage.switch(name, on)

    def choose(self, half: Half, number: int) -> None:
        """Show exhibit `number` in `half`."""
        _, seconds, playing = self.clock.read()
        half.choose(number, Moment(half.stages[number].exhibit.nearest(seconds), playing))
        self.display.show_layers(half)

    def set_sending(self, ahead: bool | None) -> None:
        """Send all timesteps at once or one at a time; None: as fast as the present clients are."""
        self._send_ahead = ahead
        if ahead is None:
            for half in self.halves:
                for client in half.clients():
                    self._probe(half, client)
        else:
            for half in self.halves:
                for stage in half.stages:
                    stage.send_ahead(ahead)

    def set_measure(self, measure: str) -> None:
        """Colour particles by `measure`."""
        for half in self.halves:
            for stage in half.stages:
                stage.set(measure=measure)

    def set_cut(self, **place: Any) -> None:
        """Cut elsewhere: `axis`, `share`."""
        for half in self.halves:
            for stage in half.stages:
                stage.set(**place)

    # Cameras.

    def _half_of(self, client: Any) -> Half:
        return next((half for half in self.halves if client in half.clients()), self.halves[0])

    def go_to_camera(self, client: Any, name: str) -> None:
        """Look through the camera `name`."""
        exhibit = self.halves[0].stage.exhibit
        view = view_of(exhibit.camera(name), exhibit.extent.middle, exhibit.up, float(client.camera.aspect))
        self._go(client, view, name)

    def go_free(self, client: Any) -> None:
        """Back to where the viewer starts."""
        if client is not None:
            self._go(client, self.halves[0].overview, None)

    def _go(self, client: Any, view: View, through: str | None) -> None:
        self._look_through(through)
        for half in self.halves:
            half.view = view
            for each in half.clients():
                if each is client or half is not self._half_of(client):
                    half.set_view(each, view)
        self._wake()

    def _look_through(self, name: str | None) -> None:
        if name != self._looked_through:
            self._looked_through = name
            for half in self.halves:
                for stage in half.stages:
                    stage.look_through(name is not None)
            self.display.show_camera(name)

    def _clicked(self, half: Half, client: Any, name: str) -> None:
        if client is not None:
            self.go_to_camera(client, name)

    def _moved(self, half: Half, client: Any, view: View, echo: bool) -> None:
        """A camera moved; where somebody moved it, the other half follows."""
        if not echo:
            self._look_through(None)
            for other in self.halves:
                other.view = view
                if other is not half:
                    for follower in other.clients():
                        other.set_view(follower, view)
        self._wake()

    def _connected(self, half: Half, client: Any) -> None:
        if self._send_ahead is None:
            self._probe(half, client)
        self._wake()

    def _probe(self, half: Half, client: Any) -> None:
        """Send all timesteps to the half whose `client` draws fast what is there."""
        self.wait_ready(_MADE_SECONDS)
        seconds = []
        for _ in range(_PROBES):
            start = time.monotonic()
            try:
                client.get_render(48, 64, timeout=30.0)
            except (RuntimeError, TimeoutError, OSError):  # it went away, or cannot draw
                return
            seconds.append(time.monotonic() - start)
        if self._send_ahead is None:
            for stage in half.stages:
                stage.send_ahead(min(seconds) < _FAST_SECONDS)
            self._wake()

    # Screenshots and camera paths.

    def screenshot(self, client: Any) -> NDArray[np.uint8]:
        """What `client` sees, and the other half beside it, uint8 [H, W, 3] on white, as large as their windows."""
        mine = self._half_of(client)
        shots = []
        for half in self.halves:
            looks = [client] if half is mine else half.clients()[:1]
            shots += [on_white(client_picture(each)) for each in looks]
        height = min(len(shot) for shot in shots)
        return np.concatenate([shot[:height] for shot in shots], axis=1)

    def save_screenshot(self, client: Any) -> None:
        """Save what `client` sees as PNG."""
        from splashbench.viewer.saving import png_bytes, save

        told = save(self.save_to, client, "view", ".png", png_bytes(self.screenshot(client)))
        self.display.tell(client, "Screenshot", told)

    def edit_path(self, client: Any, action: str) -> None:
        """`action`: "add" what `client` sees as a key frame, "undo" that, or "clear" all."""
        if action == "add":
            if len(self.keyframes) >= MOST_KEYFRAMES:
                raise SplashbenchError(f"a path has {MOST_KEYFRAMES} key frames at the most; save this one")
            self.keyframes.append(Keyframe(client_view(client), self.clock.seconds))
        elif action == "undo":
            del self.keyframes[-1:]
        else:
            self.keyframes.clear()

    def play_path(self, client: Any, seconds: float) -> None:
        """Move the camera of `client` along the path, `seconds` between two key frames. Again: stop."""
        if self._path_played is not None:
            self._path_played.set()
            self._path_played = None
            return
        frames = path_through(self.keyframes, seconds)
        stopped = self._path_played = threading.Event()
        self.clock.pause()
        start = time.monotonic()
        exhibit = self.halves[0].stage.exhibit
        try:
            while not stopped.wait(1 / FPS):
                number = min(int((time.monotonic() - start) * FPS), len(frames) - 1)
                self.clock.seek(exhibit.nearest(frames[number].time))
                self._changed.set()
                self._go(client, frames[number].view, None)
                if number == len(frames) - 1:
                    break
        finally:
            if self._path_played is stopped:
                self._path_played = None

    def save_path(self, client: Any, seconds: float) -> None:
        """Save the path as a camera path of nerfstudio's."""
        from splashbench.viewer.saving import camera_path_bytes, save

        frames = path_through(self.keyframes, seconds)
        height = max(2, round(_PATH_WIDTH / float(client.camera.aspect) / 2) * 2)
        cameras = [frame.view.camera(f"path_{k:06d}", _PATH_WIDTH, height) for k, frame in enumerate(frames)]
        content = camera_path_bytes(cameras, [frame.time for frame in frames], FPS)
        told = save(self.save_to, client, "camera_path", ".json", content)
        self.display.tell(client, "Camera path", told)


def on_white(rgba: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """A picture [H, W, 4] on a white ground, [H, W, 3]."""
    if rgba.shape[2] == 3:
        return rgba
    alpha = rgba[..., 3:].astype(np.float32) / 255
    return np.rint(rgba[..., :3] * alpha + 255 * (1 - alpha)).astype(np.uint8)

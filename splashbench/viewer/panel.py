"""The panel: the controls beside the scene, and what they say. All state is the viewer's."""

from __future__ import annotations

import functools
import sys
import time
from collections.abc import Callable
from typing import Any

from splashbench.errors import SplashbenchError
from splashbench.viewer.clock import SPEEDS
from splashbench.viewer.coloring import legend
from splashbench.viewer.cuts import AXES
from splashbench.viewer.half import Half
from splashbench.viewer.tracks import MEASURES
from splashbench.viewer.units import length_text, measure_text
from splashbench.viewer.viewer import Viewer
from splashbench.viewer.window import PANEL_WIDTH

#: How the liquid's Gaussians reach the browser.
SENDING = {
    "automatic": None,
    "all timesteps at once": True,
    "one timestep at a time": False,
}
_NO_CAMERA = "(none)"
_REFRESH_SECONDS = 0.25


class Panel:
    """The controls of `viewer`, in the window of its first half; it is the viewer's display from then on."""

    def __init__(self, viewer: Viewer) -> None:
        self._viewer = viewer
        self._gui: Any = viewer.halves[0].server.gui
        self._playing: bool | None = None
        self._refreshed = 0.0
        self._made = False
        self._head = self._gui.add_markdown(self._description())
        self._add_time()
        self._add_layers()
        self._add_colors()
        if any(stage.exhibit.has_distance for half in viewer.halves for stage in half.stages):
            self._add_cut()
        self._add_view()
        self._add_path()
        self._status = self._gui.add_markdown("")
        self._made = True
        viewer.display = self
        if len(viewer.halves) == 2:
            self._place_beside(viewer.halves[1].server.gui)

    def _place_beside(self, other: Any) -> None:
        """Dock the panel where it leaves both halves free; `other` is viser's of the right one."""
        self._gui.main_panel.dock_left()
        self._gui.main_panel.set_width(PANEL_WIDTH)
        other.add_markdown("The controls are on the left.")
        other.main_panel.float(x=-15, y=15)
        other.main_panel.minimize()

    def _description(self) -> str:
        first = self._viewer.halves[0].stage.exhibit
        names = " | ".join(half.stage.exhibit.name for half in self._viewer.halves)
        known = first.metres_per_unit is not None
        size = length_text(1.0, first.metres_per_unit) if known else "their size is not known"
        lines = [f"**{_plain(names)}**", f"Lengths are in scene units: {size}."]
        if not first.real_times:
            lines.append("The times of this recording are not known: speeds are of 30 timesteps a second.")
        if first.gravity is None:
            lines.append("Gravity is not known: up is the cameras' up.")
        return "\n\n".join(lines)

    # Time.

    def _add_time(self) -> None:
        clock = self._viewer.clock
        with self._gui.add_folder("Time"):
            self._slider = self._gui.add_slider("timestep", 0, max(clock.n_frames - 1, 0), 1, 0)
            self._seconds = self._gui.add_markdown("")
            self._buttons = self._gui.add_button_group(" ", ("◀ step", "play", "step ▶"))
            self._speed = self._gui.add_dropdown("speed", tuple(SPEEDS), initial_value="1")
            self._loop = self._gui.add_checkbox("loop", True)
        self._slider.on_update(self._guarded(self._slide))
        self._buttons.on_click(self._guarded(self._press))
        self._speed.on_update(self._guarded(lambda event: self._viewer.set_speed(SPEEDS[self._speed.value])))
        self._loop.on_update(self._guarded(lambda event: setattr(clock, "loop", self._loop.value)))

    def _slide(self, event: Any) -> None:
        if self._slider.value != self._viewer.clock.tick():
            self._viewer.seek(int(self._slider.value))

    def _press(self, event: Any) -> None:
        if self._buttons.value.startswith("◀"):
            self._viewer.step(-1)
        elif self._buttons.value.endswith("▶"):
            self._viewer.step(1)
        else:
            self._viewer.play_or_pause()

    def show_time(self, t: int, seconds: float, playing: bool) -> None:
        """Say which timestep is shown."""
        if self._slider.value != t:
            self._slider.value = t
        self._seconds.content = f"{seconds:.3f} s, timestep {t} of 0 to {self._viewer.clock.n_frames - 1}"
        if playing != self._playing:
            self._playing = playing
            self._buttons.options = ("◀ step", "pause" if playing else "play", "step ▶")

    # Layers.

    def _add_layers(self) -> None:
        halves = self._viewer.halves
        titles = ("Show",) if len(halves) == 1 else ("Left", "Right")
        # Of each half: the boxes by name of the layer.
        self._boxes: list[dict[str, Any]] = []
        for half, title in zip(halves, titles):
            with self._gui.add_folder(title):
                if len(half.stages) > 1:
                    self._add_choice(half)
                self._boxes.append(self._add_boxes(half))
            self.show_layers(half)
        if any("liquid" in boxes for boxes in self._boxes):
            sending = self._gui.add_dropdown("Gaussians", tuple(SENDING), initial_value="automatic")
            sending.on_update(self._guarded(lambda event: self._viewer.set_sending(SENDING[sending.value])))

    def _add_choice(self, half: Half) -> None:
        options = tuple(f"{number + 1}. {stage.exhibit.name}" for number, stage in enumerate(half.stages))
        box = self._gui.add_dropdown("of", options, initial_value=options[half.chosen])
        box.on_update(self._guarded(lambda event: self._viewer.choose(half, options.index(box.value))))

    def _add_boxes(self, half: Half) -> dict[str, Any]:
        boxes: dict[str, Any] = {}
        for stage in half.stages:
            for name, layer in stage.layers.items():
                if name not in boxes:
                    boxes[name] = box = self._gui.add_checkbox(layer.title, layer.on)
                    tick = functools.partial(self._tick, half, name, box)
                    box.on_update(self._guarded(tick))
        return boxes

    def _tick(self, half: Half, name: str, box: Any, event: Any) -> None:
        self._viewer.switch(half, name, box.value)

    def show_layers(self, half: Half) -> None:
        """Tick the boxes of the layers that `half` shows; those that its exhibit lacks are away."""
        for name, box in self._boxes[self._viewer.halves.index(half)].items():
            layer = half.stage.layers.get(name)
            box.visible = layer is not None
            if layer is not None:
                box.value, box.label, box.disabled = layer.on, layer.title, bool(layer.fault)

    # Colours.

    def _add_colors(self) -> None:
        if not any({"particles", "velocity"} & set(boxes) for boxes in self._boxes):
            self._legend = None
            return
        with self._gui.add_folder("Colour of particles"):
            self._measure = self._gui.add_dropdown("by", (*MEASURES, "none"), initial_value="speed")
            self._gui.add_image(legend(), format="png")
            self._legend = self._gui.add_markdown("")
        self._measure.on_update(self._guarded(lambda event: self._viewer.set_measure(self._measure.value)))

    def _legend_text(self) -> str:
        lines = []
        for half in self._viewer.halves:
            stage, exhibit, measure = half.stage, half.stage.exhibit, half.stage.settings.measure
            shown = any(name in stage.layers and stage.layers[name].on for name in ("particles", "velocity"))
            tracks = exhibit.__dict__.get("tracks")  # made by the worker
            if measure == "none" or not shown or tracks is None:
                continue
            who = f"{_plain(exhibit.name)}: " if len(self._viewer.halves) > 1 else ""
            if tracks.has(measure):
                ends = (measure_text(measure, end, exhibit.metres_per_unit) for end in tracks.span(measure, exhibit.up))
                lines.append(who + " to ".join(ends))
            else:
                lines.append(f"{who}no {measure} is known, as particles are not followed.")
        return "\n\n".join(lines)

    # The cut.

    def _add_cut(self) -> None:
        with self._gui.add_folder("Cut", expand_by_default=False):
            axis = self._gui.add_dropdown(
                "across", AXES, initial_value=AXES[self._viewer.halves[0].stage.settings.axis]
            )
            share = self._gui.add_slider("place", 0.0, 1.0, 0.01, 0.5)
        axis.on_update(self._guarded(lambda event: self._viewer.set_cut(axis=AXES.index(axis.value))))
        share.on_update(self._guarded(lambda event: self._viewer.set_cut(share=float(share.value))))

    # View and camera path.

    def _add_view(self) -> None:
        cameras = self._viewer.halves[0].stage.exhibit.cameras
        with self._gui.add_folder("View"):
            self._camera = self._gui.add_dropdown("camera", (_NO_CAMERA, *cameras), initial_value=_NO_CAMERA)
            free = self._gui.add_button("free viewpoint")
            shot = self._gui.add_button("screenshot")
        self._camera.on_update(self._guarded(self._choose_camera))
        free.on_click(self._guarded(lambda event: self._viewer.go_free(event.client)))
        shot.on_click(self._guarded(lambda event: self._viewer.save_screenshot(event.client)))

    def _choose_camera(self, event: Any) -> None:
        if self._camera.value != _NO_CAMERA:
            self._viewer.go_to_camera(event.client, self._camera.value)

    def show_camera(self, name: str | None) -> None:
        """Say through which camera somebody looks."""
        if self._made and self._camera.value != (name or _NO_CAMERA):
            self._camera.value = name or _NO_CAMERA

    def _add_path(self) -> None:
        with self._gui.add_folder("Camera path", expand_by_default=False):
            buttons = self._gui.add_button_group(" ", ("add", "undo", "clear"))
            between = self._gui.add_slider("seconds between", 0.5, 10.0, 0.5, 2.0)
            play = self._gui.add_button("play path")
            save = self._gui.add_button("save path")
            self._path = self._gui.add_markdown("")
        buttons.on_click(self._guarded(lambda event: self._viewer.edit_path(event.client, buttons.value)))
        play.on_click(self._guarded(lambda event: self._viewer.play_path(event.client, float(between.value))))
        save.on_click(self._guarded(lambda event: self._viewer.save_path(event.client, float(between.value))))

    # What it says.

    def refresh_soon(self) -> None:
        """As `refresh`, unless it was done just now; for what changes many times a second."""
        if time.monotonic() - self._refreshed > _REFRESH_SECONDS:
            self.refresh()

    def refresh(self) -> None:
        """Say what is being loaded, what is coarser than it is, and what the colours mean."""
        self._refreshed = time.monotonic()
        viewer = self._viewer
        lines = []
        for half in viewer.halves:
            for layer in half.stage.layers.values():
                loading = layer.loading  # read once: the worker goes on meanwhile
                if loading is not None:
                    lines.append(f"Loading {layer.title}: {loading[0]} of {loading[1]} timesteps.")
            lines += half.stage.remarks()
        _set(self._status, "\n\n".join(_plain(line) for line in dict.fromkeys(lines)))
        _set(self._head, self._description())
        if self._legend is not None:
            _set(self._legend, self._legend_text())
        number = len(viewer.keyframes)
        _set(self._path, f"{number} key frame{'' if number == 1 else 's'}" if number else "No key frame yet.")

    def _guarded(self, callback: Callable[[Any], Any]) -> Callable[[Any], None]:
        """`callback`, whose errors the user is told in the browser."""

        @functools.wraps(callback)
        def call(event: Any) -> None:
            if event.client is None:  # the viewer's own doing, such as the slider that follows the clock
                return
            try:
                callback(event)
                self._viewer.changed()
            except SplashbenchError as error:
                self.tell(event.client, "That did not work", str(error), "red")
            except Exception as error:  # a browser that goes away makes viser fail in several ways
                print(f"the viewer could not do that: {type(error).__name__}: {error}", file=sys.stderr)

        return call

    def tell(self, client: Any, title: str, text: str, color: str = "blue") -> None:
        """Show a note in the window of `client`, where it is one."""
        if client is not None:
            client.add_notification(title, text, color=color, auto_close_seconds=8.0)


def _set(markdown: Any, text: str) -> None:
    if markdown.content != text:
        markdown.content = text


def _plain(text: str) -> str:
    """`text` without what Markdown and HTML would take for more than letters: names come from strangers."""
    return "".join(f"\\{letter}" if letter in "\\`*_[]<>#!|{}" else letter for letter in text)

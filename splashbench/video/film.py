"""A film: the frames of a video, each made when it is asked for. Panels beside each other, and their captions."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from splashbench.scene import Camera
from splashbench.video.captions import Line, Strip, speed_text
from splashbench.video.panels import Panel
from splashbench.video.timing import Timing

# How far a moving divider goes to either side of the middle, as a share of the width.
_SWEEP = 0.45
# Widths of a picture for each pixel of half the divider, and its grey.
_DIVIDER, _DIVIDER_GREY = 500, 255


@dataclass
class Film:
    """The frames of a video.

    Attributes:
        timing: the liquid's instants and the frames a second.
        cameras: one for each frame, or one for all; of one size.
        panels: what stands beside each other, or, in a `wipe`, the two on either side of the divider.
        divider: of a wipe, the share of the width where it stands; None where it moves.
        captioned: whether there are lines of text below.
        nominal_step: seconds between timesteps where these are an order and no times; None where times are known.
        submissions: folders of those that are shown. scene: folder of the photographs, where there are any.
    """

    timing: Timing
    cameras: Sequence[Camera]
    panels: Sequence[Panel]
    wipe: bool = False
    divider: float | None = None
    captioned: bool = True
    nominal_step: float | None = None
    submissions: Sequence[Path] = ()
    scene: Path | None = None

    def __len__(self) -> int:
        return len(self.timing)

    def camera(self, k: int) -> Camera:
        """The camera of frame `k`."""
        return self.cameras[k if len(self.cameras) > 1 else 0]

    @property
    def size(self) -> tuple[int, int]:
        """(width, height) of the frames in pixels, captions included."""
        columns = 1 if self.wipe else len(self.panels)
        return self.cameras[0].width * columns, self.cameras[0].height + self._caption_height

    @property
    def inputs(self) -> list[Path]:
        """Folders that it is made from."""
        return [*self.submissions, *([] if self.scene is None else [self.scene])]

    def about(self) -> dict[str, Any]:
        """What it is, for files beside its frames: sizes in pixels, `times` in seconds on the scene's clock."""
        width, height = self.size
        return {
            "frames": len(self),
            "fps": self.timing.fps,
            "seconds": len(self) / self.timing.fps,
            "width": width,
            "height": height,
            "panels": [panel.title for panel in self.panels],
            "times": self.timing.times.tolist(),
        }

    def frame(self, k: int) -> NDArray[np.uint8]:
        """Frame `k`, uint8 [H, W, 3]."""
        camera, time = self.camera(k), float(self.timing.times[k])
        pictures = [panel.picture(camera, time) for panel in self.panels]
        if self.wipe:
            pictures = [self._wiped(pictures[0], pictures[1], k)]
        if self.captioned:
            strips = [strip.draw(lines, self._caption_height) for strip, lines in zip(self._strips, self._lines(k))]
            pictures = [np.concatenate(pair) for pair in zip(pictures, strips)]
        return np.concatenate(pictures, axis=1)

    def frames(self) -> Iterator[NDArray[np.uint8]]:
        """All frames in order, each made when it is asked for."""
        return map(self.frame, range(len(self)))

    def _wiped(self, left: NDArray[np.uint8], right: NDArray[np.uint8], k: int) -> NDArray[np.uint8]:
        """`left` up to the divider, and `right` from there."""
        width = left.shape[1]
        # A moving one begins in the middle, where both are seen.
        moving = 0.5 + _SWEEP * np.sin(2 * np.pi * k / len(self))
        column = round(float(np.clip(moving if self.divider is None else self.divider, 0, 1)) * width)
        picture = np.concatenate([left[:, :column], right[:, column:]], axis=1)
        half = max(1, width // _DIVIDER)
        picture[:, max(0, column - half) : column + half] = _DIVIDER_GREY
        return picture

    @cached_property
    def _strips(self) -> list[Strip]:
        """The captions' strips, wide enough for the longest text of each."""
        longest = max(range(len(self)), key=lambda k: len(self._when(k)))
        scales = [panel.scale for panel in self.panels]
        if self.wipe:
            scales = [next((scale for scale in scales if scale is not None), None)]
        return [Strip(self.cameras[0].width, lines, scale) for lines, scale in zip(self._lines(longest), scales)]

    @cached_property
    def _caption_height(self) -> int:
        return max(strip.height for strip in self._strips) if self.captioned else 0

    def _lines(self, k: int) -> list[list[Line]]:
        """The captions' lines: of each panel, or of the two of a wipe together."""
        notes = [panel.note(float(self.timing.times[k])) for panel in self.panels]
        titles = [panel.title for panel in self.panels]
        if self.wipe:
            return [[Line(titles[0], titles[1]), Line(self._when(k), notes[1] or notes[0])]]
        first = [Line(titles[0], self._when(k)), *([Line(notes[0])] if notes[0] else [])]
        return [first, *([Line(title, note)] for title, note in zip(titles[1:], notes[1:]))]

    def _when(self, k: int) -> str:
        """The time and the speed of frame `k`."""
        time, speed = float(self.timing.times[k]), speed_text(self.timing.speed(k)) if len(self) > 1 else ""
        if self.nominal_step is not None:  # "real time" would be a claim
            return f"timestep {time / self.nominal_step:.2f}"
        return f"{time:.3f} s, {speed}" if speed else f"{time:.3f} s"

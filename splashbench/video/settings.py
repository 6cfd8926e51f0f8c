"""What a user says of a video."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from splashbench.replay import Reconstruction
from splashbench.video.layers import FLAT_COLOR

#: The photographs, among what a video may be compared with.
TRUTH: Literal["truth"] = "truth"


@dataclass(frozen=True)
class Comparison:
    """What a video is compared with, and how the two are laid out.

    Attributes:
        others: `TRUTH`, or other reconstructions of the scene, in the order in which they stand.
        layout: "beside", or "wipe" for two pictures in one place with a divider between them.
        divider: of a wipe, the share of the width where it stands; None for one that goes forth and back once.
    """

    others: Sequence[Reconstruction | Literal["truth"]] = ()
    layout: Literal["beside", "wipe"] = "beside"
    divider: float | None = None

    @property
    def reconstructions(self) -> list[Reconstruction]:
        """The others without the photographs."""
        return [other for other in self.others if isinstance(other, Reconstruction)]

    @property
    def has_truth(self) -> bool:
        """Whether the photographs are among them."""
        return len(self.reconstructions) < len(self.others)


@dataclass(frozen=True)
class VideoSettings:
    """What a video shows. Options of `splashbench video` have the same names.

    Attributes:
        view: a camera's name; the first test camera by default. orbit: around the liquid instead. path: a camera path's
            file instead, see `splashbench.replay.paths`.
        orbit_degrees, orbit_height: of the orbit; by default as the training cameras stand.
        start, end: seconds on the scene's clock; the recording's by default.
        fps: frames a second; by default 30, or the path's. slow: how many times slower than real.
        seconds: length of the video, instead of `slow`; then the time may stand still (`start` equal to `end`).
        timesteps: a frame for each timestep instead, and none in between.
        layer: one of `splashbench.video.layers.LAYERS`. scale: ends of its colours; by default by what is seen.
        flat: colour behind the liquid alone, sRGB of 255.
        resize: factor on the sides of the pictures.
        caption: whether there are lines of text below.
    """

    view: str | None = None
    orbit: bool = False
    orbit_degrees: float | None = None
    orbit_height: float | None = None
    path: Path | None = None
    start: float | None = None
    end: float | None = None
    fps: float | None = None
    slow: float | None = None
    seconds: float | None = None
    timesteps: bool = False
    layer: str = "color"
    scale: tuple[float, float] | None = None
    flat: tuple[int, int, int] = FLAT_COLOR
    resize: float = 1.0
    caption: bool = True

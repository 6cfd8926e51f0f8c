"""Layers: what a picture shows of a reconstruction. Its colours, or one of five quantities, with their scales."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Iterable
from dataclasses import dataclass
from functools import cached_property
from typing import ClassVar

import numpy as np
from numpy.typing import NDArray

from splashbench.errors import SplashbenchError
from splashbench.replay import Reconstruction
from splashbench.replay.interface import cast, rays
from splashbench.scene import Camera
from splashbench.submission import to_8bit
from splashbench.video.scales import Scale, round_range

#: Dark blue grey, which neither water nor its highlights have.
FLAT_COLOR = (38, 42, 54)
# From which foreground opacity a pixel counts as liquid.
_VISIBLE = 0.5
# Of the mean absolute difference to the photograph: half of what a wrong picture of liquid has.
_LARGEST_ERROR = 0.25
# Of the speeds that are seen: single nodes beyond the liquid's edge run away.
_FASTEST_PERCENT = 99.5


@dataclass
class Shot:
    """One view at one instant, rendered when it is first asked for.

    photograph: uint8 [H, W, 3] of the same camera, nearest in time; None where there is none.
    """

    source: Reconstruction
    camera: Camera
    time: float
    photograph: NDArray[np.uint8] | None = None

    @cached_property
    def _render(self) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
        """Colours and opacity. Raises SplashbenchError where the method fails, or gives something else."""
        view = self.source.render(self.camera, self.time)
        return np.asarray(view.rgb, np.float32), np.asarray(view.alpha, np.float32)

    @property
    def rgb(self) -> NDArray[np.float32]:
        """float32 [H, W, 3], sRGB."""
        return self._render[0]

    @property
    def alpha(self) -> NDArray[np.float32]:
        """float32 [H, W], foreground opacity."""
        return self._render[1]

    @cached_property
    def depth(self) -> NDArray[np.float32]:
        """Depth of the liquid's surface [H, W] where it is seen, scene units; NaN elsewhere.

        What the method's opacity says is hidden, by a container say, is not seen.
        """
        surface = self.source.surface(self.time)
        if surface is None:
            raise SplashbenchError(
                f"{self.source.submission.directory} has no surface of the liquid, as method {self.source.name} hands "
                "in none; choose layer color, opacity or error"
            )
        depth = cast(surface, self.camera).depth
        return np.where(np.isfinite(depth) & (self.alpha >= _VISIBLE), depth, np.float32(np.nan))

    @cached_property
    def speed(self) -> NDArray[np.float32]:
        """Speed of the liquid at the surface that is seen [H, W], in m/s where the scale is known, else units/s; NaN
        elsewhere."""
        field = self.source.velocity(self.time)
        if field is None:
            raise SplashbenchError(
                f"{self.source.submission.directory} has no velocity, as method {self.source.name} hands in none; "
                "choose another layer"
            )
        seen = np.isfinite(self.depth)
        speeds = np.full(seen.shape, np.nan, np.float32)
        points = self.camera.center + self.depth[seen][:, None] * rays(self.camera)[seen]
        speeds[seen] = np.linalg.norm(field.at(points), axis=1) * (self.source.metres_per_unit or 1.0)
        return speeds


class Layer(ABC):
    """A way to show a shot.

    name: as the user asks for it. needs_photograph: whether it compares with one. needs_sample: whether its scale goes
    by what is seen, so that `extent` has to look at some shots.
    """

    name: ClassVar[str]
    needs_photograph: ClassVar[bool] = False
    needs_sample: ClassVar[bool] = False

    def extent(self, shots: Iterable[Shot]) -> tuple[float, float]:
        """Ends of a scale for all that `shots` show."""
        raise NotImplementedError

    def scale(self, source: Reconstruction, ends: tuple[float, float] | None) -> Scale | None:
        """The scale for a whole video of `source`, between `ends` or its usual ones; None for a layer of colours."""
        return None

    @abstractmethod
    def paint(self, shot: Shot, scale: Scale | None) -> NDArray[np.uint8]:
        """The picture, uint8 [H, W, 3]."""


class _Color(Layer):
    name = "color"

    def paint(self, shot: Shot, scale: Scale | None) -> NDArray[np.uint8]:
        return to_8bit(shot.rgb)


class _Liquid(Layer):
    """The liquid over one colour: the render, with that colour in the place of what is seen through the liquid."""

    name = "liquid"

    def __init__(self, flat: tuple[int, int, int]) -> None:
        self._flat = np.array(flat, dtype=np.float32) / 255

    def paint(self, shot: Shot, scale: Scale | None) -> NDArray[np.uint8]:
        empty = shot.source.empty_view(shot.camera)
        through = 1 - shot.alpha[..., None]
        liquid = shot.rgb * shot.alpha[..., None] if empty is None else shot.rgb - through * empty
        return to_8bit(liquid + through * self._flat)


class _Measure(Layer):
    """A layer of numbers. Where there is none, a dark grey picture is shown."""

    label: ClassVar[str]
    map: ClassVar[str]
    usual: ClassVar[tuple[float, float]] = (0.0, 1.0)

    def scale(self, source: Reconstruction, ends: tuple[float, float] | None) -> Scale:
        low, high = ends or self.usual
        return Scale(self.label, low, high, self.unit(source), self.map)

    def extent(self, shots: Iterable[Shot]) -> tuple[float, float]:
        samples = [self.values(shot) for shot in shots]
        seen = np.concatenate([values[np.isfinite(values)] for values in samples])
        return self.ends(seen) if len(seen) else self.usual

    def paint(self, shot: Shot, scale: Scale | None) -> NDArray[np.uint8]:
        assert scale is not None
        return scale.over(self.values(shot), to_8bit(shot.rgb))

    def ends(self, seen: NDArray[np.float32]) -> tuple[float, float]:
        """Ends of a scale for the values `seen` [n], of which there is one at least."""
        return self.usual

    def unit(self, source: Reconstruction) -> str:
        """Of the values."""
        return ""

    @abstractmethod
    def values(self, shot: Shot) -> NDArray[np.float32]:
        """[H, W]; NaN where there is nothing to be shown."""


class _Opacity(_Measure):
    name, label, map = "opacity", "opacity", "cividis"

    def values(self, shot: Shot) -> NDArray[np.float32]:
        return shot.alpha


class _Error(_Measure):
    """The mean absolute difference of a pixel's three colours to the photograph's."""

    name, label, map, usual = "error", "error", "inferno", (0.0, _LARGEST_ERROR)
    needs_photograph = True

    def values(self, shot: Shot) -> NDArray[np.float32]:
        assert shot.photograph is not None
        return np.asarray(np.abs(shot.rgb - shot.photograph.astype(np.float32) / 255).mean(axis=-1))


class _Depth(_Measure):
    name, label, map = "depth", "depth", "viridis_r"  # what is near is bright
    needs_sample = True

    def ends(self, seen: NDArray[np.float32]) -> tuple[float, float]:
        return round_range(float(seen.min()), float(seen.max()))

    def unit(self, source: Reconstruction) -> str:
        return "units" if source.metres_per_unit is None else "m"

    def values(self, shot: Shot) -> NDArray[np.float32]:
        return shot.depth * np.float32(shot.source.metres_per_unit or 1.0)


class _Velocity(_Measure):
    name, label, map = "velocity", "speed", "viridis"
    needs_sample = True

    def ends(self, seen: NDArray[np.float32]) -> tuple[float, float]:
        return 0.0, round_range(0.0, float(np.percentile(seen, _FASTEST_PERCENT)))[1]

    def unit(self, source: Reconstruction) -> str:
        return "units/s" if source.metres_per_unit is None else "m/s"

    def values(self, shot: Shot) -> NDArray[np.float32]:
        return shot.speed


_MEASURES: dict[str, type[_Measure]] = {kind.name: kind for kind in (_Opacity, _Depth, _Error, _Velocity)}
#: Names of all layers.
LAYERS = (_Color.name, *_MEASURES, _Liquid.name)


def make_layer(name: str, flat: tuple[int, int, int] = FLAT_COLOR) -> Layer:
    """The layer `name`, one of `LAYERS`. flat: the colour, sRGB of 255, behind the liquid alone."""
    if name not in LAYERS:
        raise SplashbenchError(f"there is no layer {name[:40]!r}; choose one of {', '.join(LAYERS)}")
    if name == _Liquid.name:
        return _Liquid(flat)
    return _Color() if name == _Color.name else _MEASURES[name]()

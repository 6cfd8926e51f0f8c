"""The dye that was filmed, found in a reconstruction: how much it absorbs, and the colour of its thick layers.

A pixel of the liquid shows (1 - F) (B T + A (1 - T)) + F E: the background B through the transmittance T of the way
within the liquid, the light A that a thick layer returns, and by Fresnel's share F the light E of the room. B, F and
the ways are known of every pixel. For each absorption the best A follows by robust regression; the absorption that
leaves the least is the dye's. Whether anything is seen through the liquid is asked apart: an opaque dye is explained no
worse by a background without any pattern. Its absorption is more than what is measured and cannot be known.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, fields

import numpy as np
from numpy.typing import NDArray

from splashbench.errors import SplashbenchError
from splashbench.replay import Reconstruction
from splashbench.replay.interface import cast
from splashbench.restyle.optics import REFRACTIVE_INDEX, facing, reflectance, seen_through, smoothed
from splashbench.srgb import to_linear

#: Relative luminance of linear red, green and blue (IEC 61966-2-1).
LUMINANCE = np.array([0.2126, 0.7152, 0.0722])
# Views that are looked at: at most this many instants, and images of this longest side; more says the same.
_INSTANTS, _LONGEST_SIDE, _PIXELS_PER_VIEW = 6, 480, 2000
# Pixels are the liquid's from this opacity.
_LEAST_OPACITY = 0.9
_LEAST_PIXELS = 200
_ABSORPTIONS = 48
_REWEIGHTINGS = 6
# By less than this share a patterned background explains the liquid better than one without: it is opaque.
_SEEN_THROUGH = 0.04
_RESAMPLES = 200


@dataclass(frozen=True, eq=False)
class FilmedDye:
    """The liquid's optical properties as they were filmed.

    Attributes:
        absorption: float64 [3], per scene unit, of red, green and blue. Of an opaque liquid: inf.
        interval: float64 [2, 3], the 5th and 95th percentile of `absorption` over resampled views. Of an opaque
            liquid: from the least that the photographs allow, to inf.
        returned: float64 [3], A: linear light of a layer that hides what is behind it.
        mirrored: float, E: linear light of the room in the surface.
        index: refractive index that explains the liquid best, 1 (nothing is bent) or `REFRACTIVE_INDEX`.
        opaque: whether nothing is seen through it, so that its absorption cannot be known.
        longest: the 95th percentile of the ways within the liquid, scene units.
    """

    absorption: NDArray[np.float64]
    interval: NDArray[np.float64]
    returned: NDArray[np.float64]
    mirrored: float
    index: float
    opaque: bool
    longest: float


@dataclass
class _Pixels:
    """n pixels: light and background [n, 3], way [n] within the liquid, mirrored share [n], and which view [n]."""

    light: NDArray[np.float64]
    background: NDArray[np.float64]
    length: NDArray[np.float64]
    mirrored: NDArray[np.float64]
    view: NDArray[np.int64]


def filmed_dye(reconstruction: Reconstruction) -> FilmedDye:
    """Find the dye of `reconstruction` in its own renders of the training views.

    Raises SplashbenchError where the method has no surface or no background of its own, and where there is no liquid.
    """
    require_optics(reconstruction)
    candidates = _pixels(reconstruction, (1.0, REFRACTIVE_INDEX))
    straight = candidates[1.0]
    if len(straight.length) < _LEAST_PIXELS:
        raise SplashbenchError(
            f"{reconstruction.submission.directory} shows too little liquid to find its dye in ({len(straight.length)} "
            "pixels of the training views); nothing to restyle"
        )
    room = float(np.median(straight.background @ LUMINANCE))
    fits = {index: [_Channel.of(pixels, c, room) for c in range(3)] for index, pixels in candidates.items()}
    index = min(fits, key=lambda key: sum(channel.loss for channel in fits[key]))
    channels, pixels = fits[index], candidates[index]
    longest = float(np.percentile(pixels.length, 95))
    patternless = _without_pattern(pixels)
    flat = [_Channel.of(patternless, c, room).loss for c in range(3)]
    opaque = all(channel.loss > (1 - _SEEN_THROUGH) * loss for channel, loss in zip(channels, flat))
    if opaque:
        thick = [_returned(pixels, c, np.zeros(len(pixels.length)), room)[0] for c in range(3)]
        least = np.array([channel.low for channel in channels])
        nothing = np.full(3, np.inf)
        return FilmedDye(nothing, np.array([least, nothing]), np.array(thick), room, REFRACTIVE_INDEX, True, longest)
    absorption = np.array([channel.absorption for channel in channels])
    interval = np.array([[channel.low for channel in channels], [channel.high for channel in channels]])
    returned = np.array([channel.returned for channel in channels])
    return FilmedDye(absorption, interval, returned, room, index, False, longest)


def require_optics(reconstruction: Reconstruction) -> None:
    """Raise SplashbenchError where `reconstruction` lacks what light needs: a surface, and what lies behind it."""
    camera = reconstruction.cameras[reconstruction.train[0]]
    name, directory = reconstruction.name, reconstruction.submission.directory
    if not reconstruction.has_model:
        raise SplashbenchError(f"{directory} has no model that can be opened here; run {name} again, keeping its model")
    if reconstruction.surface(float(reconstruction.times[0])) is None:
        raise SplashbenchError(f"{directory}: {name} hands in no surface of the liquid; restyle one of splashsplat")
    if reconstruction.empty_view(camera.scaled(0.25)) is None:
        raise SplashbenchError(f"{directory}: {name} keeps no background of its own; restyle one of splashsplat")


def _views(reconstruction: Reconstruction) -> Iterator[tuple[str, float]]:
    count = len(reconstruction.times)
    steps = np.unique(np.linspace(0, count - 1, min(_INSTANTS, count) + 1)[1:].round().astype(int))
    for name in reconstruction.train:
        for t in steps:
            yield name, float(reconstruction.times[t])


def _pixels(reconstruction: Reconstruction, indices: Sequence[float]) -> dict[float, _Pixels]:
    """The same pixels for each refractive index, by which their backgrounds differ."""
    rng = np.random.default_rng(0)
    parts: dict[float, list[_Pixels]] = {index: [] for index in indices}
    for number, (name, time) in enumerate(_views(reconstruction)):
        camera = reconstruction.cameras[name]
        camera = camera.scaled(min(1.0, _LONGEST_SIDE / max(camera.width, camera.height)))
        surface, behind = reconstruction.surface(time), reconstruction.empty_view(camera)
        assert surface is not None
        assert behind is not None
        rendered, interface = reconstruction.render(camera, time), smoothed(cast(surface, camera), camera)
        known = (rendered.alpha > _LEAST_OPACITY) & interface.seen & (interface.length > 0)
        chosen = np.flatnonzero(known)
        chosen = rng.choice(chosen, min(len(chosen), _PIXELS_PER_VIEW), replace=False)
        light, background = (to_linear(image) for image in (rendered.rgb, behind))
        mirrored, view = reflectance(facing(interface, camera)), np.full(len(chosen), number)
        for index, pixels in parts.items():
            through = seen_through(background, interface, camera, index)
            pixels.append(
                _Pixels(
                    light.reshape(-1, 3)[chosen].astype(np.float64),
                    through.reshape(-1, 3)[chosen].astype(np.float64),
                    interface.length.ravel()[chosen].astype(np.float64),
                    mirrored.ravel()[chosen].astype(np.float64),
                    view,
                )
            )
    names = [field.name for field in fields(_Pixels)]
    return {
        index: _Pixels(*(np.concatenate([getattr(part, name) for part in pixels]) for name in names))
        for index, pixels in parts.items()
    }


def _without_pattern(pixels: _Pixels) -> _Pixels:
    """`pixels` before a background of one colour, its median."""
    flat = np.broadcast_to(np.median(pixels.background, axis=0), pixels.background.shape)
    return _Pixels(pixels.light, flat, pixels.length, pixels.mirrored, pixels.view)


@dataclass(frozen=True)
class _Channel:
    """One channel's fit: absorption with its interval, A, and the mean absolute residual."""

    absorption: float
    low: float
    high: float
    returned: float
    loss: float

    @classmethod
    def of(cls, pixels: _Pixels, channel: int, room: float) -> _Channel:
        short, long = np.percentile(pixels.length, [5, 95])
        grid = np.geomspace(0.02 / long, 30 / max(short, long / 50), _ABSORPTIONS)
        views = pixels.view.max() + 1
        count = np.maximum(np.bincount(pixels.view, minlength=views), 1)
        returned, losses = np.zeros(len(grid)), np.zeros((len(grid), views))
        for k, absorption in enumerate(grid):
            returned[k], residual = _returned(pixels, channel, np.exp(-absorption * pixels.length), room)
            losses[k] = np.bincount(pixels.view, weights=np.abs(residual), minlength=views)
        total = losses.sum(axis=1)
        best = int(total.argmin())
        # Views are resampled, not pixels: those of one view are wrong together.
        drawn = np.random.default_rng(1).multinomial(views, np.full(views, 1 / views), size=_RESAMPLES)
        # The absorption lies between two of the grid at best.
        margin = np.sqrt(grid[1] / grid[0])
        low, high = np.percentile(grid[(drawn @ losses.T).argmin(axis=1)], [5, 95]) * [1 / margin, margin]
        return cls(float(grid[best]), float(low), float(high), float(returned[best]), float(total[best] / count.sum()))


def _returned(
    pixels: _Pixels, channel: int, through: NDArray[np.float64], room: float
) -> tuple[float, NDArray[np.float64]]:
    """A of `channel` for the transmittances `through` [n], and the residuals [n]; highlights count little."""
    bare = 1 - pixels.mirrored
    factor = bare * (1 - through)
    left = pixels.light[:, channel] - bare * pixels.background[:, channel] * through - pixels.mirrored * room
    weight = np.ones(len(left))
    value, residual = 0.0, left
    for _ in range(_REWEIGHTINGS):
        value = max(float((weight * factor * left).sum() / max((weight * factor**2).sum(), 1e-12)), 0.0)
        residual = left - value * factor
        scale = 1.5 * 1.4826 * float(np.median(np.abs(residual))) + 1e-6
        weight = 1 / np.maximum(np.abs(residual) / scale, 1)  # Huber 1964
    return value, residual

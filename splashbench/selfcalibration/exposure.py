"""How far the training cameras' exposure, white balance and contrast are apart, by the colours of points in common.

A camera has a gain of each channel, in linear light, and its sRGB values an exponent after that. In log(sRGB + 0.055) a
gain is an offset (the power 1/2.4 of IEC 61966-2-1); in log(sRGB) an exponent is a factor. Cameras that agree are the
standard; where none do, their mean is (Tukey's biweight).
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from itertools import combinations
from typing import Any

import numpy as np
from numpy.typing import NDArray

from splashbench.background.clean_plate import CleanPlate

from .features import Tracks

_TOE, _POWER = 0.055, 2.4
# Points that two views have in common, below which they are not compared.
_OF_A_PAIR = 25
# Pixels beside a point whose median is its colour.
_REACH = 1
# Values that are clipped, or nearly, say nothing.
_DARK, _BRIGHT = 4, 250
# Cameras closer than this to the standard are left as they are: stops of a gain, and of the contrast's exponent.
_SAME_STOPS, _SAME_CONTRAST = 0.04, 0.04
# And those whose distance from it is not so many times as large as what half the points say otherwise.
_TRUSTED = 4.0
# How much less apart cameras have to be with contrast than without.
_RICHER = 0.9


@dataclass(frozen=True)
class Response:
    """How a camera sees what the standard camera sees: gains float64 [3] in stops of linear light, by channel, and the
    exponent of contrast."""

    stops: NDArray[np.float64]
    contrast: float = 1.0

    @property
    def is_standard(self) -> bool:
        return self.contrast == 1.0 and not self.stops.any()

    def undone(self, image: NDArray[np.uint8]) -> NDArray[np.uint8]:
        """`image` [..., 3], sRGB, as the standard camera would have taken it."""
        even = (np.arange(256) / 255) ** (1 / self.contrast)
        meant = np.exp(np.log(even + _TOE)[:, None] - self.stops * np.log(2) / _POWER) - _TOE
        table = np.rint(255 * np.clip(meant, 0, 1)).astype(np.uint8)
        # Black stays black, whatever the gain.
        table[0] = 0
        return np.stack([table[image[..., channel], channel] for channel in range(3)], axis=-1)


def responses(tracks: Tracks, plates: Mapping[str, CleanPlate]) -> dict[str, Response]:
    """The response of each camera of `plates`; the standard one for cameras that do not differ, or of which too little
    is known."""
    views = tracks.views
    standard = {name: Response(np.zeros(3)) for name in views}
    colors = np.stack([_colors(plates[name], tracks.pixels[:, number]) for number, name in enumerate(views)], axis=1)
    usable = np.asarray(np.isfinite(colors).all(axis=-1))
    kept = usable.sum(axis=1) >= 2
    colors, usable = colors[kept], usable[kept]
    first, second = (colors[::2], usable[::2]), (colors[1::2], usable[1::2])
    try:
        # Contrast as well where points that had no say agree much better for it.
        plain, rich = (_left(*second, _solved(*first, with_contrast)) for with_contrast in (False, True))
        with_contrast = rich < _RICHER * plain
        (contrast, gains), *halves = (_solved(*part, with_contrast) for part in ((colors, usable), first, second))
    except _TooFew:
        return standard
    (contrast_a, gains_a), (contrast_b, gains_b) = halves
    unsure = max(float(np.abs(gains_a - gains_b).max()), float(np.abs(np.log(contrast_a / contrast_b)).max()), 1e-3)
    found = dict(standard)
    for number, name in enumerate(views):
        stops = gains[number] * _POWER / np.log(2)
        off = max(np.abs(stops).max() / _SAME_STOPS, abs(np.log2(contrast[number])) / _SAME_CONTRAST)
        sure = max(np.abs(gains[number]).max(), abs(np.log(contrast[number]))) > _TRUSTED * unsure
        if off > 1 and sure:
            found[name] = Response(stops, float(contrast[number]))
    return found


def _colors(plate: CleanPlate, pixels: NDArray[np.float64]) -> NDArray[np.float64]:
    """log(sRGB) at `pixels` [N, 2], medians of small squares: [N, 3], NaN where it is not known or clipped."""
    height, width = plate.seen.shape
    column, row = (np.floor(np.nan_to_num(pixels, nan=-10)).astype(int)).T
    inside = (column >= _REACH) & (column < width - _REACH) & (row >= _REACH) & (row < height - _REACH)
    found = np.full((len(pixels), 3), np.nan)
    steps = np.arange(-_REACH, _REACH + 1)
    down, along = (part.ravel() for part in np.meshgrid(steps, steps, indexing="ij"))
    rows, columns = row[inside, None] + down, column[inside, None] + along
    square = np.median(plate.image[rows, columns], axis=1)
    square[~plate.seen[rows, columns].all(axis=1)] = np.nan
    square[((square < _DARK) | (square > _BRIGHT)).any(axis=-1)] = np.nan
    found[inside] = np.log(square / 255)
    return found


def _solved(
    colors: NDArray[np.float64], usable: NDArray[np.bool_], with_contrast: bool
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Contrast [V] and gains [V, 3] of log colours [N, V, 3]: of every two views first, then of all.

    Raises _TooFew where views have too few points in common.
    """
    n_views = usable.shape[1]
    pairs = [(a, b) for a, b in combinations(range(n_views), 2) if (usable[:, a] & usable[:, b]).sum() >= _OF_A_PAIR]
    counts = np.array([float((usable[:, a] & usable[:, b]).sum()) for a, b in pairs])
    log_contrast = np.zeros(n_views)
    if with_contrast:
        slopes = [_slope(*_in_common(colors, usable, a, b)) for a, b in pairs]
        log_contrast = _reconciled(pairs, np.log(slopes), counts, n_views)
        log_contrast -= standard_of(log_contrast)
    contrast = np.exp(log_contrast)
    even = _even(colors, contrast)
    gains = np.empty((n_views, 3))
    for channel in range(3):
        common = (_in_common(even, usable, a, b) for a, b in pairs)
        apart = np.array([np.median(second[:, channel] - first[:, channel]) for first, second in common])
        offsets = _reconciled(pairs, apart, counts, n_views)
        gains[:, channel] = offsets - standard_of(offsets)
    return contrast, gains


def _even(colors: NDArray[np.float64], contrast: NDArray[np.float64]) -> NDArray[np.float64]:
    """log(sRGB + 0.055) without the contrast."""
    return np.log(np.exp(colors / contrast[:, None]) + _TOE)


def _in_common(
    colors: NDArray[np.float64], usable: NDArray[np.bool_], a: int, b: int
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    both = usable[:, a] & usable[:, b]
    return colors[both, a], colors[both, b]


def _slope(first: NDArray[np.float64], second: NDArray[np.float64]) -> float:
    """How many times as far `second` [n, 3] spreads as `first`: the line through both with the least distances across,
    all channels alike, points far from it left out."""
    first, second = first - np.median(first, axis=0), second - np.median(second, axis=0)
    kept, slope = np.ones(first.shape, dtype=bool), 1.0
    for _ in range(5):
        x, y = first[kept] - first[kept].mean(), second[kept] - second[kept].mean()
        xx, yy, xy = (x * x).sum(), (y * y).sum(), (x * y).sum()
        slope = float((yy - xx + np.hypot(yy - xx, 2 * xy)) / max(2 * xy, 1e-9))
        slope = float(np.clip(slope, 0.25, 4.0))
        away = np.abs(second - slope * first)
        kept = away <= 3 * max(float(np.median(away)), 1e-4)
    return slope


def _reconciled(
    pairs: list[tuple[int, int]], apart: NDArray[np.float64], counts: NDArray[np.float64], n_views: int
) -> NDArray[np.float64]:
    """Values [V] of views whose differences are nearest to `apart` (second less first of `pairs`), mean 0."""
    rows = np.zeros((len(pairs) + 1, n_views))
    rows[np.arange(len(pairs)), [a for a, _ in pairs]] = -1
    rows[np.arange(len(pairs)), [b for _, b in pairs]] = 1
    rows[-1] = 1
    if np.linalg.matrix_rank(rows) < n_views:
        raise _TooFew
    weights = np.sqrt(np.append(counts, counts.max()))
    solution = np.linalg.lstsq(rows * weights[:, None], np.append(apart, 0) * weights, rcond=None)[0]
    return np.asarray(solution)


class _TooFew(Exception):
    """Views have too few points in common."""


def _left(colors: NDArray[np.float64], usable: NDArray[np.bool_], solved: tuple[Any, Any]) -> float:
    """How far apart cameras see the same point after `solved`, typically: log values."""
    contrast, gains = solved
    meant = np.where(usable[..., None], _even(colors, contrast) - gains, np.nan)
    return float(np.nanmedian(np.abs(meant - np.nanmean(meant, axis=1, keepdims=True))))


def standard_of(values: NDArray[np.float64]) -> float:
    """What most of `values` [V] are near: Tukey's biweight, about their median."""
    middle = float(np.median(values))
    for _ in range(10):
        spread = max(1.4826 * float(np.median(np.abs(values - np.median(values)))), 5e-3)
        away = (values - middle) / (4.685 * spread)
        weight = np.where(np.abs(away) < 1, (1 - away**2) ** 2, 0.0)
        if not weight.any():
            break
        middle = float((weight * values).sum() / weight.sum())
    return middle

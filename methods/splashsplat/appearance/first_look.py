"""An appearance to begin with: each carrier has the colour of the photographs that see it.

Where these disagree, it is likely to be phantom volume of the hull, and begins more transparent: space carving by
colour (Kutulakos and Seitz 2000), as a start that the fit may leave. Not in the paper, whose features begin at random:
a fit has nothing to show for its first seconds then.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numba
import numpy as np
import torch

from ..carriers.subframe import Track
from ..kernel.window_loss import WindowPhotograph
from .decoder import Decoder
from .photographs import ReadAhead
from .projection import project
from .targets import HIDDEN, TrainingTarget

# How far behind the nearest carrier of a pixel another one is still seen, transport voxels.
_SEEN_WITHIN = 1.0
# What a photograph says of carriers behind others, as a share of what it says of those in front.
_BEHIND = 0.01
# Colours are kept this far from black and white, where logits have no end.
_LEAST = 0.02
# By how much an opacity's logit is lower for photographs that disagree by all of the range from black to white. Looked
# at on opaque_bowl, 2 000 iterations: 30 has 28.88 dB, 10 28.90 and more spill, 0 28.81 and still more.
_DOUBT = 30.0
# The features that hold a colour's logits, and the one that holds the doubt.
_COLOR, _CERTAINTY = 3, 3
# Hidden units that hand a colour's logits on, by pairs: each passes what is positive, or what is negative.
_PASSING = 6
#: features and hidden units of a decoder that a look fits into
LEAST_FEATURES, LEAST_HIDDEN = _CERTAINTY + 1, _PASSING
#: features that a look sets
GIVEN = _CERTAINTY + 1
# The other units' say at the start, as a share of what they would have.
_NOISE = 0.1
# Carriers whose sums become colours at once: those of all take as much memory as what is learned of them.
_BLOCK = 1 << 16
# No carrier is hidden.
_EVERY = np.zeros(0, dtype=bool)


@dataclass(frozen=True)
class Look:
    """How photographs show the carriers. colors: float32 [count, 3], the mean over photographs, in [0, 1]. spread:
    float32 [count], the root mean square over photographs and channels of what they differ from it by."""

    colors: np.ndarray
    spread: np.ndarray


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _shown(
    positions: np.ndarray,
    seen: np.ndarray,
    projection: np.ndarray,
    corner: tuple[int, int],
    mask: np.ndarray,
    image: np.ndarray,
    reach: float,
    nearest: np.ndarray,
) -> tuple[np.ndarray, np.ndarray]:
    """The carriers within a photograph's mask, int64 [n], and of each its weight, weighted colour and weighted squares,
    float64 [n, 7]; nearest: float64 of the mask's shape, inf."""
    height, width = mask.shape
    rows, columns = np.full(len(positions), -1, np.int64), np.empty(len(positions), np.int64)
    depths = np.empty(len(positions))
    for n in range(len(positions)):
        if len(seen) > 0 and not seen[n]:
            continue
        u, v, depth = project(projection, positions[n, 0], positions[n, 1], positions[n, 2])
        column, row = np.floor(u) - corner[0], np.floor(v) - corner[1]
        if depth > 0 and 0 <= column < width and 0 <= row < height and mask[int(row), int(column)]:
            rows[n], columns[n], depths[n] = int(row), int(column), depth
            nearest[rows[n], columns[n]] = min(nearest[rows[n], columns[n]], depth)
    within = np.flatnonzero(rows >= 0)
    shown = np.empty((len(within), 7))
    for k in range(len(within)):
        carrier = within[k]
        row, column = rows[carrier], columns[carrier]
        weight = 1.0 if depths[carrier] <= nearest[row, column] + reach else _BEHIND
        shown[k, 0] = weight
        for channel in range(3):
            color = image[row, column, channel] / 255
            shown[k, 1 + channel] = weight * color
            shown[k, 4 + channel] = weight * color**2
    return within, shown


class FirstLook:
    """Adds up how photographs show the carriers of `track`, one photograph after the other.

    A photograph sees a carrier where no other lies before it; of what lies behind it says little.
    """

    def __init__(self, track: Track) -> None:
        self._track = track
        self._sums = np.zeros((track.carriers.count, 7))

    def at(self, target: TrainingTarget, photograph: WindowPhotograph) -> tuple[np.ndarray, np.ndarray]:
        """What the `photograph` of `target` shows, to be added; several may be looked at at once."""
        mask = photograph.mask.numpy()
        within, shown = _shown(
            self._track.positions(target.frame, target.fraction),
            _EVERY if target.hidden is None else target.hidden.numpy() < HIDDEN // 2,
            np.ascontiguousarray(target.camera.projection),
            (photograph.left, photograph.top),
            np.ascontiguousarray(mask),
            np.ascontiguousarray(photograph.image.numpy()),
            _SEEN_WITHIN * self._track.grid.voxel,
            np.full(mask.shape, np.inf),
        )
        carriers = self._track.carriers
        return carriers.ids[carriers.rows(target.frame)][within], shown

    def add(self, seen: tuple[np.ndarray, np.ndarray]) -> None:
        """Add what `at` found. No carrier is in a frame twice."""
        ids, shown = seen
        self._sums[ids] += shown

    def look(self) -> Look:
        """How all of them show each carrier. Carriers in none have the mean colour of the others."""
        sums = self._sums
        seen_at_all = sums[:, 0].any()
        mean = sums[:, 1:4].sum(axis=0) / sums[:, 0].sum() if seen_at_all else np.full(3, 0.5)
        look = Look(np.empty((len(sums), 3), np.float32), np.empty(len(sums), np.float32))
        for start in range(0, len(sums), _BLOCK):
            rows = slice(start, start + _BLOCK)
            look.colors[rows], look.spread[rows] = _mean_and_spread(sums[rows], mean)
        return look


def photographed(track: Track, targets: Sequence[TrainingTarget]) -> Look:
    """How the photographs of `targets` show each carrier; see `FirstLook`."""
    first = FirstLook(track)
    reader = ReadAhead()
    for target, following in zip(targets, [*targets[1:], None]):
        photograph = reader.get(target.photograph)
        if following is not None:
            reader.prepare(following.photograph)
        first.add(first.at(target, photograph))
    reader.close()
    return first.look()


def _mean_and_spread(sums: np.ndarray, otherwise: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Colours [n, 3] and spread [n] of sums [n, 7] of `FirstLook`; `otherwise` [3], and none, where there are none."""
    weights = sums[:, 0]
    known, total = weights > 0, np.maximum(weights, 1e-9)[:, None]
    colors = np.where(known[:, None], sums[:, 1:4] / total, otherwise)
    variance = np.where(known, np.maximum(sums[:, 4:] / total - colors**2, 0).mean(axis=1), 0.0)
    return colors, np.sqrt(variance)


def features_of(look: Look) -> torch.Tensor:
    """The first features of carriers that look like that: the logits of their colours, and what opacities lose by
    doubt; float32 [count, `GIVEN`]."""
    colors = torch.logit(torch.from_numpy(look.colors).clamp(_LEAST, 1 - _LEAST))
    return torch.cat([colors, torch.from_numpy(-_DOUBT * look.spread)[:, None]], dim=1)


@torch.no_grad()
def take_on(look: Look, features: torch.Tensor, decoder: Decoder) -> None:
    """Have the first features of each carrier be the logits of its colour and what opacity loses by doubt, and
    `decoder` hand them on; in place. All children of a carrier are alike.

    features: float32 [count, size]. It takes `LEAST_FEATURES` of these, and `LEAST_HIDDEN` units of the colour head.
    """
    features[:, :GIVEN] = features_of(look)
    hidden, out = decoder.color_hidden, decoder.color_out
    hidden.weight[:_PASSING] = 0
    hidden.bias[:_PASSING] = 0
    hidden.weight[_PASSING:, :GIVEN] = 0
    out.weight[:, :_PASSING] = 0
    out.weight[:, _PASSING:] *= _NOISE
    out.bias.zero_()
    for channel in range(_COLOR):
        for unit, sign in ((channel, 1.0), (_COLOR + channel, -1.0)):
            hidden.weight[unit, channel] = sign
            out.weight[channel::3, unit] = sign
    # What the other heads would make of these features is noise, too.
    for head in decoder.linear_heads:
        head.weight[:, :GIVEN] = 0
    decoder.opacity.weight[:, _CERTAINTY] = 1

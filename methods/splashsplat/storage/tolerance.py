"""How coarsely values may be stored: as long as rounding adds no more than a stated share to the photographs' error.

The error of a step is what it does to renders of training photographs, beside what these renders lack anyway. It grows
with about the square of the step, so that a few trials find the longest one.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from ..appearance.fitting import Drawn
from ..kernel.window_loss import WindowPhotograph

# Trials at most, once one is within the tolerance.
_TRIALS = 6
# A step that uses so much of the tolerance is near enough to the longest one.
_NEAR = 0.8
# From one trial to the next the step changes by no more.
_LEAP = 6.0


@dataclass(frozen=True)
class Trial:
    """step: of `store_values`. added: by how much its rounding raises the squared error, as a share of it. psnr: of
    the renders with it, by the photographs' masks, dB; against: the same against the renders without it."""

    step: float
    added: float
    psnr: float
    against: float


@dataclass(frozen=True)
class _Within:
    """Of a photograph, by its mask. box, mask: where that is in the window. truth: its own colours, [n, 3]. exact:
    those of the render before anything is stored, [n, 3]."""

    box: tuple[slice, slice]
    mask: Tensor
    truth: Tensor
    exact: Tensor


class Loss:
    """What renders of some photographs lose. drawn, photograph: of `Fit`; numbers: of the photographs, each of which is
    read once; exact: features and log-scales of all carriers before they are stored."""

    def __init__(
        self,
        drawn: Drawn,
        photograph: Callable[[int], WindowPhotograph],
        numbers: Sequence[int],
        exact: tuple[Tensor, Tensor],
    ) -> None:
        self._drawn, self._within = drawn, dict[int, _Within]()
        for number in numbers:
            of = photograph(number)
            truth = of.image[of.mask].to(torch.float32) / 255
            image = drawn(number, *exact, None)[of.box][of.mask].clamp(0, 1)
            self._within[number] = _Within(of.box, of.mask, truth, image)
        self._without = sum(float((each.exact - each.truth).square().sum()) for each in self._within.values())
        self._count = sum(each.truth.numel() for each in self._within.values())

    def of(self, step: float, values: tuple[Tensor, Tensor], shown: Tensor | None = None) -> Trial:
        """What is lost with `values`, which were stored with `step`. shown: float32 [count], 0 for carriers that are
        left out; None for all."""
        other, error = 0.0, 0.0
        for number, within in self._within.items():
            stored = self._drawn(number, *values, shown)[within.box][within.mask].clamp(0, 1)
            other += float((stored - within.exact).square().sum())
            error += float((stored - within.truth).square().sum())
        return Trial(step, other / max(self._without, 1e-12), self._decibels(error), self._decibels(other))

    def _decibels(self, squares: float) -> float:
        return -10 * float(torch.log10(torch.tensor(max(squares, 1e-12) / max(self._count, 1))))


def longest_step(tolerance: float, first: float, trial: Callable[[float], Trial]) -> list[Trial]:
    """Trials in the order in which they were made; the longest step among those within `tolerance` is to be taken.

    first: the step that is tried first. At least one is within the tolerance, unless a step a million times shorter is
    not.
    """
    low, high, step = 0.0, float("inf"), first
    trials: list[Trial] = []
    while len(trials) < _TRIALS or low == 0:
        found = trial(step)
        trials.append(found)
        if found.added <= tolerance:
            low = max(low, step)
            if found.added >= _NEAR * tolerance:
                break
        else:
            high = min(high, step)
        factor = (0.9 * tolerance / max(found.added, 1e-9)) ** 0.5
        step *= min(max(factor, 1 / _LEAP), _LEAP)
        if not low < step < high:
            step = (low * high) ** 0.5 if low > 0 else 0.3 * high
        if step < 1e-6 * first:
            trials.append(trial(step))
            break
    return trials

"""Where a curve of quality over cost has its knee, and what lies beyond it. Pure arithmetic on rungs.

Two definitions, each from its source:

- **price**: a rung is climbed where it gains more than `PRICE` dB for each doubling of seconds, and as much for each of
  bytes, since the last rung that was climbed. The last one climbed is the knee. No rung has a larger net quality
  PSNR - PRICE log2 seconds - PRICE log2 bytes. So a plateau between two rises is climbed where they pay together.
- **bend**: the point of maximum curvature. V. Satopaa, J. Albrecht, D. Irwin, B. Raghavan, "Finding a 'Kneedle' in a
  Haystack: Detecting Knee Points in System Behavior", ICDCS Workshops 2011: scale cost and quality to [0, 1]; the knee
  is where the curve is highest above the diagonal. Cost is log2 here.

A curve whose last rung still pays has no knee.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from math import isfinite, log2, nan
from typing import Literal

import numpy as np

#: dB that a doubling of seconds has to gain, and a doubling of bytes besides.
PRICE = 0.1
#: dB that are no change: half of what a doubling has to gain.
SAME = 0.05
#: How far above the diagonal a bend is at the least, of 1: a straight line with a tenth of noise has none.
LEAST_BEND = 0.1

Beyond = Literal["overfitting", "worse", "too dear", "plateau"]


@dataclass(frozen=True)
class Rung:
    """What a rung of the ladder costs and gives.

    Attributes:
        number: its place in the ladder, from 1 on.
        seconds: of the fit. bytes: of the model. NaN where unknown.
        test, train: PSNR in dB of test and of training views; NaN where unknown.
    """

    number: int
    seconds: float
    bytes: float
    test: float
    train: float = nan

    @property
    def usable(self) -> bool:
        """Whether it has quality and costs; a rung that failed has none."""
        return all(map(isfinite, (self.test, self.seconds, self.bytes))) and self.seconds > 0 and self.bytes > 0

    @property
    def net(self) -> float:
        """Quality less the price of its costs, dB; up to a constant."""
        return self.test - PRICE * (log2(self.seconds) + log2(self.bytes))


@dataclass(frozen=True)
class Knee:
    """What a curve says.

    Attributes:
        rung: the knee by price; None where there is none.
        rising: whether the last rung that has figures still pays.
        bend_bytes, bend_seconds: the rung of maximum curvature over either cost; None where the curve has no bend.
        beyond: what comes after the knee, up to the last rung with figures; None without a knee.
        test_change, train_change: dB from the knee to that rung; NaN where unknown.
        last: the last rung with figures; None where no rung has any.
    """

    rung: int | None
    rising: bool
    bend_bytes: int | None
    bend_seconds: int | None
    beyond: Beyond | None
    test_change: float
    train_change: float
    last: int | None


def find_knee(rungs: Sequence[Rung]) -> Knee:
    """The knee of the curve through `rungs`, in the order of the ladder. Rungs without figures are passed over."""
    curve = [rung for rung in rungs if rung.usable]
    if len(curve) < 2:
        return Knee(None, False, None, None, None, nan, nan, curve[-1].number if curve else None)
    best, last = climbed(curve), curve[-1]
    bends = bend([rung.bytes for rung in curve], curve), bend([rung.seconds for rung in curve], curve)
    if best is last:
        return Knee(None, True, *bends, None, nan, nan, last.number)
    test, train = last.test - best.test, last.train - best.train
    return Knee(best.number, False, *bends, _beyond(test, train), test, train, last.number)


def climbed(curve: Sequence[Rung]) -> Rung:
    """The last rung that pays its price, each compared with the last one before it that did."""
    best = curve[0]
    for rung in curve[1:]:
        if rung.net > best.net:
            best = rung
    return best


def bend(costs: Sequence[float], curve: Sequence[Rung]) -> int | None:
    """The number of the rung highest above the diagonal of log2 cost and quality, both scaled to [0, 1].

    None for fewer than three rungs, where cost does not rise from each to the next, where quality does not change, and
    where no rung is `LEAST_BEND` above.
    """
    if len(curve) < 3:
        return None
    places, values = np.log2(costs), np.array([rung.test for rung in curve])
    height = np.ptp(values)
    if (np.diff(places) <= 0).any() or height == 0:
        return None
    above = (values - values.min()) / height - (places - places[0]) / (places[-1] - places[0])
    highest = int(above.argmax())
    return curve[highest].number if above[highest] >= LEAST_BEND else None


def _beyond(test: float, train: float) -> Beyond:
    """What a change of `test` and `train` dB beyond the knee means. train: NaN where unknown."""
    if test < -SAME:
        return "overfitting" if train > SAME else "worse"
    return "too dear" if test > SAME else "plateau"

"""How long the appearance is fitted, and how the learning rates fall meanwhile.

A fixed schedule runs all its iterations, at full rates (the paper) or down a half cosine. An adaptive one keeps the
rates up while photographs that it withholds from the fit still get better explained, and brings them down once they do
not: a scene gets as many iterations as it can use. An earning one is a fixed one that comes to its end sooner once they
get better by less than the time is worth.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Protocol

import numpy as np

# Of the full rates, at the end.
LOWEST = 0.02
# Looks at withheld photographs that are averaged.
_LOOKS = 4


def _cosine(done: float) -> float:
    """Factor of the rates after the share `done` of their fall."""
    return LOWEST + (1 - LOWEST) * 0.5 * (1 + math.cos(math.pi * done))


@dataclass(frozen=True)
class WithheldLook:
    """How withheld photographs are explained. loss: their mean. psnr: of each, within its mask, dB: float64 [n]."""

    loss: float
    psnr: np.ndarray


class Schedule(Protocol):
    """What the fit asks before every iteration, counted from 0."""

    @property
    def withholds(self) -> bool:
        """Whether the withheld photographs are still to be left out of the fit."""

    def due(self, iteration: int) -> bool:
        """Whether the withheld photographs are to be looked at before this iteration."""

    def look(self, iteration: int, seen: WithheldLook) -> None:
        """Take note of how the withheld photographs were explained before this iteration."""

    def factor(self, iteration: int) -> float | None:
        """By how much the learning rates are multiplied; None where the fit is over."""

    def done(self, iteration: int) -> float:
        """Share of the fit that lies behind, for the progress bar."""


@dataclass(frozen=True)
class FixedSchedule:
    """`iterations`, at constant rates or down a half cosine, of which another fit made the first `begun`. withholds:
    for a fit that goes on from this one and looks at what neither has seen."""

    iterations: int
    anneal: bool
    begun: int = 0
    withholds: bool = False

    def due(self, iteration: int) -> bool:
        return False

    def look(self, iteration: int, seen: WithheldLook) -> None:
        raise AssertionError("a fixed schedule looks at nothing")

    def factor(self, iteration: int) -> float | None:
        if self.begun + iteration >= self.iterations:
            return None
        return _cosine(self.done(iteration)) if self.anneal else 1.0

    def done(self, iteration: int) -> float:
        return (self.begun + iteration) / self.iterations


@dataclass(frozen=True)
class Earned:
    """What a stretch of iterations bought. iterations: from, to. gain: of the withheld photographs' PSNR, dB, with its
    standard error over photographs. price: what it had to be. quality: PSNR at its end, dB."""

    iterations: tuple[int, int]
    quality: float
    gain: float
    standard_error: float
    price: float

    @property
    def pays(self) -> bool:
        """Whether the stretch was worth its time."""
        return self.gain > self.price


class EarningSchedule:
    """Down a half cosine over `limit` iterations, as long as withheld photographs gain what the time is worth; once
    they do not, from the rates of that moment down over half as many as there were.

    price: dB for each doubling of the time. before: iterations that would take as long as all that comes before the
    first. every: iterations between two looks at the withheld photographs; `_LOOKS` of them are averaged, and compared
    with as many before. Time is counted in iterations, so that the same fit ends at the same iteration on any machine.
    begun: of them, the first ones, that another fit made. What is asked counts from there, `earned` from the first one.
    """

    def __init__(self, limit: int, every: int, price: float, before: int, fall: float, begun: int = 0) -> None:
        self.limit, self.every, self.price, self.before, self.fall = limit, every, price, before, fall
        self.begun = begun
        self.earned: list[Earned] = []
        self._looks: list[np.ndarray] = []
        # Where the fall begins, if it does; the last moment at which it would save anything.
        self._turn: int | None = None
        self._latest = round(limit / (1 + fall))
        self._now = begun
        #: whether looks can end the fit before the limit does
        self.may_stop = begun + 2 * _LOOKS * every < self._latest

    @property
    def withholds(self) -> bool:
        return self.may_stop and self._turn is None and self._now < self._latest

    def due(self, iteration: int) -> bool:
        return self.withholds and iteration > 0 and iteration % self.every == 0

    def look(self, iteration: int, seen: WithheldLook) -> None:
        iteration += self.begun
        self._looks.append(seen.psnr)
        if len(self._looks) < 2 * _LOOKS:
            return
        before, now = (np.mean(part, axis=0) for part in (self._looks[-2 * _LOOKS : -_LOOKS], self._looks[-_LOOKS:]))
        gains = now - before
        stretch = _LOOKS * self.every
        price = self.price * math.log2((iteration + self.before) / (iteration - stretch + self.before))
        error = float(gains.std(ddof=1) / math.sqrt(len(gains))) if len(gains) > 1 else 0.0
        found = Earned((iteration - stretch, iteration), float(now.mean()), float(gains.mean()), error, price)
        self.earned.append(found)
        if not found.pays:
            self._turn = iteration

    def factor(self, iteration: int) -> float | None:
        iteration += self.begun
        self._now = iteration
        if iteration >= self._end:
            return None
        if self._turn is None:
            return _cosine(iteration / self.limit)
        left = _cosine((iteration - self._turn) / (self._end - self._turn)) - LOWEST
        return LOWEST + left * (_cosine(self._turn / self.limit) - LOWEST) / (1 - LOWEST)

    def done(self, iteration: int) -> float:
        return (self.begun + iteration) / self._end

    @property
    def _end(self) -> int:
        return self.limit if self._turn is None else min(self.limit, max(round((1 + self.fall) * self._turn), 1))


@dataclass(frozen=True)
class Clock:
    """seconds: of the fit so far. end: when the appearance has to be done."""

    seconds: Callable[[], float]
    end: float


class TimedSchedule:
    """Down a half cosine until `clock` has run out, or `limit` iterations were made, whichever comes first."""

    withholds = False

    def __init__(self, limit: int, clock: Clock) -> None:
        self.limit, self._clock = limit, clock
        self._start = clock.seconds()

    def due(self, iteration: int) -> bool:
        return False

    def look(self, iteration: int, seen: WithheldLook) -> None:
        raise AssertionError("a schedule by the clock looks at nothing")

    def factor(self, iteration: int) -> float | None:
        done = self.done(iteration)
        return _cosine(done) if done < 1 else None

    def done(self, iteration: int) -> float:
        whole = max(self._clock.end - self._start, 1e-6)
        return min(max((self._clock.seconds() - self._start) / whole, iteration / max(self.limit, 1)), 1.0)


class AdaptiveSchedule:
    """Full rates until withheld photographs stop gaining, then a half cosine over a share of the iterations so far.

    limit: iterations at most, both parts together. every: iterations between two looks at the withheld photographs.
    gain: by what share their mean loss over four looks has to be below that of the four looks before, to go on. fall:
    length of the second part, as a share of the first.

    Where `limit` leaves no room for looks that could end the first part, there are none, and nothing is withheld.
    """

    def __init__(self, limit: int, every: int, gain: float, fall: float) -> None:
        self.limit, self.every, self.gain, self.fall = limit, every, gain, fall
        self.losses: list[float] = []
        self._turn = int(limit / (1 + fall))
        self._turned = False
        #: whether looks can end the first part before the limit does
        self.may_stop = 2 * _LOOKS * every < self._turn

    @property
    def withholds(self) -> bool:
        return self.may_stop and not self._turned

    def due(self, iteration: int) -> bool:
        return self.withholds and iteration > 0 and iteration % self.every == 0

    def look(self, iteration: int, seen: WithheldLook) -> None:
        self.losses.append(seen.loss)
        # At full rates a look is off by some per cent either way: single ones ended fits that still gained.
        before, now = self.losses[-2 * _LOOKS : -_LOOKS], self.losses[-_LOOKS:]
        if len(before) == _LOOKS and sum(now) > (1 - self.gain) * sum(before):
            self._turn = min(self._turn, iteration)

    def factor(self, iteration: int) -> float | None:
        if iteration >= self._end:
            return None
        self._turned = iteration >= self._turn
        return _cosine((iteration - self._turn) / (self._end - self._turn)) if self._turned else 1.0

    def done(self, iteration: int) -> float:
        return iteration / self._end

    @property
    def _end(self) -> int:
        return min(self.limit, max(self._turn + 1, round((1 + self.fall) * self._turn)))


def withheld(count: int, share: float, rng: np.random.Generator) -> np.ndarray:
    """Which of `count` photographs are withheld, bool [count]: `share` of them, at least 8; none where that would be
    more than a tenth, or `share` is 0."""
    chosen = np.zeros(count, dtype=bool)
    number = max(8, round(share * count))
    if share > 0 and number <= count / 10:
        chosen[rng.choice(count, number, replace=False)] = True
    return chosen

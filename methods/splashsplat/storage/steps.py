"""In which steps a fitted appearance is stored, and which carriers: decisions, with their evidence.

The longest steps within a tolerance are the rule. Where a budget leaves less room, carriers that photographs change
least with are left out, and steps are as long as the rest asks for: of some shares left out, the one whose renders are
nearest to the photographs.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import torch

from splashbench.harness.contract import Decision, Rung

from ..appearance.fitting import Appearance, Fit
from .packing import packed_bytes
from .tolerance import Loss, Trial, longest_step
from .values import StoredValues, read_values, store_values, typical_coefficient

# Photographs that are rendered for every trial.
_PHOTOGRAPHS = 12
# By how much rounding may raise the largest log-scale, so that it is worth a render.
_GROWN = 3.0
# The first step that is tried is so many times shorter than a typical coefficient is long.
_FIRST = 4
# Shares of the carriers that may be left out for a budget.
_LEFT_OUT = (0.0, 0.15, 0.3, 0.45, 0.6, 0.75, 0.85, 0.92, 0.96, 0.98)
# Halvings of the interval in which the step for a size is sought, and how many times longer than the tolerance's it is
# at the most.
_HALVINGS, _LONGEST = 7, 4096.0


@dataclass(frozen=True)
class Stored:
    """What is to be stored: the carriers `kept` (bool [count]), their values in steps of `step` (`store_values`)."""

    kept: np.ndarray
    step: float


class Storage:
    """A fitted appearance whose carriers `kept` (bool [count]) are to be stored. fit: of it, with its sensitivity."""

    def __init__(self, appearance: Appearance, kept: np.ndarray, fit: Fit, seed: int) -> None:
        assert fit.sensitivity is not None
        self._known, self._kept = fit.sensitivity, kept
        self._exact = appearance.features, appearance.log_scales
        self._scratch = self._exact[0].clone(), self._exact[1].clone()
        rng = np.random.default_rng([seed, 6])
        self._photographs = sorted(rng.permutation(fit.photographs)[:_PHOTOGRAPHS].tolist())
        self._loss = Loss(fit.drawn, fit.photograph, self._photographs, self._exact)

    def within_tolerance(self, tolerance: float) -> tuple[Stored, Decision]:
        """The longest step whose rounding adds no more than `tolerance` to the squared error in some training
        photographs, as a share of it; and how it was found."""
        rows = np.flatnonzero(self._kept)
        first = max(typical_coefficient(self._learned(rows), self._known.kept(rows)), 1e-9) / _FIRST
        trials = longest_step(tolerance, first, lambda step: self._trial(Stored(self._kept, step))) if len(rows) else []
        within = [found for found in trials if found.added <= tolerance]
        shortest = min((found.step for found in trials), default=first)
        step = max((found.step for found in within), default=shortest)
        added = next((found.added for found in trials if found.step == step), 0.0)
        rungs = [
            Rung(
                value=f"{found.step:.3g}",
                bought=found.step == step,
                quality=found.against if math.isfinite(found.added) else None,
                reason=f"adds {100 * found.added:.2g} % to the squared error",
            )
            for found in trials
        ]
        return Stored(self._kept, step), Decision(
            name="steps of stored values",
            basis="tolerance",
            chosen=f"{step:.3g}",
            because=f"the longest that adds at most {100 * tolerance:g} % to the squared error in "
            f"{len(self._photographs)} training photographs ({100 * added:.2g} %)",
            measure="PSNR against renders before rounding, dB",
            rungs=rungs,
        )

    def within_room(
        self, room: int, tolerated: Stored, other_bytes: Callable[[np.ndarray], int]
    ) -> tuple[Stored, Decision | None]:
        """What fits into `room` bytes; `tolerated`, and no decision, where that does.

        other_bytes: of all that is stored but the values, given the carriers that are kept.
        """
        full = other_bytes(self._kept) + self._value_bytes(tolerated)
        if full <= room:
            return tolerated, None
        order = np.argsort(np.where(self._kept, self._known.carriers, -1.0), kind="stable")
        gone, count = int((~self._kept).sum()), int(self._kept.sum())
        tried: list[tuple[float, int, Stored, Trial]] = []
        for share in _LEFT_OUT:
            kept = self._kept.copy()
            kept[order[gone : gone + round(share * count)]] = False
            others = other_bytes(kept)
            found = self._step_for(room - others, Stored(kept, tolerated.step))
            if found is None:
                continue
            trial = self._trial(found)
            tried.append((share, others + self._value_bytes(found), found, trial))
            if len(tried) > 2 and trial.psnr < tried[-2][3].psnr < tried[-3][3].psnr:
                break
        if not tried:
            kept = np.zeros_like(self._kept)
            tried.append((1.0, other_bytes(kept), Stored(kept, tolerated.step), Trial(tolerated.step, math.inf, 0, 0)))
        best = max(tried, key=lambda one: one[3].psnr)
        return best[2], Decision(
            name="carriers and steps for the budget",
            basis="budget",
            chosen=f"{100 * (1 - best[0]):.0f} % of the carriers",
            because=f"{full / 1e6:.2f} MB are to fit into {room / 1e6:.2f} MB beside the background",
            measure="PSNR in training photographs, dB",
            rungs=[
                Rung(
                    value=f"{100 * (1 - share):.0f} % of the carriers, steps of {stored.step:.3g}",
                    bought=stored is best[2],
                    quality=trial.psnr,
                    bytes=size - full,
                )
                for share, size, stored, trial in tried
            ],
        )

    def _step_for(self, room: int, start: Stored) -> Stored | None:
        """The shortest step, not below that of `start`, whose values fit into `room` bytes; None where none does."""
        longest = Stored(start.kept, _LONGEST * start.step)
        if self._value_bytes(longest) > room:
            return None
        if self._value_bytes(start) <= room:
            return start
        low, high = start.step, longest.step
        for _ in range(_HALVINGS):
            middle = math.sqrt(low * high)
            if self._value_bytes(Stored(start.kept, middle)) <= room:
                high = middle
            else:
                low = middle
        return Stored(start.kept, high)

    def _learned(self, rows: np.ndarray) -> np.ndarray:
        """Values of some carriers, made anew each time: those of all are among the largest arrays of a fit."""
        return np.concatenate([table.numpy()[rows] for table in self._exact], axis=1)

    def _coded(self, stored: Stored) -> StoredValues:
        rows = np.flatnonzero(stored.kept)
        return store_values(self._learned(rows), self._known.kept(rows), stored.step)

    def _value_bytes(self, stored: Stored) -> int:
        return packed_bytes(self._coded(stored).arrays)

    def _trial(self, stored: Stored) -> Trial:
        read = torch.from_numpy(read_values(self._coded(stored)))
        rows = np.flatnonzero(stored.kept)
        # Carriers that are not kept are not shown, or left out of the photographs by the fit.
        features, scales = self._scratch
        size = features.shape[1]
        features[rows], scales[rows] = read[:, :size], read[:, size:]
        if float(scales.max()) > float(self._exact[1].max()) + _GROWN:
            return Trial(stored.step, math.inf, 0.0, 0.0)  # no renderer takes such Gaussians
        shown = None if stored.kept is self._kept else torch.from_numpy(stored.kept.astype(np.float32))
        return self._loss.of(stored.step, (features, scales), shown)

"""How long the steps are in which a fitted appearance is stored: a decision, with its evidence."""

from __future__ import annotations

import math

import numpy as np
import torch

from splashbench.harness.contract import Decision, Rung

from ..appearance.fitting import Appearance, Fit
from .looks import learned_values
from .tolerance import Loss, Trial, longest_step
from .values import StoredValues, read_values, store_values, typical_coefficient

# Photographs that are rendered for every trial.
_PHOTOGRAPHS = 12
# By how much rounding may raise the largest log-scale, so that it is worth a render.
_GROWN = 3.0
# The first step that is tried is so many times shorter than a typical coefficient is long.
_FIRST = 4


def storage_step(
    appearance: Appearance, kept: np.ndarray, fit: Fit, tolerance: float, seed: int
) -> tuple[float, Decision]:
    """The longest step for `store_values` whose rounding adds no more than `tolerance` to the squared error in some
    training photographs, as a share of it; and how it was found.

    kept: bool [count], the carriers that are stored. fit: of the appearance, with its sensitivity.
    """
    assert fit.sensitivity is not None
    rows = np.flatnonzero(kept)
    values, known = learned_values(appearance)[rows], fit.sensitivity.kept(rows)
    exact = appearance.features, appearance.log_scales
    size = appearance.features.shape[1]
    rng = np.random.default_rng([seed, 6])
    numbers = sorted(rng.permutation(fit.photographs)[:_PHOTOGRAPHS].tolist())
    loss = Loss(fit.drawn, numbers, exact)

    def tables(stored: StoredValues) -> tuple[torch.Tensor, torch.Tensor]:
        read = torch.from_numpy(read_values(stored))
        features, scales = exact[0].clone(), exact[1].clone()
        features[rows], scales[rows] = read[:, :size], read[:, size:]
        return features, scales

    def trial(step: float) -> Trial:
        features, scales = tables(store_values(values, known, step))
        if float(scales.max()) > float(exact[1].max()) + _GROWN:
            return Trial(step, math.inf, 0.0, 0.0)  # no renderer takes such Gaussians
        return loss.of(step, (features, scales))

    first = max(typical_coefficient(values, known), 1e-9) / _FIRST
    trials = longest_step(tolerance, first, trial) if len(rows) else [Trial(first, 0.0, 0.0, 0.0)]
    within = [found for found in trials if found.added <= tolerance]
    best = max(within, key=lambda found: found.step) if within else min(trials, key=lambda found: found.step)
    rungs = [
        Rung(
            value=f"{found.step:.3g}",
            bought=found is best,
            quality=found.against,
            reason=f"adds {100 * found.added:.2g} % to the squared error",
        )
        for found in trials
    ]
    return best.step, Decision(
        name="steps of stored values",
        basis="tolerance",
        chosen=f"{best.step:.3g}",
        because=f"the longest that adds at most {100 * tolerance:g} % to the squared error in {len(numbers)} training "
        f"photographs ({100 * best.added:.2g} %)",
        measure="PSNR against renders before rounding, dB",
        rungs=rungs,
    )

"""The deviations of a placement, by leaving out one camera at a time."""

from __future__ import annotations

import numpy as np
import pytest

from splashbench.container.outline_fit import OutlineFit, jackknife
from splashbench.container.stance import Stance


def fit_of(slopes: np.ndarray) -> OutlineFit:
    """A fit in which every camera asks for a step of its own with the same weight: the estimate is their mean."""
    stance = Stance(1.0, np.eye(3), np.zeros(3))
    return OutlineFit(stance, 0.1, np.stack([np.eye(7)] * len(slopes)), slopes)


def test_the_jackknife_of_a_mean_is_its_standard_error() -> None:
    slopes = np.random.default_rng(0).normal(size=(6, 7))
    position, tilt = jackknife(fit_of(slopes), range(6), length=2.0, axis="y")
    errors = slopes.std(axis=0, ddof=1) / np.sqrt(6)
    assert position == pytest.approx(np.linalg.norm(errors[:3]))
    # A turn about the vertical axis is no tilt; rotations are measured over `length`.
    assert tilt == pytest.approx(np.rad2deg(np.linalg.norm(errors[[3, 5]]) / 2.0))


def test_two_cameras_tell_no_deviation() -> None:
    assert jackknife(fit_of(np.ones((2, 7))), range(6), length=1.0, axis="y") == (None, None)

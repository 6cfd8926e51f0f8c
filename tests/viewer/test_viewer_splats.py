"""Gaussians reach the browser whole: in 16-bit floats, the most visible ones, and none that are no numbers."""

from __future__ import annotations

import numpy as np
import pytest

from splashbench.scene import Gaussians
from splashbench.viewer.splats import most_visible, pack, sound, unit_of

from .conftest import gaussians_of


def turned(number: int, deviations: tuple[float, float, float], seed: int = 3) -> Gaussians:
    """Gaussians with these standard deviations along axes of their own."""
    rng = np.random.default_rng(seed)
    turns = np.linalg.qr(rng.normal(size=(number, 3, 3)))[0]
    base = gaussians_of(number)
    return Gaussians(base.means, turns * np.array(deviations), base.opacities, base.colors)


def through_half_floats(gaussians: Gaussians, scale: float) -> np.ndarray:
    """The covariances that the browser draws, in scene units: through its 16-bit floats."""
    packed = pack(gaussians, scale, most=10**6)
    return packed.covariances.astype(np.float16).astype(np.float64) * scale**2


def test_small_covariances_survive_the_format() -> None:
    liquid = turned(200, (6e-4, 4e-4, 2e-4))
    exact = liquid.covariances.astype(np.float64)
    size = np.abs(exact).max(axis=(1, 2), keepdims=True)
    assert (np.abs(through_half_floats(liquid, unit_of(liquid)) - exact) / size).max() < 1e-3
    # In scene units they would not.
    assert (np.abs(through_half_floats(liquid, 1.0) - exact) / size).max() > 0.05


def test_the_unit_is_a_power_of_two_and_places_come_back_exactly() -> None:
    liquid = turned(50, (0.3, 0.01, 0.001))
    unit = unit_of(liquid)
    assert np.log2(unit) == round(np.log2(unit))
    packed = pack(liquid, unit, most=100)
    assert packed.scale == unit
    np.testing.assert_array_equal(packed.centers * np.float32(unit), liquid.means)


def test_what_is_too_large_for_the_format_is_cut_to_it() -> None:
    small = turned(5, (0.01, 0.01, 0.01))
    huge = turned(5, (1e6, 1.0, 1.0))
    packed = pack(huge, unit_of(small), most=10)
    assert np.isfinite(packed.covariances.astype(np.float16)).all()


def test_beside_a_huge_one_the_others_stay() -> None:
    liquid = turned(200, (6e-4, 4e-4, 2e-4))
    liquid.factors[7] = np.eye(3) * 1e4
    exact = np.delete(liquid.covariances.astype(np.float64), 7, axis=0)
    drawn = through_half_floats(liquid, unit_of(liquid))
    assert np.isfinite(drawn).all()
    size = np.abs(exact).max(axis=(1, 2), keepdims=True)
    assert (np.abs(np.delete(drawn, 7, axis=0) - exact) / size).max() < 1e-3


def test_covariances_that_are_no_numbers_are_left_out() -> None:
    broken = gaussians_of(3)
    broken.factors[1] = np.eye(3) * 1e30  # a number, and its square is none
    kept = sound(broken)
    assert len(kept) == 2
    broken.factors[1] = np.eye(3) * 1e19  # its square is one just so
    assert np.isfinite(pack(sound(broken), 1e-6, 10).covariances.astype(np.float16)).all()


def test_the_most_visible_are_kept_in_their_order() -> None:
    base = gaussians_of(6)
    sizes = np.array([1.0, 3.0, 1.0, 2.0, 1.0, 5.0])
    opacities = np.array([0.9, 0.01, 0.1, 0.9, 0.8, 0.5])
    mixed = Gaussians(base.means, np.eye(3) * sizes[:, None, None], opacities, base.colors)  # type: ignore[arg-type]
    # opacity times variance: .9, .09, .1, 3.6, .8, 12.5
    assert most_visible(mixed, 3).tolist() == [0, 3, 5]
    packed = pack(mixed, 1.0, most=3)
    np.testing.assert_array_equal(packed.centers, mixed.means[[0, 3, 5]])
    assert packed.left_out == 3


def test_what_is_no_number_is_left_out() -> None:
    broken = gaussians_of(6)
    broken.means[1, 2], broken.opacities[3], broken.colors[4, 0] = np.nan, np.inf, np.nan
    broken.factors[5, 0, 0] = np.nan
    assert len(sound(broken)) == 2
    whole = gaussians_of(4)
    assert sound(whole) is whole


def test_colours_and_opacities_are_rounded_and_clipped() -> None:
    base = gaussians_of(2)
    colors = np.array([[-0.2, 0.5, 1.7], [0.001, 0.0, 1.0]])
    packed = pack(Gaussians(base.means, base.factors, np.array([0.25, 2.0]), colors), 1.0, 10)  # type: ignore[arg-type]
    assert packed.colors.tolist() == [[0, 128, 255], [0, 0, 255]]
    assert packed.opacities.tolist() == [[64], [255]]


def test_padding_is_invisible_and_in_the_middle() -> None:
    packed = pack(gaussians_of(3), 1.0, 10).padded(5)
    assert len(packed) == 5
    assert packed.opacities[3:].tolist() == [[0], [0]]
    np.testing.assert_allclose(packed.centers[4], packed.centers[:3].mean(axis=0), atol=1e-6)
    with pytest.raises(ValueError, match="more than 2"):
        packed.padded(2)


def test_nothing_at_all_has_a_unit_and_can_be_padded() -> None:
    nothing = Gaussians.none()
    assert unit_of(nothing) == 1.0
    assert len(pack(nothing, 1.0, 10).padded(1)) == 1

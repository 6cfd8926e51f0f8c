"""A liquid dyed anew against the same liquid with that dye; and what has to stay as it was."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from splashbench.dyes import DYES, Dye, dye_named
from splashbench.errors import SplashbenchError
from splashbench.harness.contract import Render
from splashbench.replay import Reconstruction
from splashbench.restyle import FilmedDye, filmed_dye, restyled
from splashbench.scene import Camera
from splashbench.srgb import to_linear, to_srgb

from .conftest import OPAQUE, ROOM, Ball, of


def psnr(a: np.ndarray, b: np.ndarray, mask: np.ndarray) -> float:
    return float(-10 * np.log10(np.mean((a - b)[mask] ** 2) + 1e-12))


def known(dye: Dye, opaque: bool = False) -> FilmedDye:
    nothing = np.full(3, np.inf)
    absorption = nothing if opaque else dye.absorption.astype(float)
    interval = np.stack([absorption, absorption])
    return FilmedDye(absorption, interval, dye.albedo.astype(float), ROOM, 1.0, opaque, 0.1)


def compared(before: Ball, after: Ball, found: FilmedDye | None = None, **options: float) -> tuple[float, float]:
    """dB within the liquid of a test view against `after`: of `before` as it is, and dyed as `after`."""
    filmed, other = of(before), of(after)
    made = restyled(filmed, after.dye, filmed=found, **options).render("3", 0.1)
    truth = other.render("3", 0.1)
    liquid = truth.alpha > 0
    return psnr(filmed.render("3", 0.1).rgb, truth.rgb, liquid), psnr(made.rgb, truth.rgb, liquid)


@pytest.mark.parametrize("name", ["amber", "green", "clear", "#804020"])
def test_another_dye_comes_out_as_that_dye_does(blue: Dye, name: str) -> None:
    left, dyed = compared(Ball(blue, gloss=0.4), Ball(dye_named(name), gloss=0.4))
    assert dyed > left + 8
    assert dyed > 25


def test_with_the_dye_it_has_it_stays(blue: Dye) -> None:
    _, dyed = compared(Ball(blue, gloss=0.4), Ball(blue, gloss=0.4), known(blue))
    assert dyed > 40


def test_an_opaque_liquid_takes_another_color(blue: Dye) -> None:
    brown = Dye(DYES["brown"].albedo, OPAQUE)
    left, dyed = compared(Ball(Dye(blue.albedo, OPAQUE)), Ball(brown), density=np.inf)
    assert dyed > left + 10


def test_an_opaque_liquid_turned_clear_shows_what_lies_behind_it(blue: Dye) -> None:
    left, dyed = compared(Ball(Dye(blue.albedo, OPAQUE)), Ball(DYES["clear"], index=1.333))
    assert dyed > left + 5


def test_the_background_stays_to_the_last_bit(blue: Dye) -> None:
    filmed = of(Ball(blue))
    before, after = filmed.render("3", 0.1), restyled(filmed, DYES["green"]).render("3", 0.1)
    outside = before.alpha == 0
    np.testing.assert_allclose(after.rgb[outside], before.rgb[outside], atol=1e-6)
    np.testing.assert_array_equal(after.alpha, before.alpha)


def test_more_density_is_darker_until_it_is_opaque(blue: Dye) -> None:
    filmed = of(Ball(blue))
    found = filmed_dye(filmed)
    liquid = filmed.render("3", 0.1).alpha > 0
    red = [restyled(filmed, DYES["blue"], d, filmed=found).render("3", 0.1).rgb[liquid, 0].mean() for d in (0.2, 1, 5)]
    assert red[0] > red[1] > red[2]
    thick = restyled(filmed, DYES["blue"], 1e4, filmed=found).render("3", 0.1).rgb
    np.testing.assert_allclose(
        restyled(filmed, DYES["blue"], np.inf, filmed=found).render("3", 0.1).rgb, thick, atol=0.02
    )


def test_without_a_scale_the_longest_way_counts_as_25_mm(blue: Dye) -> None:
    filmed, unscaled = of(Ball(blue)), of(Ball(blue), metres_per_unit=None)
    found = filmed_dye(filmed)
    as_if = 0.025 / found.longest
    dyed = restyled(unscaled, DYES["green"], filmed=found).render("3", 0.1).rgb
    expected = restyled(filmed, DYES["green"].times(as_if), filmed=found).render("3", 0.1).rgb
    np.testing.assert_allclose(dyed, expected, atol=1e-5)


def test_it_is_a_reconstruction_like_any_other(blue: Dye) -> None:
    dyed = restyled(of(Ball(blue)), DYES["green"])
    assert isinstance(dyed, Reconstruction)
    assert dyed.surface(0.1) is not None
    assert dyed.empty_view("3") is not None
    assert dyed.velocity(0.1) is None
    assert dyed.particles() is None


@pytest.mark.parametrize(("density", "light"), [(-1, 1), (float("nan"), 1), (1, 0), (1, float("inf"))])
def test_impossible_numbers_are_refused(blue: Dye, density: float, light: float) -> None:
    with pytest.raises(ValueError, match="density"):
        restyled(of(Ball(blue)), DYES["green"], density, light, replace(known(blue)))


@pytest.mark.parametrize("name", ["purple", "#12345", "#12345g", "", "#" + "0" * 100])
def test_a_dye_that_is_none_is_named(name: str) -> None:
    with pytest.raises(SplashbenchError, match="there is no dye"):
        dye_named(name)


def test_a_color_is_what_comes_through_25_mm() -> None:
    from splashbench.srgb import to_srgb

    dye = dye_named("#c08040")
    np.testing.assert_allclose(to_srgb(np.exp(-dye.absorption * 0.025)) * 255, [0xC0, 0x80, 0x40], atol=1)
    assert (dye_named("#ffffff").absorption >= 0).all()
    assert np.isfinite(dye_named("#000000").absorption).all()


def test_what_was_filmed_does_not_stay_where_the_liquid_covers_half_a_pixel(blue: Dye) -> None:
    class Half(Ball):
        def render(self, camera: Camera, time: float) -> Render:
            made, behind = super().render(camera, time), self.empty_view(camera)
            light = 0.5 * to_linear(made.rgb) + 0.5 * to_linear(behind)
            return Render(to_srgb(light), 0.5 * made.alpha)

    thick, brown = Dye(blue.albedo, OPAQUE), Dye(DYES["brown"].albedo, OPAQUE)
    _, dyed = compared(Half(thick), Half(brown), known(thick, opaque=True), density=np.inf)
    assert dyed > 35


def test_clear_water_is_not_made_opaque(blue: Dye) -> None:
    with pytest.raises(SplashbenchError, match="cannot be opaque"):
        restyled(of(Ball(blue)), DYES["clear"], np.inf)

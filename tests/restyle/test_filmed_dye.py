"""The dye that was filmed, found where it is known: clear, opaque, bending light, with highlights."""

from __future__ import annotations

import numpy as np
import pytest

from splashbench.dyes import Dye
from splashbench.errors import SplashbenchError
from splashbench.restyle import filmed_dye

from .conftest import OPAQUE, Ball, of


@pytest.mark.parametrize("gloss", [0.0, 0.5])
def test_a_clear_dye_is_found(blue: Dye, gloss: float) -> None:
    found = filmed_dye(of(Ball(blue, gloss=gloss)))
    assert not found.opaque
    assert found.index == 1
    np.testing.assert_allclose(found.absorption, blue.absorption, rtol=0.25)
    assert (found.interval[0] <= found.absorption).all()
    assert (found.interval[1] >= found.absorption).all()
    # Red is absorbed on the way: what comes back of it is seen.
    assert found.returned[0] == pytest.approx(blue.albedo[0], abs=0.03)


def test_that_light_is_bent_is_seen(blue: Dye) -> None:
    found = filmed_dye(of(Ball(blue, index=1.333)))
    assert found.index == 1.333
    np.testing.assert_allclose(found.absorption, blue.absorption, rtol=0.25)


def test_an_opaque_dye_is_told_as_such(blue: Dye) -> None:
    found = filmed_dye(of(Ball(Dye(blue.albedo, OPAQUE))))
    assert found.opaque
    assert np.isinf(found.absorption).all()
    assert np.isinf(found.interval[1]).all()
    assert np.isfinite(found.interval[0]).all()
    np.testing.assert_allclose(found.returned, blue.albedo, atol=0.02)


def test_water_is_no_opaque_liquid() -> None:
    found = filmed_dye(of(Ball(Dye(np.zeros(3, np.float32), np.array([0.3, 0.1, 0.01], np.float32)))))
    assert not found.opaque
    assert (found.absorption < 3).all()


def test_what_light_needs_is_asked_for(blue: Dye) -> None:
    class NoSurface(Ball):
        def surface(self, time: float) -> None:  # type: ignore[override]
            return None

    class NoBackground(Ball):
        def empty_view(self, camera: object) -> None:  # type: ignore[override]
            return None

    class Nowhere(Ball):
        def render(self, camera, time):  # type: ignore[no-untyped-def]
            made = super().render(camera, time)
            made.alpha[:] = 0
            return made

    for fitted, said in (
        (NoSurface(blue), "no surface"),
        (NoBackground(blue), "no background"),
        (Nowhere(blue), "too little"),
    ):
        with pytest.raises(SplashbenchError, match=said):
            filmed_dye(of(fitted))

"""Small faint Gaussians, which the browser would leave out, are merged: what is seen stays what it was."""

from __future__ import annotations

import numpy as np
import pytest

from splashbench.render import rasterize_arrays
from splashbench.scene import Camera, Gaussians, look_at
from splashbench.viewer.merging import Lookout, merged

SIZE, FOCAL = (160, 120), 150.0
EYE = np.array([0.0, 0.3, 2.0])
LOOKOUT = Lookout(EYE, 1 / FOCAL)


def cloud(number: int = 20_000, deviation: float = 0.004, opacity: float = 0.15) -> Gaussians:
    """A dense ball of faint Gaussians, a third of a pixel wide, bluer to the right."""
    rng = np.random.default_rng(2)
    means = rng.normal(0, 0.12, (number, 3))
    colors = np.stack([0.5 - means[:, 0], np.full(number, 0.3), 0.5 + means[:, 0]], axis=1)
    turns = np.linalg.qr(rng.normal(size=(number, 3, 3)))[0] * [deviation, deviation, 0.3 * deviation]
    return Gaussians(means, turns, np.full(number, opacity), np.clip(colors, 0, 1))  # type: ignore[arg-type]


def camera() -> Camera:
    K = np.array([[FOCAL, 0, SIZE[0] / 2], [0, FOCAL, SIZE[1] / 2], [0, 0, 1]])
    return Camera("eye", *SIZE, K, look_at(EYE))


def drawn(gaussians: Gaussians, like_the_browser: bool = False) -> np.ndarray:
    """The picture; `like_the_browser`: without those that its shader leaves out."""
    if like_the_browser:
        view = camera()
        local = gaussians.means @ view.w2c[:3, :3].T + view.w2c[:3, 3]
        x, y, z = local.T
        J = np.zeros((len(z), 2, 3))
        J[:, 0, 0], J[:, 1, 1] = FOCAL / z, FOCAL / z
        J[:, 0, 2], J[:, 1, 2] = -FOCAL * x / z**2, -FOCAL * y / z**2
        A = J @ view.w2c[:3, :3]
        screen = A @ gaussians.covariances @ A.transpose(0, 2, 1) + 0.3 * np.eye(2)
        gaussians = gaussians.kept(gaussians.opacities * np.linalg.det(screen) >= 0.25)
    parts = (gaussians.means, gaussians.factors, gaussians.opacities, gaussians.colors)
    return rasterize_arrays(*parts, camera(), background=np.ones(3))[0]


def decibels(a: np.ndarray, b: np.ndarray) -> float:
    return float(-10 * np.log10(((a - b) ** 2).mean()))


def test_the_browser_leaves_out_the_cloud_but_not_the_merged_one() -> None:
    whole = drawn(cloud())
    few = merged(cloud(), LOOKOUT)
    assert len(few) < len(cloud()) / 4
    # Almost nothing of the cloud itself would be seen; merged, it is there.
    assert decibels(drawn(cloud(), like_the_browser=True), whole) < 20
    assert decibels(drawn(few, like_the_browser=True), whole) > 30


def test_what_is_large_enough_stays_bit_for_bit() -> None:
    large = cloud(300, deviation=0.05, opacity=0.5)
    same = merged(large, LOOKOUT)
    for name in ("means", "factors", "opacities", "colors"):
        np.testing.assert_array_equal(getattr(same, name), getattr(large, name))


def test_from_nearer_there_are_more() -> None:
    counts = [len(merged(cloud(), Lookout(EYE * k, 1 / FOCAL))) for k in (0.25, 1.0, 4.0)]
    assert counts == sorted(counts, reverse=True)
    assert len(set(counts)) == 3


def test_two_in_a_cell_become_one_with_their_moments() -> None:
    pair = Gaussians(
        np.array([[0.0, 0.0, 0.0], [0.004, 0.0, 0.0]]),  # type: ignore[arg-type]
        np.tile(np.eye(3) * 0.002, (2, 1, 1)),  # type: ignore[arg-type]
        np.array([0.1, 0.1]),  # type: ignore[arg-type]
        np.array([[1.0, 0, 0], [0, 0, 1.0]]),  # type: ignore[arg-type]
    )
    # Far enough for both to be well within a cell, whose border is at 0: moved off it.
    pair.means += np.float32(0.011)
    (one,) = [merged(pair, LOOKOUT)]
    assert len(one) == 1
    np.testing.assert_allclose(one.means[0], [0.013, 0.011, 0.011], atol=1e-6)
    np.testing.assert_allclose(one.covariances[0], np.diag([8e-6, 4e-6, 4e-6]), rtol=1e-4, atol=1e-10)
    np.testing.assert_allclose(one.colors[0], [0.5, 0, 0.5], atol=1e-6)
    # Covered pixels times optical depth is what the two had. A pixel is .0132 units wide there.
    pixel = float(LOOKOUT.pixel(one.means)[0])
    before = np.sqrt((4 * 4 + 4 * 4 + 4 * 4) / 3) * 1e-6 / pixel**2 + 0.3
    after = np.sqrt((8 * 4 + 8 * 4 + 4 * 4) / 3) * 1e-6 / pixel**2 + 0.3
    assert one.opacities[0] == pytest.approx(1 - np.exp(2 * np.log(0.9) * before / after), rel=1e-3)


def test_nothing_and_one_alone() -> None:
    assert len(merged(Gaussians.none(), LOOKOUT)) == 0
    assert len(merged(cloud(1), LOOKOUT)) == 1


def test_opaque_and_flat_ones_make_no_trouble() -> None:
    discs = cloud(500, opacity=1.0)
    discs.factors[..., 2] = 0
    few = merged(discs, LOOKOUT)
    for name in ("means", "factors", "opacities", "colors"):
        assert np.isfinite(getattr(few, name)).all()
    assert few.opacities.max() <= 1

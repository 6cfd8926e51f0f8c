"""A jet's speed, by its shape, its first drop and its beads; and what of a hull is a jet."""

from __future__ import annotations

import numpy as np
import pytest

from splashbench.scene.camera import Camera, look_at
from splashbench_methods.splashsplat.fields import jet as jet_module
from splashbench_methods.splashsplat.fields.jet import Slices, fit_jets, framed, open_floor, slices_of
from splashbench_methods.splashsplat.fields.vessel import upright

G = 9.81
VOXEL = 0.005


def falling(speed: float, drift: float, flow: float = 6e-4, wander: float = 0.0, n_frames: int = 9) -> list[Slices]:
    """Slices of a jet that passes height 0.3 with `speed` down, `drift` sideways, and carries `flow` m^3/s."""
    frames = []
    for t in range(n_frames):
        height = (np.arange(20, 60) + 0.5) * VOXEL
        down = np.sqrt(speed**2 + 2 * G * (0.3 - height))
        fall = (down - speed) / G
        middle = np.stack([0.01 + wander * t + drift * fall, -0.02 + 0 * fall], axis=1)
        rng = np.random.default_rng(t)
        middle += rng.normal(0, 0.1 * VOXEL, middle.shape)
        area = flow / down * np.exp(rng.normal(0, 0.05, len(height)))
        frames.append(Slices(height, middle, area))
    return frames


@pytest.mark.parametrize("wander", [0.0, 0.001])
@pytest.mark.parametrize(("speed", "drift"), [(1.0, 0.35), (0.5, 0.2), (2.0, 0.6)])
def test_a_jets_speed_follows_from_its_shape(speed, drift, wander):
    jets = fit_jets(falling(speed, drift, wander=wander), np.arange(9) * 0.05, G, VOXEL)
    assert all(jet is not None for jet in jets)
    for t in (0, 4, 8):
        heights = np.array([0.12, 0.2, 0.29])
        down = np.sqrt(speed**2 + 2 * G * (0.3 - heights))
        found = jets[t].velocity(heights)
        np.testing.assert_allclose(found[:, 2], -down, rtol=0.12)
        np.testing.assert_allclose(found[:, 0], drift, rtol=0.12)
        np.testing.assert_allclose(found[:, 1], 0, atol=0.05)


@pytest.mark.parametrize(("speed", "drift"), [(1.0, 0.35), (0.5, 1.0)])
def test_a_jets_axis_and_width_lead_through_its_slices(speed, drift):
    frames = falling(speed, drift)
    jet = fit_jets(frames, np.arange(9) * 0.05, G, VOXEL)[4]
    axis = np.concatenate([frames[4].middle, frames[4].height[:, None]], axis=1)
    assert (jet.distance(axis) < 0).all()
    radius = np.sqrt(frames[4].area / np.pi)
    np.testing.assert_allclose(-jet.distance(axis), radius, atol=0.4 * VOXEL)


def beaded(speed: float, period: float, times: np.ndarray, gaps: bool = False) -> list[Slices]:
    """A jet whose thickness goes up and down with when its liquid left the height .3, `period` seconds apart. Its path
    is seen to half a voxel, so that its shape says little of its speed."""
    frames = []
    for t, time in enumerate(times):
        height = (np.arange(20, 60) + 0.5) * VOXEL
        down = np.sqrt(speed**2 + 2 * G * (0.3 - height))
        left = time - (down - speed) / G
        rng = np.random.default_rng(t)
        # No two beads alike.
        thick = 1 + 0.5 * np.sin(2 * np.pi * left / period) + 0.3 * np.sin(2 * np.pi * left / (2.3 * period))
        area = 6e-4 / down * np.maximum(thick, 0.05) * np.exp(rng.normal(0, 0.05, len(height)))
        middle = np.stack([0.2 * (down - speed) / G, np.zeros(len(height))], axis=1)
        middle += rng.normal(0, 0.5 * VOXEL, middle.shape)
        there = thick > (0.4 if gaps else 0.0)
        frames.append(Slices(height[there], middle[there], area[there]))
    return frames


@pytest.mark.parametrize("gaps", [False, True])
@pytest.mark.parametrize("speed", [0.9, 1.25, 1.6])
@pytest.mark.parametrize("uneven", [False, True])
def test_beads_tell_a_jets_speed_to_a_few_per_cent(speed, gaps, uneven):
    times = np.cumsum(np.random.default_rng(1).choice([0.02, 0.03, 0.04], 40)) if uneven else np.arange(40) / 30
    jet = fit_jets(beaded(speed, 0.022, times, gaps), times, G, VOXEL)[10]
    assert -jet.velocity(np.array([0.3]))[0, 2] == pytest.approx(speed, rel=0.03)
    for height in (0.15, 0.25):
        assert -jet.velocity(np.array([height]))[0, 2] == pytest.approx(
            (speed**2 + 2 * G * (0.3 - height)) ** 0.5, rel=0.03
        )


def test_noise_in_the_thickness_is_no_beads(monkeypatch):
    times = np.arange(9) * 0.05
    frames = falling(1.0, 0.35)
    speed = fit_jets(frames, times, G, VOXEL)[4].speed
    monkeypatch.setattr(jet_module, "_BEADED", np.inf)
    assert fit_jets(frames, times, G, VOXEL)[4].speed == speed


def test_a_falling_tip_tells_the_speed_of_a_straight_jet():
    """A vertical jet bends nowhere; its first drop and its thinning still show how fast it is."""
    times = np.arange(8) * 0.02
    frames = []
    for time in times:
        height = (np.arange(20, 60) + 0.5) * VOXEL
        tip = 0.3 - 1.0 * time - 0.5 * G * time**2
        height = height[height >= tip]
        frames.append(Slices(height, np.zeros((len(height), 2)), 6e-4 / np.sqrt(1 + 2 * G * (0.3 - height))))
    speed = fit_jets(frames, times, G, VOXEL)[-1].velocity(np.array([0.3]))[0, 2]
    assert speed == pytest.approx(-1.0, rel=0.12)


def test_no_liquid_in_the_air_means_no_jet():
    nothing = Slices(np.zeros(0), np.zeros((0, 2)), np.zeros(0))
    assert fit_jets([nothing] * 3, np.arange(3.0), G, VOXEL) == [None] * 3
    alone = falling(1.0, 0.3, n_frames=2)
    jets = fit_jets([*alone, *[nothing] * 9], np.arange(11) * 0.05, G, VOXEL)
    assert jets[0] is not None
    assert jets[-1] is None


def test_slices_have_the_middle_and_the_area_of_a_cylinder():
    axes = np.arange(-10, 11) * VOXEL
    points = np.stack(np.meshgrid(axes, axes, np.arange(20) * VOXEL, indexing="ij"), -1).reshape(-1, 3)
    distance = np.hypot(points[:, 0] - 0.012, points[:, 1] + 0.008) - 0.022
    slices = slices_of(points, np.clip(0.5 - distance / VOXEL, 0, 1), VOXEL)
    assert len(slices.height) == 20
    np.testing.assert_allclose(slices.middle, [[0.012, -0.008]] * 20, atol=0.02 * VOXEL)
    np.testing.assert_allclose(slices.area, np.pi * 0.022**2, rtol=0.01)
    assert (slices.above(0.05).height > 0.05).all()
    assert len(slices.above(0.05).height) == 10


def test_without_a_container_the_stream_ends_where_the_body_begins():
    height = (np.arange(40) + 0.5) * VOXEL
    area = np.where(height < 0.06, 1e-2, 4e-4)
    body = Slices(height, np.zeros((40, 2)), area)
    assert open_floor([body] * 3, VOXEL) == pytest.approx(0.06 + 1.5 * VOXEL, abs=VOXEL)
    assert open_floor([Slices(np.zeros(0), np.zeros((0, 2)), np.zeros(0))], VOXEL) == np.inf


def test_slices_cut_by_an_image_edge_are_left_out():
    K = np.array([[192.0, 0, 80], [0, 192.0, 60], [0, 0, 1]])
    camera = Camera("0", 160, 120, K, look_at((0, 0.2, 1.0), (0, 0.2, 0.0)))
    height = np.linspace(-0.4, 0.8, 25)
    slices = Slices(height, np.zeros((25, 2)), np.full(25, np.pi * 0.02**2))
    kept = framed(slices, [camera], upright(np.array([0.0, -1.0, 0.0])))
    top = 0.2 + 60 / 192  # half the image's height over the focal length, a metre away
    assert 0 < len(kept.height) < 25
    assert kept.height.max() < top - 0.02
    assert kept.height.max() > top - 0.12

"""The liquid between two frames: a column, a drop and a front whose motion is known."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

from splashbench.observe.grid import Grid
from splashbench.scene.geometry import STEPS_PER_VOXEL
from splashbench_methods.splashsplat.carriers.between import carriers_at, steadiness
from splashbench_methods.splashsplat.carriers.population import Carriers
from splashbench_methods.splashsplat.carriers.subframe import Track
from splashbench_methods.splashsplat.fields.jet import Jet
from splashbench_methods.splashsplat.motion.between import moved_distance
from splashbench_methods.splashsplat.motion.fall import JetFall
from splashbench_methods.splashsplat.motion.steps import Motion

SHAPE = (24, 24, 64)
TIMES = np.array([1.0, 1.2])
NODES = np.stack(np.meshgrid(*(np.arange(n, dtype=np.float64) for n in SHAPE), indexing="ij"), axis=-1)


def column(low: float, high: float, radius: float = 4.0) -> np.ndarray:
    """Signed distance, nearly, of an upright column about the grid's middle: voxels."""
    side = np.linalg.norm(NODES[..., :2] - 12, axis=-1) - radius
    return np.maximum(side, np.maximum(low - NODES[..., 2], NODES[..., 2] - high))


def ball(height: float, radius: float = 3.0) -> np.ndarray:
    return np.linalg.norm(NODES - np.array([12, 12, height]), axis=-1) - radius


def track_of(before: np.ndarray, after: np.ndarray, fall: float) -> Track:
    """Carriers all through both frames' liquid, which falls by `fall` voxels from frame to frame."""
    positions = [np.argwhere(phi <= 0).astype(np.float32) + np.float32(0.3) for phi in (before, after)]
    starts = np.cumsum([0, *map(len, positions)])
    everywhere = np.concatenate(positions)
    phi = np.concatenate([field[field <= 0] for field in (before, after)]).astype(np.float32)
    F = np.tile(np.eye(3, dtype=np.float32), (len(everywhere), 1, 1))
    carriers = Carriers(starts, np.arange(len(everywhere), dtype=np.int32), everywhere, F, phi, len(everywhere))
    velocities = np.zeros((1, 8, 8, 18, 3), dtype=np.float16)
    velocities[..., 2] = -fall
    packed = np.clip(np.stack([before, after]) * STEPS_PER_VOXEL, -127, 127).astype(np.int8)
    return Track(Grid(np.zeros(3), 1.0, SHAPE), carriers, Motion(velocities, 4, [None]), packed)


def opacity_by_height(track: Track, fraction: float) -> np.ndarray:
    """Sum over the carriers of each slab of two voxels, of what their opacities are multiplied by: [32]."""
    total = np.zeros(SHAPE[2] // 2)
    for _, state in carriers_at(track, TIMES, TIMES[0] + fraction * (TIMES[1] - TIMES[0])):
        weight = torch.ones(len(state.phi)) if state.visibility is None else state.visibility
        slab = np.clip(state.positions[:, 2].numpy() / 2, 0, len(total) - 1).astype(int)
        np.add.at(total, slab, (weight * torch.sigmoid(2 * (3 - state.phi.abs()))).numpy())
    return total


@pytest.mark.parametrize("fraction", [0.2, 0.5, 0.8])
def test_a_jet_that_flows_on_stays_full_and_gets_no_longer(fraction: float):
    jet = column(8, 56)
    track = track_of(jet, jet, fall=7)
    at_frame, between = opacity_by_height(track, 0), opacity_by_height(track, fraction)
    full = at_frame > 0.5 * at_frame.max()
    assert between[full] == pytest.approx(at_frame[full], rel=0.35)
    assert between[~full].sum() < 0.05 * at_frame.sum()


def test_a_jet_whose_fall_is_known_flows_though_its_liquid_keeps_its_place() -> None:
    jet = column(8, 56)
    still = track_of(jet, jet, fall=0)
    fall = JetFall(Jet(60.0, np.full(2, 12.0), np.zeros(2), 30.0, 10.0, 8.0), 4.0, np.eye(3), still.grid, 0.2)
    flowing = replace(still, motion=replace(still.motion, falls=[fall]))
    time = TIMES[0] + 0.3 * (TIMES[1] - TIMES[0])
    before = still.state(0).positions[:, 2]
    assert torch.equal(carriers_at(still, TIMES, time)[0][1].positions[:, 2], before)
    moved = before - carriers_at(flowing, TIMES, time)[0][1].positions[:, 2]
    high = before > 30  # others land within the step
    assert (moved[high] > 0.3 * 0.2 * 30).all()
    assert (moved[high] < 0.3 * 0.2 * 50).all()


@pytest.mark.parametrize("fraction", [0.3, 0.5, 0.9])
def test_a_drop_that_moves_by_more_than_its_size_is_where_it_flies_and_as_opaque(fraction: float):
    track = track_of(ball(46), ball(26), fall=20)
    at_frame = opacity_by_height(track, 0)
    parts = carriers_at(track, TIMES, TIMES[0] + fraction * (TIMES[1] - TIMES[0]))
    heights = torch.cat([state.positions[:, 2] for _, state in parts])
    weights = torch.cat([state.visibility for _, state in parts])
    assert float((heights * weights).sum() / weights.sum()) == pytest.approx(46.3 - 20 * fraction, abs=0.5)
    assert opacity_by_height(track, fraction).sum() == pytest.approx(at_frame.sum(), rel=0.1)


def test_what_gets_to_where_no_liquid_is_fades_on_the_way():
    track = track_of(ball(46), ball(46), fall=20)  # the motion is wrong: the ball rests
    (_, moved), *_ = carriers_at(track, TIMES, TIMES[0] + 0.6 * (TIMES[1] - TIMES[0]))
    assert float(moved.visibility.max()) < 0.5 * (1 - 0.6)


def test_nothing_jumps_half_way_nor_at_a_frame():
    track = track_of(column(20, 56), column(10, 56), fall=10)
    step = TIMES[1] - TIMES[0]
    (_, here), *_ = carriers_at(track, TIMES, TIMES[0] + 0.4999 * step)
    (_, there), *_ = carriers_at(track, TIMES, TIMES[0] + 0.5001 * step)
    assert float((here.positions - there.positions).norm(dim=1).max()) < 0.01
    assert float((here.visibility - there.visibility).abs().max()) < 0.001
    for frame, fraction in ((0, 0.001), (1, 0.999)):
        at_frame = opacity_by_height(track, frame)
        assert np.abs(opacity_by_height(track, fraction) - at_frame).max() < 0.05 * at_frame.max()


def test_at_a_frames_time_the_frames_own_carriers_are_shown():
    track = track_of(ball(46), ball(26), fall=20)
    for t, time in ((0, TIMES[0]), (1, TIMES[1]), (0, 0.0), (1, 9.0)):
        ((ids, state),) = carriers_at(track, TIMES, time)
        assert torch.equal(ids, track.ids(t))
        assert torch.equal(state.positions, track.state(t).positions)
        assert state.visibility is None


def test_a_frame_without_liquid_fades_into_the_next_one():
    track = track_of(np.full(SHAPE, 9.0), ball(26), fall=0)
    for fraction in (0.25, 0.75):
        parts = carriers_at(track, TIMES, TIMES[0] + fraction * (TIMES[1] - TIMES[0]))
        assert all(float(state.visibility.max()) <= fraction for ids, state in parts if len(ids))


@pytest.mark.parametrize("fraction", [0.3, 0.5, 0.9])
def test_the_papers_way_is_forward_from_the_frame_before(fraction: float):
    """x_t + tau u_t, and phi (1 - tau) phi_t + tau phi_{t+1} there, whichever frame is nearer."""
    track = track_of(ball(40), ball(36), fall=4)
    ((ids, state),) = carriers_at(track, TIMES, TIMES[0] + fraction * (TIMES[1] - TIMES[0]), "forward")
    assert torch.equal(ids, track.ids(0))
    expected = track.state(0).positions - torch.tensor([0.0, 0.0, 4 * fraction])
    torch.testing.assert_close(state.positions, expected, atol=1e-3, rtol=0)
    x = expected.numpy()
    between = [np.linalg.norm(x - np.float32([12, 12, height]), axis=1) - 3 for height in (40, 36)]
    phi = (1 - fraction) * between[0] + fraction * between[1]
    # phi is interpolated between nodes, and its sixteenths of a voxel.
    np.testing.assert_allclose(state.phi.numpy(), phi, atol=0.25)
    assert state.visibility is None
    ((late, state),) = carriers_at(track, TIMES, TIMES[1], "forward")
    assert torch.equal(late, track.ids(1))


def test_steady_is_what_keeps_its_place():
    rests, flies = (
        steadiness(*(np.clip(phi * STEPS_PER_VOXEL, -127, 127).astype(np.int8) for phi in pair))
        for pair in ((column(0, 40), column(0, 40)), (ball(46), ball(26)))
    )
    assert rests[12, 12, 20] == pytest.approx(1)
    assert flies[12, 12, 46] == flies[12, 12, 26] == 0


@pytest.mark.parametrize("share", [0.25, 0.5, 0.75])
def test_a_drops_surface_is_where_the_drop_is(share: float):
    # It falls by 10 voxels and is 8 wide: half way it is in neither frame's place.
    before, after = (np.clip(ball(height, 4) * STEPS_PER_VOXEL, -127, 127).astype(np.int8) for height in (40.0, 30.0))
    velocities = np.zeros((1, 8, 8, 18, 3), dtype=np.float16)
    velocities[..., 2] = -10
    step = Motion(velocities, 4, [None]).step(0)
    moved = moved_distance(before, after, step, share)
    inside = np.argwhere(moved < 0)
    assert len(inside) == pytest.approx((ball(40, 4) < 0).sum(), rel=0.15)
    np.testing.assert_allclose(inside.mean(axis=0), [12, 12, 40 - 10 * share], atol=0.3)
    blended = (1 - share) * before.astype(float) + share * after
    assert (blended < 0).sum() < 0.6 * len(inside)


def test_liquid_that_one_frame_has_alone_shrinks_between_them():
    before = np.clip(ball(32) * STEPS_PER_VOXEL, -127, 127).astype(np.int8)
    nothing = np.full_like(before, 127)
    step = Motion(np.zeros((1, 8, 8, 18, 3), dtype=np.float16), 4, [None]).step(0)
    sizes = [int((moved_distance(before, nothing, step, share) < 0).sum()) for share in (0.0, 0.1, 0.3, 0.6)]
    assert sizes[0] == (before < 0).sum()
    assert sizes == sorted(sizes, reverse=True)
    assert sizes[-1] == 0

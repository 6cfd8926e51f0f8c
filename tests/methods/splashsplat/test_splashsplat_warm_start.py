"""A fit that begins with what was learned on coarser grids."""

from __future__ import annotations

import math

import numpy as np
import torch

from splashbench.observe.grid import Grid
from splashbench_methods.splashsplat.appearance.decoder import DecoderSettings, initial_log_scale
from splashbench_methods.splashsplat.appearance.first_look import Look, features_of
from splashbench_methods.splashsplat.appearance.fit_settings import FitSettings
from splashbench_methods.splashsplat.appearance.fitting import Appearance, initial_appearance
from splashbench_methods.splashsplat.appearance.glass import Glass
from splashbench_methods.splashsplat.appearance.schedule import FixedSchedule
from splashbench_methods.splashsplat.appearance.warm_start import Learned, hand_on, nearest_carriers
from splashbench_methods.splashsplat.carriers.population import Carriers
from splashbench_methods.splashsplat.carriers.subframe import Track
from splashbench_methods.splashsplat.motion.steps import Motion

BASE_SCALE = 0.5


def track(frames: list[list[tuple[int, float]]], voxel: float, origin: float = 0.0) -> Track:
    """Carriers by frame, each a number and an x in scene units, on a grid of that voxel."""
    starts = np.cumsum([0, *(len(frame) for frame in frames)])
    ids = np.array([number for frame in frames for number, _ in frame], dtype=np.int32)
    x = np.array([place for frame in frames for _, place in frame], dtype=np.float64)
    positions = np.zeros((len(ids), 3), dtype=np.float32)
    positions[:, 0] = (x - origin) / voxel
    carriers = Carriers(
        starts,
        ids,
        positions,
        np.tile(np.eye(3, dtype=np.float32), (len(ids), 1, 1)),
        np.zeros(len(ids), dtype=np.float32),
        int(ids.max(initial=-1)) + 1,
    )
    grid = Grid(np.array([origin, 0.0, 0.0]), voxel, (12, 12, 12))
    shape = (len(frames), 12, 12, 12)
    return Track(grid, carriers, Motion(np.zeros((0, 7, 7, 7, 3), np.float32), 2, []), np.zeros(shape, np.int8))


COARSE = track([[(0, 0.0), (1, 2.0)], [], [(1, 2.4), (2, 0.4)]], voxel=0.5, origin=-1.0)
FINE = track([[(0, 0.1), (1, 1.9)], [(0, 0.2), (2, 1.1)], [(3, 2.3), (4, 0.3)]], voxel=0.25)


def test_each_takes_the_nearest_one_of_the_frame_of_its_birth() -> None:
    # Number 2 is born in a frame in which the coarse fit has none: the one before counts.
    assert nearest_carriers(COARSE, FINE).tolist() == [0, 1, 1, 1, 2]


def test_without_coarse_carriers_there_is_none_to_take() -> None:
    assert nearest_carriers(track([[], [], []], voxel=0.5), FINE).tolist() == [-1] * 5


def look(count: int, seed: int) -> Look:
    rng = np.random.default_rng(seed)
    return Look(rng.uniform(0.2, 0.8, (count, 3)).astype(np.float32), rng.uniform(0, 0.1, count).astype(np.float32))


def appearance(of: Track, seed: int) -> Appearance:
    decoder = DecoderSettings(feature_size=8, children=1, color_width=8)
    made = initial_appearance(of.carriers.count, of.grid.voxel, FitSettings(base_scale=BASE_SCALE), decoder, seed)
    made.features = torch.randn(made.features.shape, generator=torch.Generator().manual_seed(seed))
    return made


def learned() -> Learned:
    found = appearance(COARSE, 1)
    found.log_scales += torch.tensor([[0.0], [0.3], [-0.2]])
    found.glass = Glass(*(torch.rand(shape) for shape in ((2, 3), (2, 3), (2, 4), (2,), (2, 3), (2, 3, 3))))
    return Learned(COARSE, found, look(3, 1))


def test_features_extents_heads_and_glass_are_handed_on() -> None:
    given, taken = learned(), appearance(FINE, 2)
    hand_on(given, FINE, None, taken, BASE_SCALE)
    rows = [0, 1, 1, 1, 2]
    assert torch.equal(taken.features, given.appearance.features[rows])
    grown = torch.tensor([0.0, 0.3, 0.3, 0.3, -0.2])[:, None].expand(5, 3)
    torch.testing.assert_close(taken.log_scales - initial_log_scale(BASE_SCALE, 0.25), grown)
    theirs, ours = given.appearance.decoder.state_dict(), taken.decoder.state_dict()
    for name in theirs.keys() - {"opacity.bias"}:
        assert torch.equal(ours[name], theirs[name])
    # Twice as many lie one behind the other.
    torch.testing.assert_close(ours["opacity.bias"], theirs["opacity.bias"] - math.log(2))
    assert given.appearance.glass is not None
    assert taken.glass is not None
    assert torch.equal(taken.glass.positions, given.appearance.glass.positions)
    taken.glass.positions += 1  # its own
    assert not torch.equal(taken.glass.positions, given.appearance.glass.positions)


def test_what_photographs_show_of_them_otherwise_is_added() -> None:
    given, taken, shown = learned(), appearance(FINE, 2), look(5, 3)
    assert given.look is not None
    hand_on(given, FINE, shown, taken, BASE_SCALE)
    rows, changed = [0, 1, 1, 1, 2], features_of(shown) - features_of(given.look)[[0, 1, 1, 1, 2]]
    torch.testing.assert_close(taken.features[:, :4], given.appearance.features[rows][:, :4] + changed)
    assert torch.equal(taken.features[:, 4:], given.appearance.features[rows][:, 4:])


def test_a_schedule_goes_on_where_another_fit_ended() -> None:
    whole, rest = FixedSchedule(100, anneal=True), FixedSchedule(100, anneal=True, begun=30)
    assert [rest.factor(i) for i in range(71)] == [whole.factor(i) for i in range(30, 101)]
    assert rest.factor(70) is None
    assert rest.done(20) == whole.done(50)

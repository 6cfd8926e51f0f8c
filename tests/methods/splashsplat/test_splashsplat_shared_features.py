"""Features as sums of own and shared parts: who shares, what a step moves, and what is left at the end."""

import numpy as np
import pytest
import torch

from splashbench_methods.splashsplat.appearance import shared_features
from splashbench_methods.splashsplat.appearance.optimizer import RowAdam
from splashbench_methods.splashsplat.appearance.shared_features import SharedFeatures, births, cells_of
from splashbench_methods.splashsplat.carriers.tracking import Carriers
from splashbench_methods.splashsplat.settings import SplashSplatConfig

RATES = {"own_rate": 0.06, "shared_rate": 0.02}


def _carriers() -> Carriers:
    """Four carriers in three frames: 0 and 1 from the first, side by side; 2 from the second, far off, lasting on; 3
    from the last, where 0 was born."""
    ids = np.array([0, 1, 1, 2, 2, 3], dtype=np.int32)
    positions = np.array([[1, 1, 1], [2, 1, 1], [9, 1, 1], [30, 1, 1], [1, 1, 1], [1, 1, 1]], dtype=np.float32)
    starts = np.array([0, 2, 4, 6])
    return Carriers(starts, ids, positions, np.tile(np.eye(3, dtype=np.float32), (6, 1, 1)), np.zeros(6, np.float32), 4)


def _features(*sizes: float, seed: int = 0) -> tuple[SharedFeatures, torch.Tensor]:
    own = torch.arange(8, dtype=torch.float32).reshape(4, 2)
    return _shared(own, _carriers(), sizes, seed), own


def _shared(
    own: torch.Tensor, carriers: Carriers, sizes: tuple[float, ...], seed: int = 0, still: float = 0.0
) -> SharedFeatures:
    ids = [torch.from_numpy(carriers.ids[carriers.rows(t)].astype(np.int64)) for t in range(carriers.n_frames)]
    return SharedFeatures(own, carriers, ids, sizes, still, **RATES, seed=seed)


def test_a_cell_is_of_space_and_time_and_of_the_birth_alone() -> None:
    near, late = (cells_of(births(_carriers()), size, size, np.zeros(4)) for size in (4.0, 2.0))
    # Carrier 1 moved eight voxels on, 2 ended where 0 began: neither matters.
    assert near[0] == near[1] == near[3]
    assert near[2] != near[0]
    assert late[3] not in late[:3]  # two frames later
    assert sorted(set(late)) == list(range(len(set(late))))


def test_faces_are_where_the_shift_says() -> None:
    cells = cells_of(births(_carriers()), 4.0, 4.0, np.array([0.6, 0.0, 0.0, 0.0]))  # faces at 1.6, 5.6, ... along x
    assert cells[0] != cells[1]
    assert cells[0] == cells[3]


def test_still_cells_are_of_a_place_in_all_frames() -> None:
    cells = cells_of(births(_carriers()), 2.0, np.inf, np.array([0.0, 0.0, 0.0, 0.9]))
    assert cells[0] == cells[3]
    assert len(set(cells)) == 3
    features = _shared(torch.zeros(4, 2), _carriers(), (), still=1.5)
    features.step(0, torch.ones(2, 2), factor=1.0)
    assert bool((features.all()[3] < 0).all())  # born two frames later, where the first was
    assert bool((features.all()[2] == 0).all())


def test_a_step_moves_the_carriers_own_part_and_its_cells() -> None:
    features, own = _features(1e6)
    before = features.all()
    torch.testing.assert_close(before, own)
    features.step(0, torch.tensor([[1.0, -1.0], [1.0, -1.0]]), factor=1.0)
    moved = features.all() - before
    # Adam's first step is the rate, whatever the gradient; carriers 2 and 3 have the cell's alone.
    expected = torch.tensor([[-0.08, 0.08], [-0.08, 0.08], [-0.02, 0.02], [-0.02, 0.02]])
    torch.testing.assert_close(moved, expected)
    torch.testing.assert_close(features.of_frame(1), features.all()[[1, 2]])


def test_a_step_may_be_of_some_carriers_alone() -> None:
    features, _ = _features(1e6)
    before = features.all()
    torch.testing.assert_close(features.of_frame(0, torch.tensor([1])), before[[1]])
    features.step(0, torch.tensor([[1.0, -1.0]]), factor=1.0, places=torch.tensor([1]))
    expected = torch.tensor([[-0.02, 0.02], [-0.08, 0.08], [-0.02, 0.02], [-0.02, 0.02]])
    torch.testing.assert_close(features.all() - before, expected)


def test_a_step_leaves_alone_the_cells_that_no_kept_carrier_is_in() -> None:
    features, _ = _features(4.0)
    before = features.all()
    features.keep([torch.tensor([0]), torch.tensor([2]), torch.tensor([2])])
    torch.testing.assert_close(features.of_frame(1), before[[2]])
    features.step(1, torch.tensor([[1.0, -1.0]]), factor=1.0)
    moved = (features.all() - before).abs().amax(dim=1)
    assert moved.tolist() == pytest.approx([0, 0, 0.08, 0], abs=1e-6)


def test_a_cell_descends_along_the_sum_of_its_carriers() -> None:
    features, _ = _features(1e6)
    before = features.all()
    features.step(0, torch.tensor([[3.0, 1.0], [-3.0, 1.0]]), factor=0.5)
    moved = features.all() - before
    torch.testing.assert_close(moved[2], torch.tensor([0.0, -0.01]))  # opposite wishes cancel
    torch.testing.assert_close(moved[0], torch.tensor([-0.03, -0.04]))


def test_without_cells_a_carrier_learns_alone() -> None:
    features, own = _features()
    table = own.clone()
    adam = RowAdam(table, RATES["own_rate"])
    for t, rows in ((0, [0, 1]), (1, [1, 2]), (0, [0, 1])):
        gradient = torch.tensor([[0.3, -2.0], [1.0, 0.1]])
        features.step(t, gradient, factor=0.7)
        adam.step(torch.tensor(rows), gradient, 0.7)
    assert torch.equal(features.all(), table)


@pytest.mark.parametrize("sizes", [(), (4.0, 16.0)])
def test_no_carriers_at_all(sizes: tuple[float, ...]) -> None:
    empty = np.zeros(0, np.int32)
    none = np.zeros((0, 3), np.float32)
    carriers = Carriers(np.zeros(3, int), empty, none, np.zeros((0, 3, 3), np.float32), np.zeros(0, np.float32), 0)
    features = _shared(torch.zeros(0, 2), carriers, sizes)
    assert features.all().shape == (0, 2)
    assert features.of_frame(1).shape == (0, 2)
    features.step(0, torch.zeros(0, 2), 1.0)


def test_the_same_seed_has_the_same_cells_and_another_one_others() -> None:
    rng = np.random.default_rng(5)
    gradient = torch.from_numpy(rng.normal(size=(2, 2)).astype(np.float32))
    totals = []
    for seed in (1, 1, 2, 3, 4, 5):
        features, _ = _features(2.0, seed=seed)
        features.step(0, gradient, 1.0)
        totals.append(features.all())
    assert torch.equal(totals[0], totals[1])
    assert any(not torch.equal(totals[0], other) for other in totals[2:])


def test_settings_reach_the_fit() -> None:
    presets = {name: SplashSplatConfig.model_validate(values) for name, values in SplashSplatConfig.presets.items()}
    assert {name: config.optimisation.feature_cells for name, config in presets.items()} == {
        "best": (4.0, 16.0),
        "auto": (4.0, 16.0),
        "paper": (),
        "quick": (4.0, 16.0),
    }
    assert {name: config.optimisation.still_cell for name, config in presets.items()} == {
        "best": 2.0,
        "auto": 2.0,
        "paper": 0.0,
        "quick": 2.0,
    }
    assert SplashSplatConfig(learning_rate_cells=0.007).optimisation.learning_rate_cells == 0.007


@pytest.mark.parametrize("block", [1, 3, 4])
def test_the_parts_are_joined_block_by_block(block: int, monkeypatch: pytest.MonkeyPatch) -> None:
    features, own = _features(1e6, 2.0)
    features.step(0, torch.tensor([[1.0, -1.0], [0.5, 2.0]]), factor=1.0)
    expected = features.of_frame(0), features.all()
    monkeypatch.setattr(shared_features, "_BLOCK", block)
    assert [len(part) for part in features.blocks()] == ([block] * (4 // block) + [4 % block] * (4 % block > 0))
    assert torch.equal(features.all(), expected[1])
    joined = features.joined()
    assert joined.data_ptr() == own.data_ptr()
    assert torch.equal(joined, expected[1])
    assert torch.equal(features.of_frame(0), expected[0])
    assert torch.equal(features.all(), joined)

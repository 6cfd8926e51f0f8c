"""What is stored of a liquid: the same whole numbers from any reader, within tolerance; damaged files are refused."""

from __future__ import annotations

import importlib.util
import json
import resource
from collections.abc import Callable
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest
import torch

from splashbench.errors import SplashbenchError
from splashbench.harness.contract import Run
from splashbench.scene import Scene
from splashbench_methods.splashsplat import SplashSplat
from splashbench_methods.splashsplat.appearance.sensitivity import Sensitivities, Sensitivity
from splashbench_methods.splashsplat.carriers.precision import Precision
from splashbench_methods.splashsplat.method import FittedSplashSplat
from splashbench_methods.splashsplat.model import Liquid
from splashbench_methods.splashsplat.motion.steps import Motion
from splashbench_methods.splashsplat.motion.velocity import factors
from splashbench_methods.splashsplat.storage import rows, signed_distance, values
from splashbench_methods.splashsplat.storage.packing import (
    pack,
    pack_distance,
    packed_bytes,
    unpack_appearance,
    unpack_carriers,
    unpack_distance,
    unpack_motion,
)
from splashbench_methods.splashsplat.storage.tolerance import Trial, longest_step

Arrays = dict[str, np.ndarray]
FILES = ("liquid.json", "carriers.npz", "motion.npz", "distance.npz", "appearance.npz")


@pytest.fixture(scope="module")
def reader() -> ModuleType:
    spec = importlib.util.spec_from_file_location("reader", Path(__file__).with_name("reader.py"))
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def fit(scene: Scene, **settings: object) -> tuple[FittedSplashSplat, Run]:
    overrides = {"hull_cells": 40, "transport_cells": 20, "control_cells": 6, "iterations": 40, "voxel_pixels": 0}
    run = Run()
    config = SplashSplat.Config.preset("quick", overrides | settings)
    return SplashSplat().fit(scene.training(), config, run), run


@pytest.fixture(scope="module")
def fitted(balls: Scene) -> tuple[FittedSplashSplat, Run]:
    return fit(balls)


def test_a_reader_written_from_the_description_finds_the_same(
    fitted: tuple[FittedSplashSplat, Run], reader: ModuleType, tmp_path: Path
) -> None:
    liquid = fitted[0].liquid
    liquid.save(tmp_path)
    found = reader.read(tmp_path)
    for t in range(len(liquid.times)):
        own = liquid.carriers.rows(t)
        np.testing.assert_array_equal(found["ids"][t], liquid.carriers.ids[own])
        np.testing.assert_array_equal(found["places"][t], liquid.carriers.positions[own])
    np.testing.assert_array_equal(found["phi"] * 16, liquid.phi)
    learned = np.concatenate([liquid.appearance.features.numpy(), liquid.appearance.log_scales.numpy()], axis=1)
    np.testing.assert_allclose(found["values"], learned, atol=1e-4)


def test_storing_what_was_loaded_gives_the_same_bytes(fitted: tuple[FittedSplashSplat, Run], tmp_path: Path) -> None:
    for name in ("a", "b"):
        (tmp_path / name).mkdir()
    fitted[0].liquid.save(tmp_path / "a")
    Liquid.load(tmp_path / "a").save(tmp_path / "b")
    for name in FILES:
        assert (tmp_path / "a" / name).read_bytes() == (tmp_path / "b" / name).read_bytes(), name


@pytest.mark.slow
def test_rounding_is_within_the_tolerance_and_a_wider_one_takes_fewer_bytes(balls: Scene) -> None:
    sizes = []
    for tolerance in (0.001, 0.03, 0.3):
        found, run = fit(balls, storage_tolerance=tolerance)
        (decision,) = [made for made in run.decisions if made.basis == "tolerance"]
        taken = next(rung for rung in decision.rungs if rung.bought)
        assert float(taken.reason.split()[1]) <= 100 * tolerance
        sizes.append(found.liquid.stored_bytes)
    assert sizes == sorted(sizes, reverse=True)
    assert sizes[-1] < sizes[0]


@pytest.mark.parametrize("seed", [0, 1])
def test_a_thousand_damages_raise_one_line_and_allocate_no_more_than_the_files_say(
    fitted: tuple[FittedSplashSplat, Run], tmp_path: Path, seed: int
) -> None:
    fitted[0].liquid.save(tmp_path)
    rng = np.random.default_rng(seed)
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    errors = []
    for _ in range(500):
        path = tmp_path / FILES[rng.integers(len(FILES))]
        whole = path.read_bytes()
        broken = bytearray(whole)
        kind = rng.integers(3)
        if kind == 0:
            broken[rng.integers(len(broken))] ^= 1 << int(rng.integers(8))
        elif kind == 1:
            start = int(rng.integers(len(broken)))
            broken[start : start + 16] = rng.integers(0, 256, len(broken[start : start + 16]), dtype=np.uint8).tobytes()
        else:
            del broken[int(rng.integers(len(broken))) :]
        path.write_bytes(bytes(broken))
        try:
            Liquid.load(tmp_path)
        except SplashbenchError as error:
            errors.append(str(error))
        path.write_bytes(whole)
    assert len(errors) > 300
    assert all("\n" not in error and str(tmp_path) in error for error in errors)
    grown = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before
    assert grown < 200_000  # kilobytes


def changed(directory: Path, name: str, change: Callable[[Arrays], Arrays]) -> None:
    """The file `name` as it would be with other numbers."""
    path = directory / f"{name}.npz"
    with np.load(path) as stored:
        written = dict(stored)
    if name == "carriers":
        np.savez(path, **pack(change(unpack_carriers(written))))
    elif name == "motion":
        steps = len(json.loads((directory / "liquid.json").read_text())["times"]) - 1
        np.savez(path, **pack(change(unpack_motion(written, steps))))
    elif name == "appearance":
        with np.load(directory / "carriers.npz") as carriers:
            count = int(carriers["births"].sum())
        np.savez(path, **pack(change(unpack_appearance(written, count))))
    else:
        raise AssertionError(name)


@pytest.mark.parametrize(
    ("name", "change"),
    [
        ("carriers", lambda a: a | {"lives": a["lives"] + 1}),
        ("carriers", lambda a: a | {"lives": 0 * a["lives"]}),
        ("carriers", lambda a: a | {"cells": a["cells"] + 10**6}),
        ("carriers", lambda a: a | {"residuals": a["residuals"][:-1]}),
        ("carriers", lambda a: a | {"within": a["within"] + 32}),
        ("carriers", lambda a: a | {"within": a["within"].astype(np.int8) - 32}),
        ("motion", lambda a: a | {"velocities": a["velocities"][:-1]}),
        ("motion", lambda a: a | {"velocities": a["velocities"][:, :1]}),
        ("appearance", lambda a: a | {"coefficients.2": a["coefficients.2"][:-1]}),
        ("appearance", lambda a: a | {"coefficients.3": a["coefficients.3"][:, 1:]}),
        ("appearance", lambda a: a | {"coarseness": a["coarseness"].astype(int) + 100}),
        ("appearance", lambda a: a | {"basis": np.full_like(a["basis"], 3e38)}),
    ],
)
def test_numbers_that_do_not_fit_together_are_named(
    fitted: tuple[FittedSplashSplat, Run], tmp_path: Path, name: str, change: Callable[[Arrays], Arrays]
) -> None:
    fitted[0].liquid.save(tmp_path)
    changed(tmp_path, name, change)
    with pytest.raises(SplashbenchError, match=r"does not fit|has \d+ carriers"):
        Liquid.load(tmp_path)


@pytest.mark.parametrize(
    ("name", "change"),
    [
        ("carriers", lambda a: a | {"births": a["births"][:-1]}),
        ("carriers", lambda a: a | {"births": a["births"] + 0.5}),
        ("carriers", lambda a: a | {"births": a["births"].astype(np.int64) << 40}),
        ("carriers", lambda a: a | {"births": -a["births"].astype(np.int64)}),
        ("carriers", lambda a: a | {"births": a["births"].astype(np.uint64) << np.uint64(63)}),
        ("carriers", lambda a: a | {"births": a["births"] * 10**6, "lives": np.zeros(2 * 10**6, np.uint8)}),
        ("carriers", lambda a: a | {"residuals": a["residuals"] + 0.5}),
        ("carriers", lambda a: a | {"lives": a["lives"].astype(np.int64)}),
        ("carriers", lambda a: a | {"cells": a["cells"][:-2]}),
        ("motion", lambda a: a | {"velocities": a["velocities"][:0]}),
        ("motion", lambda a: a | {"nodes": a["nodes"] * 1000}),
        ("motion", lambda a: a | {"nodes": -a["nodes"]}),
        ("motion", lambda a: a | {"nodes": np.array([2**31 - 1, 2**20, 0])}),
        ("motion", lambda a: a | {"nodes": np.array([9000, 200, 100]), "velocities": np.zeros(10**7, np.uint8)}),
        ("motion", lambda a: a | {"nodes": a["nodes"][:2]}),
        ("motion", lambda a: a | {"nodes": a["nodes"] + 0.5}),
        ("distance", lambda a: a | {"phi": a["phi"][:-1]}),
        ("distance", lambda a: a | {"phi": np.append(a["phi"], np.uint8(0))}),
        ("distance", lambda a: a | {"phi": a["phi"][::-1]}),
        ("distance", lambda a: a | {"ends": a["ends"][::-1]}),
        ("distance", lambda a: a | {"ends": np.array([-100, 100])}),
        ("distance", lambda a: a | {"ends": a["ends"] + 0.5}),
        ("appearance", lambda a: a | {"coarseness": a["coarseness"].astype(np.float32)}),
        ("appearance", lambda a: a | {"coefficients.1": a["coefficients.4"]}),
        ("appearance", lambda a: a | {"center": np.tile(a["center"], 10_000)}),
    ],
)
def test_arrays_that_do_not_fit_together_are_named(
    fitted: tuple[FittedSplashSplat, Run], tmp_path: Path, name: str, change: Callable[[Arrays], Arrays]
) -> None:
    fitted[0].liquid.save(tmp_path)
    path = tmp_path / f"{name}.npz"
    with np.load(path) as stored:
        arrays = dict(stored)
    np.savez(path, **change(arrays))
    with pytest.raises(SplashbenchError, match=r"does not fit"):
        Liquid.load(tmp_path)


def test_more_frames_than_a_file_may_hold_are_refused() -> None:
    still = {"phi": np.zeros(10**6, np.uint8), "ends": np.array([-13, 12], np.int8)}
    with pytest.raises(ValueError, match="frames of phi are more than 2 GiB"):
        unpack_distance(still, (2**14, 64, 64, 64))


def test_carriers_that_never_move_and_none_at_all_are_stored() -> None:
    for count in (0, 3):
        carriers = {
            "births": np.array([count], np.uint32),
            "lives": np.ones(count, np.uint16),
            "cells": np.arange(count, dtype=np.int32),
            "within": np.zeros((count, 3), np.uint8),
            "residuals": np.zeros((0, 3), np.int8),
        }
        found = unpack_carriers(pack(carriers))
        assert found.keys() == carriers.keys()
        for name, array in carriers.items():
            np.testing.assert_array_equal(found[name], array)


@pytest.mark.parametrize("shape", [[4096, 4096, 4096], [2**30, 2**30, 0], [0, 5, 5], [-4, -4, 8]])
def test_frames_that_no_grid_has_are_refused(
    shape: list[int], fitted: tuple[FittedSplashSplat, Run], tmp_path: Path
) -> None:
    fitted[0].liquid.save(tmp_path)
    header = json.loads((tmp_path / "liquid.json").read_text())
    header["grid"]["shape"] = shape
    (tmp_path / "liquid.json").write_text(json.dumps(header))
    with pytest.raises(SplashbenchError, match=r"distance\.npz does not fit|less than two nodes along an axis"):
        Liquid.load(tmp_path)


def test_a_header_that_asks_for_a_huge_decoder_is_refused(
    fitted: tuple[FittedSplashSplat, Run], tmp_path: Path
) -> None:
    fitted[0].liquid.save(tmp_path)
    header = json.loads((tmp_path / "liquid.json").read_text())
    header["decoder"]["color_width"] = 10**9
    (tmp_path / "liquid.json").write_text(json.dumps(header))
    with pytest.raises(SplashbenchError, match="decoder's sizes"):
        Liquid.load(tmp_path)


def test_more_rows_than_there_is_memory_for_are_refused(
    fitted: tuple[FittedSplashSplat, Run], monkeypatch: pytest.MonkeyPatch
) -> None:
    liquid = fitted[0].liquid
    control = rows.whole_velocities(liquid.motion.velocities, liquid.precision)
    stored = rows.store_rows(liquid.carriers, control, liquid.motion, liquid.grid, liquid.precision.steps)
    monkeypatch.setattr(rows, "MAX_ROWS", len(liquid.carriers.ids) - 1)
    with pytest.raises(ValueError, match="rows are more than"):
        rows.read_rows(stored, control, liquid.motion, liquid.phi, liquid.grid, liquid.precision.steps)


def test_phi_is_stored_in_quarters_of_a_voxel_and_keeps_its_sign() -> None:
    packed = np.random.default_rng(0).integers(-127, 128, (5, 4, 3, 6)).astype(np.int8)
    for steps in (signed_distance.reach(2.0, 20.0), signed_distance.reach(2.0, 3.0)):
        coarse = signed_distance.coarse_distance(packed, steps)
        np.testing.assert_array_equal(unpack_distance(pack_distance(coarse), coarse.shape), coarse)
        changes = np.diff(coarse // np.int8(signed_distance.COARSER), axis=0, prepend=np.int8(0))
        np.testing.assert_array_equal(signed_distance.distance_of_changes(changes), coarse)
        np.testing.assert_array_equal(coarse < 0, packed < 0)
        near = np.abs(packed) < 4 * steps
        assert np.abs(coarse.astype(int) - packed)[near].max() <= 2
    assert signed_distance.reach(2.0, 20.0) < signed_distance.reach(2.0, 3.0)


def test_directions_that_no_photograph_shows_cost_nothing() -> None:
    rng = np.random.default_rng(0)
    learned = rng.normal(size=(4000, 6)).astype(np.float32)
    metric = np.diag([1.0, 1.0, 1.0, 1.0, 1e-9, 1e-9])
    stored = values.store_values(learned, Sensitivity(metric, np.ones(4000, np.float32)), 0.1)
    read = values.read_values(stored)
    assert np.abs(read - learned)[:, :4].max() <= 0.1 * 4**0.5
    used = [len(np.unique(row)) for row in stored.coefficients[2]]
    assert min(used[:4]) > 50
    assert max(used[4:]) <= 3


def test_carriers_that_make_up_little_are_stored_more_coarsely() -> None:
    learned = np.random.default_rng(0).normal(size=(1000, 3)).astype(np.float32)
    weights = np.where(np.arange(1000) < 500, 1.0, 1 / 16).astype(np.float32)
    stored = values.store_values(learned, Sensitivity(np.eye(3), weights), 0.05)
    assert set(stored.coarseness[:500]) == {2}
    assert set(stored.coarseness[500:]) == {4}
    assert [part.shape for part in stored.coefficients] == [(3, n) for n in (0, 0, 500, 0, 500, 0)]
    assert np.abs(values.read_values(stored) - learned)[500:].max() > 0.05
    assert np.abs(values.read_values(stored) - learned)[:500].max() < 0.05


def test_sensitivity_is_what_the_derivative_says() -> None:
    # Pixels are a linear function of the values: J' J is known.
    rng = np.random.default_rng(0)
    jacobians = torch.from_numpy(rng.normal(size=(50, 12, 4)).astype(np.float32) * np.array([1, 2, 3, 4], np.float32))
    jacobians[25:] *= 0.1
    signs = np.random.default_rng(1)

    added = Sensitivities(50, 4)
    for _ in range(400):
        drawn = torch.from_numpy(signs.integers(0, 2, (50, 12)).astype(np.float32) * 2 - 1)
        added.add(torch.arange(50), torch.einsum("np,npd->nd", drawn, jacobians))
    found = added.found()
    exact = torch.einsum("npd,npe->de", jacobians, jacobians) / 50 * 400
    np.testing.assert_allclose(found.metric.diagonal(), exact.diagonal(), rtol=0.1)
    assert found.carriers.mean() == pytest.approx(1, abs=1e-3)
    assert found.carriers[:25].mean() / found.carriers[25:].mean() == pytest.approx(100, rel=0.15)


@pytest.mark.parametrize("scale", [0.1, 1.0, 100.0])
def test_the_longest_step_is_found_in_few_trials(scale: float) -> None:
    trials = longest_step(0.03, 0.1, lambda step: Trial(step, scale * step**2, 0, 0))
    best = max(trial.step for trial in trials if trial.added <= 0.03)
    assert 0.85 < best / (0.03 / scale) ** 0.5 <= 1
    assert len(trials) <= 6


def test_where_no_step_is_within_tolerance_the_search_ends() -> None:
    assert len(longest_step(0.01, 0.1, lambda step: Trial(step, 1.0, 0, 0))) < 30


def test_positions_survive_whatever_the_motion_says(fitted: tuple[FittedSplashSplat, Run]) -> None:
    liquid, steps = fitted[0].liquid, fitted[0].liquid.precision.steps
    velocities = np.random.default_rng(0).normal(0, 3, liquid.motion.velocities.shape)
    control = rows.whole_velocities(velocities, liquid.precision)
    stored = rows.store_rows(liquid.carriers, control, liquid.motion, liquid.grid, steps)
    read = rows.read_rows(stored, control, liquid.motion, liquid.phi, liquid.grid, steps)
    np.testing.assert_array_equal(read.positions, liquid.carriers.positions)
    np.testing.assert_array_equal(read.ids, liquid.carriers.ids)


@pytest.mark.parametrize(
    ("pixels", "steps"), [(0.3, 8), (0.88, 8), (0.9, 16), (1.77, 16), (1.79, 32), (9, 32), (None, 32), (0.0, 32)]
)
def test_a_step_is_a_small_part_of_a_pixel(pixels: float | None, steps: int) -> None:
    assert Precision.of(pixels) == Precision(steps)


def test_coarser_steps_take_fewer_bytes(fitted: tuple[FittedSplashSplat, Run]) -> None:
    liquid = fitted[0].liquid
    sizes = []
    for precision in (Precision(32), Precision(16), Precision(8)):
        control = rows.whole_velocities(liquid.motion.velocities, precision)
        stored = rows.store_rows(liquid.carriers, control, liquid.motion, liquid.grid, precision.steps)
        read = rows.read_rows(stored, control, liquid.motion, liquid.phi, liquid.grid, precision.steps)
        # Half a step at most, or in the last cell a whole one.
        assert np.abs(read.positions - liquid.carriers.positions).max() <= 1 / precision.steps
        sizes.append(packed_bytes(vars(stored)))
    assert sizes == sorted(sizes, reverse=True)


@pytest.mark.parametrize("value", [0, 12, 64, -8, 16.5, "16", None, [16], 10**9])
def test_steps_that_no_file_has_are_refused(
    fitted: tuple[FittedSplashSplat, Run], tmp_path: Path, value: object
) -> None:
    fitted[0].liquid.save(tmp_path)
    header = json.loads((tmp_path / "liquid.json").read_text())
    (tmp_path / "liquid.json").write_text(json.dumps(header | {"steps": value}))
    with pytest.raises(SplashbenchError, match="steps of a voxel"):
        Liquid.load(tmp_path)


@pytest.mark.parametrize(
    "change",
    [
        lambda header: header["times"].__setitem__(1, float("nan")),
        lambda header: header.update(times=header["times"][::-1]),
        lambda header: header.update(times=[]),
        lambda header: header["grid"].update(voxel=float("nan")),
        lambda header: header["grid"].update(voxel=-1.0),
        lambda header: header["grid"].update(shape=[1, *header["grid"]["shape"][1:]]),
        lambda header: header["grid"].update(origin=[0.0, float("inf"), 0.0]),
        lambda header: header["decoder"].update(opacity_slope=float("nan")),
        lambda header: header.update(factor=[2.0, float("nan"), 2.0]),
        lambda header: header.update(factor=[float("inf")] * 3),
        lambda header: header.update(factor=[2.0, 2.0, 0.0]),
        lambda header: header.update(factor=0),
        lambda header: header.update(factor=float("inf")),
        lambda header: header["grid"]["shape"].__setitem__(0, float("inf")),
    ],
)
def test_numbers_that_no_model_has_are_refused(
    fitted: tuple[FittedSplashSplat, Run], tmp_path: Path, change: Callable[[dict], object]
) -> None:
    """They would become indices of kernels, which read where there is nothing."""
    fitted[0].liquid.save(tmp_path)
    header = json.loads((tmp_path / "liquid.json").read_text())
    change(header)
    (tmp_path / "liquid.json").write_text(json.dumps(header))
    with pytest.raises(SplashbenchError, match=r"liquid.json is not a SplashSplat model"):
        Liquid.load(tmp_path)


def uncoded(liquid: Liquid, directory: Path, version: int) -> None:
    """`liquid` as format 6 has it: the numbers themselves. version: what its header says."""
    liquid.save(directory)
    header = json.loads((directory / "liquid.json").read_text())
    (directory / "liquid.json").write_text(json.dumps(header | {"format": version}))
    for name, arrays in liquid.arrays.items():
        np.savez(directory / f"{name}.npz", **arrays)
    whole = np.asarray(liquid.phi) // np.int8(signed_distance.COARSER)
    np.savez(directory / "distance.npz", phi=np.diff(whole, axis=0, prepend=np.int8(0)))


def test_a_model_of_format_6_is_read_as_it_was(fitted: tuple[FittedSplashSplat, Run], tmp_path: Path) -> None:
    liquid = fitted[0].liquid
    uncoded(liquid, tmp_path, 6)
    before = sum((tmp_path / name).stat().st_size for name in FILES)
    loaded = Liquid.load(tmp_path)
    np.testing.assert_array_equal(loaded.carriers.positions, liquid.carriers.positions)
    np.testing.assert_array_equal(loaded.phi, liquid.phi)
    torch.testing.assert_close(loaded.appearance.features, liquid.appearance.features, rtol=0, atol=0)
    loaded.save(tmp_path)  # as it would be today
    assert json.loads((tmp_path / "liquid.json").read_text())["format"] == 7
    assert sum((tmp_path / name).stat().st_size for name in FILES) < before
    np.testing.assert_array_equal(Liquid.load(tmp_path).carriers.positions, liquid.carriers.positions)
    with np.load(tmp_path / "distance.npz") as stored:
        code = stored["phi"]
    uncoded(liquid, tmp_path, 6)
    for phi in (np.full((*liquid.phi.shape,), 100, np.int8), np.zeros((2, *liquid.grid.shape), np.int8), code):
        np.savez(tmp_path / "distance.npz", phi=phi)
        with pytest.raises(SplashbenchError, match=r"distance\.npz"):
            Liquid.load(tmp_path)


def test_a_model_of_format_5_is_read_as_it_was(fitted: tuple[FittedSplashSplat, Run], tmp_path: Path) -> None:
    liquid = fitted[0].liquid
    uncoded(liquid, tmp_path, 5)
    header = json.loads((tmp_path / "liquid.json").read_text())
    steps = header.pop("steps")
    (tmp_path / "liquid.json").write_text(json.dumps(header))
    with np.load(tmp_path / "appearance.npz") as stored:
        look = dict(stored)
    parts = [look.pop(f"coefficients.{level}") for level in range(6)]
    joined = np.zeros((len(look["center"]), len(look["coarseness"])), np.int32)
    for level, part in enumerate(parts):
        joined[:, look["coarseness"] == level] = part
    look |= {"coefficients": joined, "basis": 4 * look["basis"], "coarseness": look["coarseness"].astype(np.int8) - 2}
    np.savez(tmp_path / "appearance.npz", **look)
    with np.load(tmp_path / "carriers.npz") as stored:
        carriers = dict(stored)
    with np.load(tmp_path / "motion.npz") as stored:
        motion = dict(stored)
    finer = 32 // steps
    np.savez(tmp_path / "motion.npz", **(motion | {"velocities": finer * motion["velocities"].astype(np.int16)}))
    # Whole steps become finer ones; what the motion says is rounded to those, which takes other misses.
    fine = Precision()
    control = rows.whole_velocities(liquid.motion.velocities, fine)
    moved = rows.store_rows(liquid.carriers, control, liquid.motion, liquid.grid, fine.steps)
    np.savez(tmp_path / "carriers.npz", **(carriers | vars(moved)))
    loaded = Liquid.load(tmp_path)
    np.testing.assert_array_equal(loaded.carriers.positions, liquid.carriers.positions)
    torch.testing.assert_close(loaded.appearance.features, liquid.appearance.features, rtol=0, atol=0)
    torch.testing.assert_close(loaded.appearance.log_scales, liquid.appearance.log_scales, rtol=0, atol=0)
    np.savez(tmp_path / "appearance.npz", **(look | {"coarseness": look["coarseness"] - 3}))
    with pytest.raises(SplashbenchError, match=r"appearance\.npz does not fit"):
        Liquid.load(tmp_path)


def test_a_model_of_an_earlier_version_is_read_but_not_written(
    fitted: tuple[FittedSplashSplat, Run], tmp_path: Path
) -> None:
    liquid = fitted[0].liquid
    carriers, look = liquid.carriers, liquid.appearance
    header = {
        "format": 3,
        "times": [float(t) for t in liquid.times],
        "grid": {"origin": liquid.grid.origin.tolist(), "voxel": liquid.grid.voxel, "shape": liquid.grid.shape},
        "factor": liquid.motion.factor,
        "carriers": carriers.count,
        "carried": True,
        "decoder": dict(vars(look.decoder.settings)),
    }
    (tmp_path / "liquid.json").write_text(json.dumps(header))
    steps = np.float32(65535 / max(liquid.grid.shape))
    np.savez(
        tmp_path / "carriers.npz",
        starts=carriers.starts,
        ids=carriers.ids,
        positions=np.round(carriers.positions * steps).astype(np.uint16),
        deformation=carriers.deformation.astype(np.float16),
        phi=carriers.phi.astype(np.float16),
    )
    jets = np.zeros((len(liquid.times) - 1, 9))
    np.savez(tmp_path / "velocity.npz", velocities=liquid.motion.velocities, jets=jets, turn=np.eye(3))
    np.savez(tmp_path / "phi.npz", phi=liquid.phi)
    heads = {f"heads.{name}": value.numpy() for name, value in look.decoder.state_dict().items()}
    np.savez(tmp_path / "appearance.npz", features=look.features.numpy(), log_scales=look.log_scales.numpy(), **heads)
    loaded = Liquid.load(tmp_path)
    np.testing.assert_allclose(loaded.carriers.positions, carriers.positions, atol=1e-2)
    torch.testing.assert_close(loaded.appearance.features, look.features)
    with pytest.raises(SplashbenchError, match="earlier version"):
        loaded.save(tmp_path)
    # Version 0.1 spelled the heads "colour".
    header["decoder"]["colour_width"] = header["decoder"].pop("color_width")
    (tmp_path / "liquid.json").write_text(json.dumps(header))
    british = {name.replace("color", "colour"): head for name, head in heads.items()}
    np.savez(tmp_path / "appearance.npz", features=look.features.numpy(), log_scales=look.log_scales.numpy(), **british)
    torch.testing.assert_close(Liquid.load(tmp_path).appearance.decoder.state_dict(), look.decoder.state_dict())


@pytest.mark.parametrize("factor", [4, (3.7, 4.2, 1.0)])
def test_predictions_are_those_of_single_operations_in_double_precision(factor) -> None:
    """Files are read by the same numbers that wrote them: here they are, written another way."""
    rng = np.random.default_rng(0)
    control = rng.integers(-600, 600, (9, 8, 11, 3)).astype(np.int16)
    steps = rng.integers(0, 40 * 16, (20_000, 3))
    wide = np.array(factors(factor), dtype=np.float64)
    place = np.clip((steps / 16 - 0.5 * (wide - 1)) / wide, 0, np.array(control.shape[:3]) - 1)
    low = np.minimum(np.floor(place).astype(np.int64), np.array(control.shape[:3]) - 2)
    sides = (1 - (place - low), place - low)
    moved = np.zeros(steps.shape)
    for a, b, c in np.ndindex(2, 2, 2):
        weight = sides[a][:, 0] * sides[b][:, 1] * sides[c][:, 2]
        moved = moved + weight[:, None] * control[low[:, 0] + a, low[:, 1] + b, low[:, 2] + c]
    expected = steps + np.rint(moved / 2).astype(np.int64)
    found = rows._predicted(steps, control, Motion(control.astype(np.float32), factor, []), 16)
    np.testing.assert_array_equal(found, expected)

"""The compiled step of the velocity's descent against plain NumPy in double precision."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from splashbench.native.threads import use_threads
from splashbench_methods.splashsplat.kernel.descend import Descent
from splashbench_methods.splashsplat.motion.velocity import (
    band_nodes,
    cell_numbers,
    control_shape,
    factors,
    velocities_at,
    with_gradient,
)

SHAPE = (19, 14, 23)


def sampled(field: np.ndarray, places: np.ndarray) -> np.ndarray:
    """`field` [nx, ny, nz, C] at `places` [N, 3], clamped to the grid, [N, C]."""
    places = np.clip(places, 0, np.array(field.shape[:3]) - 1)
    low = np.minimum(np.floor(places).astype(int), np.array(field.shape[:3]) - 2)
    share = places - low
    total = np.zeros((len(places), field.shape[3]))
    for corner in np.ndindex(2, 2, 2):
        weight = np.prod(np.where(corner, share, 1 - share), axis=1)
        total += weight[:, None] * field[tuple((low + corner).T)]
    return total


def case(factor: Any = 4, seed: int = 0, fast: float = 3.0) -> dict[str, Any]:
    rng = np.random.default_rng(seed)
    before, after = (rng.uniform(-6, 6, SHAPE).astype(np.float32) for _ in range(2))
    coarse = control_shape(SHAPE, factor)
    nodes, starts = band_nodes(before, after, 2.0, factor, coarse)
    control = rng.normal(0, fast, (*coarse, 3)).astype(np.float32)
    return {
        "before": before,
        "after": after,
        "factor": factor,
        "coarse": coarse,
        "nodes": nodes,
        "starts": starts,
        "control": control,
    }


def descent(given: dict[str, Any]) -> Descent:
    beside = with_gradient(given["before"])
    factor = factors(given["factor"])
    return Descent(beside, given["after"], given["nodes"], given["starts"], given["coarse"], factor)


@pytest.mark.parametrize("factor", [4, 1, (3.2, 2.0, 5.5)])
def test_a_step_is_the_sum_of_its_nodes_displacements(factor):
    given = case(factor)
    update, residual = descent(given).step(given["control"], 0.45)
    nodes, coarse = given["nodes"], given["coarse"]
    u = velocities_at(given["control"], factor, nodes)
    there = sampled(with_gradient(given["before"]).astype(np.float64), nodes - u)
    error = given["after"][tuple(nodes.T)] - there[:, 0]
    moves = -0.45 * (error / ((there[:, 1:] ** 2).sum(axis=1) + 0.05))[:, None] * there[:, 1:]
    expected = np.zeros((int(np.prod(coarse)), 3))
    np.add.at(expected, cell_numbers(nodes, factor, coarse), moves)
    np.testing.assert_allclose(update.reshape(-1, 3), expected, atol=2e-3)
    assert residual == pytest.approx(np.abs(error).mean(), rel=1e-4)


def test_the_number_of_threads_does_not_matter():
    given = case(1)
    found = []
    for threads in (1, 2, 5):
        with use_threads(threads):
            found.append(descent(given).step(given["control"], 0.45))
    for update, residual in found[1:]:
        np.testing.assert_array_equal(update, found[0][0])
        assert residual == found[0][1]


def test_motions_out_of_the_grid_and_what_is_no_number_read_the_grid_and_nothing_else():
    given = case(fast=500.0)
    assert np.isfinite(descent(given).step(given["control"], 0.45)[0]).all()
    given["control"][:] = np.nan
    descent(given).step(given["control"], 0.45)
    given["control"][:] = np.inf
    descent(given).step(given["control"], 0.45)


def test_without_nodes_nothing_moves():
    given = case()
    given["nodes"], given["starts"] = np.zeros((0, 3), np.int32), np.zeros_like(given["starts"])
    update, residual = descent(given).step(given["control"], 0.45)
    assert not update.any()
    assert residual == 0


@pytest.mark.parametrize(
    ("name", "value", "message"),
    [
        ("after", np.zeros(SHAPE), "after is not contiguous float32"),
        ("after", np.zeros((19, 14, 22), np.float32), r"before is \[19, 14, 23, 4\], not \[19, 14, 22, 4\]"),
        ("nodes", np.zeros((3, 3), np.int64), "nodes is not contiguous int32"),
        ("nodes", np.full((3, 3), 14, np.int32), "nodes are outside the grid"),
        ("nodes", np.full((3, 3), -1, np.int32), "nodes are outside the grid"),
        ("starts", np.zeros(7, np.int64), r"starts is \[7\], not \[121\]"),
        ("starts", np.zeros(121, np.int64), "starts do not rise from 0 to the number of nodes"),
        ("factor", (4.0, 0.0, 4.0), "factor .* is not positive"),
        ("coarse", (1, 4, 30), r"grids of .* have no cell along an axis"),
    ],
)
def test_what_does_not_fit_is_named(name: str, value: Any, message: str):
    given = case()
    assert given["coarse"] == (5, 4, 6)
    coarse = given["coarse"]
    if name == "coarse":
        given["starts"] = np.linspace(0, len(given["nodes"]), 121).astype(np.int64)
    given[name] = value
    beside = with_gradient(given["before"])
    with pytest.raises((TypeError, ValueError), match=message):
        Descent(
            beside,
            given["after"],
            given["nodes"],
            given["starts"],
            given["coarse"],
            given["factor"] if name == "factor" else factors(4),
        )
    assert coarse == (5, 4, 6)


def test_a_velocity_of_another_grid_is_refused():
    given = case()
    with pytest.raises(ValueError, match=r"control is \[5, 4, 5, 3\], not \[5, 4, 6, 3\]"):
        descent(given).step(given["control"][:, :, :5], 0.45)


@pytest.mark.parametrize("factor", [4, (3.2, 2.0, 5.5)])
def test_nodes_are_those_near_either_surface_by_control_cell(factor):
    given = case(factor)
    near = np.argwhere((np.abs(given["before"]) < 2) | (np.abs(given["after"]) < 2))
    cells = cell_numbers(near, factor, given["coarse"])
    order = np.argsort(cells, kind="stable")
    np.testing.assert_array_equal(given["nodes"], near[order])
    np.testing.assert_array_equal(np.diff(given["starts"]), np.bincount(cells, minlength=len(given["starts"]) - 1))


def test_gradients_are_central_differences():
    phi = case()["before"]
    beside = with_gradient(phi)
    np.testing.assert_array_equal(beside[..., 0], phi)
    np.testing.assert_allclose(beside[..., 1:], np.stack(np.gradient(phi), axis=-1), atol=1e-5)

"""The compiled decoder against SplashSplat's own in plain torch and float64, and the compiled Adam against torch's."""

from __future__ import annotations

import copy
import math
from collections import defaultdict
from dataclasses import replace

import numpy as np
import pytest
import torch
from hypothesis import example, given, settings
from hypothesis import strategies as st

from splashbench.native.threads import use_threads
from splashbench_methods.splashsplat.appearance.decoder import ColorCells, Decoder, DecoderSettings, penalties
from splashbench_methods.splashsplat.appearance.optimizer import TorchRowMoments
from splashbench_methods.splashsplat.carriers.subframe import CarrierState
from splashbench_methods.splashsplat.kernel.decode import Instant, decode
from splashbench_methods.splashsplat.kernel.row_adam import RowMoments

Case = tuple[Decoder, torch.Tensor, torch.Tensor, torch.Tensor, CarrierState, torch.Tensor, ColorCells]


def case(n: int, seed: int = 0, hidden_from_view: bool = False, **sizes: int) -> Case:
    """A decoder with weights of some size; features and log scales of n + 3 carriers, and which n are active; their
    state, the eye, and their cells."""
    torch.manual_seed(seed)
    decoder = Decoder(DecoderSettings(offset_bound=0.8, **sizes))
    with torch.no_grad():
        for parameter in decoder.parameters():
            parameter.add_(0.3 * torch.randn(parameter.shape))
    rows = torch.randperm(n + 3)[:n].sort().values
    visibility = torch.rand(n) if hidden_from_view else None
    deformation = torch.eye(3) + 0.3 * torch.randn(n, 3, 3)
    state = CarrierState(3 * torch.randn(n, 3), deformation, 4 * torch.randn(n), visibility)
    _, cells, counts = torch.unique(torch.randint(0, n // 3 + 1, (n,)), return_inverse=True, return_counts=True)
    features, log_scales = torch.randn(n + 3, decoder.settings.feature_size), torch.randn(n + 3, 3) - 2
    return decoder, features, log_scales, rows, state, torch.tensor([1.0, -2, 3]), ColorCells(cells, counts.float())


class PlainDecoder(Decoder):
    """The definition in torch, in single precision as well."""

    def decode(self, features, log_scales, rows, state, eye, cells=None):
        children = self(features[rows], log_scales[rows], state, eye)
        return children, None if cells is None else penalties(children, cells)


def plain(sample: Case) -> Case:
    """The same case, decoded by plain torch."""
    decoder = PlainDecoder(sample[0].settings)
    decoder.load_state_dict(sample[0].state_dict())
    return decoder, *sample[1:]


def outcome(sample: Case, dtype: torch.dtype) -> dict[str, torch.Tensor]:
    """Children, penalties, and the gradients of a sum of all of them with weights."""
    decoder, features, log_scales, rows, state, eye, cells = sample
    decoder = copy.deepcopy(decoder).to(dtype)
    tables = [table.to(dtype, copy=True).requires_grad_() for table in (features, log_scales)]
    state = CarrierState(*[None if value is None else value.to(dtype) for value in vars(state).values()])
    cells = replace(cells, sizes=cells.sizes.to(dtype))
    children, penalties = decoder.decode(*tables, rows, state, eye.to(dtype), cells if len(rows) else None)
    every = vars(children) | ({} if penalties is None else vars(penalties))
    values = {name: value for name, value in every.items() if value is not None}
    generator = torch.Generator().manual_seed(7)
    loss = torch.zeros((), dtype=dtype)
    for name, value in values.items():
        weight = torch.randn(value.shape, generator=generator, dtype=torch.float64)
        loss = loss + (value * weight.to(dtype)).sum() * (1 if name in vars(children) else len(rows))  # means
    (*by_tables,) = torch.autograd.grad(loss, [*tables, *decoder.parameters()])
    names = ["features", "log_scales", *dict(decoder.named_parameters())]
    gradients = {f"grad {name}": grad.to_dense() if grad.is_sparse else grad for name, grad in zip(names, by_tables)}
    return {name: value.detach() for name, value in values.items()} | gradients


def assert_same(
    got: dict[str, torch.Tensor], expected: dict[str, torch.Tensor], plain: dict[str, torch.Tensor]
) -> None:
    """`got` is as near to `expected`, in double precision, as single precision allows: `plain` shows how near that is.

    Gradients of weights are sums over the carriers whose terms may cancel; how much is lost by that, only the
    definition in single precision can tell. Weight and bias of a layer have one yardstick.
    """
    assert got.keys() == expected.keys() == plain.keys()
    errors, unavoidable, sizes = defaultdict(list), defaultdict(list), defaultdict(list)
    for name, value in expected.items():
        assert got[name].shape == value.shape
        assert got[name].dtype == plain[name].dtype == torch.float32
        layer = name.removesuffix(".weight").removesuffix(".bias")
        errors[layer].append(float((got[name].double() - value).norm()))
        unavoidable[layer].append(float((plain[name].double() - value).norm()))
        sizes[layer].append(float(value.norm()))
    for layer, own in errors.items():
        limit = 1e-5 * math.hypot(*sizes[layer]) + 4 * math.hypot(*unavoidable[layer]) + 1e-9
        assert math.hypot(*own) <= limit, f"{layer} is off by {own}"


@example(n=2, feature_size=24, children=1, color_width=1, hidden_from_view=True, seed=163)  # terms cancel
@settings(max_examples=25, deadline=None, derandomize=True)
@given(
    n=st.sampled_from([0, 1, 2, 63, 64, 65, 130, 600]),
    feature_size=st.integers(1, 40),
    children=st.integers(1, 6),
    color_width=st.sampled_from([1, 5, 8, 33, 64]),
    hidden_from_view=st.booleans(),
    seed=st.integers(0, 1000),
)
def test_children_and_gradients_are_those_of_the_definition(n, seed, hidden_from_view, **sizes):
    sample = case(n, seed, hidden_from_view, **sizes)
    assert_same(outcome(sample, torch.float32), outcome(sample, torch.float64), outcome(plain(sample), torch.float32))


def test_the_number_of_threads_does_not_matter():
    results = []
    for threads in (1, 2, 5):
        with use_threads(threads):
            results.append(outcome(case(3000), torch.float32))
    for other in results[1:]:
        assert all(torch.equal(value, other[name]) for name, value in results[0].items())


def test_gradients_of_tables_name_the_rows_that_were_used():
    decoder, features, log_scales, rows, state, eye, _ = case(5)
    children, _ = decoder.decode(features.requires_grad_(), log_scales, rows, state, eye)
    (gradient,) = torch.autograd.grad(children.means.sum(), [features])
    assert gradient.is_coalesced()
    assert torch.equal(gradient.indices()[0], rows)
    assert gradient.values().shape == (5, 32)


def test_without_rows_the_tables_are_the_carriers_own():
    decoder, features, log_scales, rows, state, eye, _ = case(5)
    instant = Instant(state.positions, state.deformation, state.phi, eye)
    picked = features[rows].requires_grad_()
    decoded = decode(decoder.heads(), picked, log_scales[rows], instant)
    assert decoded.penalties is None
    assert torch.equal(decoded.means, decoder.decode(features, log_scales, rows, state, eye)[0].means)
    decoded.means.sum().backward()
    assert picked.grad.shape == (5, 32)


def test_what_is_not_a_number_stays_one():
    decoder, features, log_scales, rows, state, eye, _ = case(70)
    features[rows[66]] = float("nan")
    children, _ = decoder.decode(features, log_scales, rows, state, eye)
    for value in (children.means, children.factors, children.opacities, children.colors):
        assert torch.isnan(value[66]).all()
        assert torch.isfinite(value[:66]).all()


@pytest.mark.parametrize(
    ("change", "error", "message"),
    [
        ({"rows": torch.tensor([0, 1, 2, 4, 3])}, ValueError, "rows is not ascending"),
        ({"rows": torch.tensor([0, 1, 2, 3, 8])}, ValueError, "rows holds numbers outside 0 to 7"),
        ({"rows": torch.tensor([-1, 1, 2, 3, 4])}, ValueError, "rows holds numbers outside 0 to 7"),
        ({"rows": torch.arange(5, dtype=torch.int32)}, TypeError, "rows is torch.int32"),
        ({"cells": torch.tensor([0, 1, 2, 0, 1])}, ValueError, "cells holds numbers outside 0 to 1"),
        ({"phi": torch.zeros(4)}, ValueError, r"positions is \[5, 3\], not \[n = 4, 3 = 3\]"),
        ({"features": torch.zeros(8, 31)}, ValueError, r"offset weight is \[6, 32\]"),
        ({"features": torch.zeros(8, 32).double()}, TypeError, "features is torch.float64 on cpu"),
    ],
)
def test_what_does_not_fit_is_refused(change, error, message):
    decoder, features, log_scales, rows, state, eye, _ = case(5)
    instant = Instant(state.positions, state.deformation, state.phi, eye, cells=torch.zeros(5).long(), cell_count=2)
    tables = {"features": features, "rows": rows}
    for name, value in change.items():
        if name in tables:
            tables[name] = value
        else:
            instant = replace(instant, **{name: value})
    with pytest.raises(error, match=message):
        decode(decoder.heads(), tables["features"], log_scales, instant, tables["rows"])


@pytest.mark.parametrize("kind", [RowMoments, TorchRowMoments])
@pytest.mark.parametrize("width", [1, 3, 32, 37])
def test_adam_moves_like_torchs_and_leaves_other_rows_alone(kind, width):
    torch.manual_seed(width)
    start = torch.randn(50, width)
    table, rows = start.clone(), torch.randperm(50)[:20].sort().values
    others = torch.tensor([i for i in range(50) if i not in rows.tolist()])
    parameter = start[rows].double().requires_grad_()
    ours, theirs = kind(table, (0.9, 0.999), 1e-8), torch.optim.Adam([parameter], lr=0.1)
    for _ in range(300):
        gradient = torch.randn(20, width)
        parameter.grad = gradient.double()
        theirs.step()
        ours.step(rows, gradient, 0.1)
    np.testing.assert_allclose(table[rows], parameter.detach(), rtol=0, atol=2e-4)  # of steps that add up to ten
    assert torch.equal(table[others], start[others])


def test_adam_moves_many_rows_alike_on_any_number_of_threads():
    """Several pieces of rows, which threads share; torch moves the same table."""
    start, gradient = torch.randn(5000, 7), torch.randn(5000, 7)
    tables = []
    for threads in (1, 2, 5):
        table = start.clone()
        with use_threads(threads):
            RowMoments(table).step(torch.arange(5000), gradient, 0.1)
        tables.append(table)
    assert all(torch.equal(table, tables[0]) for table in tables)
    parameter = start.double().requires_grad_()
    parameter.grad = gradient.double()
    torch.optim.Adam([parameter], lr=0.1).step()
    np.testing.assert_allclose(tables[0], parameter.detach(), rtol=0, atol=1e-5)


def test_adam_counts_the_steps_of_each_row():
    table = torch.zeros(3, 4)
    adam = RowMoments(table)
    for step in range(3):
        adam.step(torch.arange(step, 3), torch.ones(3 - step, 4), 0.1)
    # The first steps of Adam along a constant gradient are as long as its rate.
    np.testing.assert_allclose(table, [[-0.1] * 4, [-0.2] * 4, [-0.3] * 4], rtol=1e-5)


@pytest.mark.parametrize(
    ("rows", "gradient", "error", "message"),
    [
        (torch.tensor([0, 3]), torch.ones(2, 4), ValueError, "rows holds numbers outside 0 to 2"),
        (torch.tensor([0, 1]), torch.ones(2, 5), ValueError, r"gradient is \[2, 5\], not \[2, 4\]"),
        (torch.tensor([0.0]), torch.ones(1, 4), TypeError, "rows is torch.float32"),
        (torch.tensor([0]), torch.ones(1, 4).double(), TypeError, "gradient is torch.float64"),
    ],
)
def test_a_step_that_does_not_fit_is_refused(rows, gradient, error, message):
    with pytest.raises(error, match=message):
        RowMoments(torch.zeros(3, 4)).step(rows, gradient, 0.1)
    with pytest.raises(TypeError, match=r"table is not a contiguous float32 \[rows, width\] on the CPU"):
        RowMoments(torch.zeros(3, 4).T)

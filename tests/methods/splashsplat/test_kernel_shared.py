"""The compiled sums of shared rows against torch's index_select and index_add_."""

from __future__ import annotations

import pytest
import torch
from hypothesis import example, given, settings
from hypothesis import strategies as st

from splashbench.native.threads import use_threads
from splashbench_methods.splashsplat.kernel.library import KERNEL, MAX_LEVELS
from splashbench_methods.splashsplat.kernel.shared import SharedRows, added_by_member


def _tables(
    count: int, width: int, levels: int, seed: int
) -> tuple[torch.Tensor, list[torch.Tensor], list[torch.Tensor]]:
    torch.manual_seed(seed)
    sizes = [1 + count // (2 + level) for level in range(levels)]
    tables = [torch.randn(size, width) for size in sizes]
    return torch.randn(count, width), tables, [torch.randint(0, size, (count,), dtype=torch.int32) for size in sizes]


def _expected(
    own: torch.Tensor, tables: list[torch.Tensor], cells: list[torch.Tensor], ids: torch.Tensor
) -> torch.Tensor:
    sums = own.index_select(0, ids)
    for table, of_carriers in zip(tables, cells):
        sums += table.index_select(0, of_carriers.index_select(0, ids))
    return sums


@settings(deadline=None, max_examples=40)
@given(st.integers(1, 900), st.integers(1, 40), st.integers(0, MAX_LEVELS), st.integers(0, 99))
@example(5000, 16, 3, 0)
def test_sums_are_those_of_torch_to_the_last_bit(count, width, levels, seed):
    own, tables, cells = _tables(count, width, levels, seed)
    ids = torch.randint(0, count, (count // 2,))
    assert torch.equal(SharedRows(own, tables, cells).of(ids), _expected(own, tables, cells, ids))


@settings(deadline=None, max_examples=40)
@given(st.integers(0, 900), st.integers(1, 40), st.integers(1, 50), st.booleans(), st.integers(0, 99))
def test_rows_are_added_by_group_in_their_order(count, width, groups, some, seed):
    torch.manual_seed(seed)
    members = torch.randint(0, groups, (count,), dtype=torch.int32)
    places = torch.randperm(count)[: count // 2] if some else None
    rows = torch.randn(count if places is None else len(places), width)
    expected = torch.zeros(groups, width)
    for row, place in zip(rows, range(count) if places is None else places.tolist()):
        expected[int(members[place])] += row
    assert torch.equal(added_by_member(rows, members, groups, places), expected)


def test_what_changed_in_the_tables_counts():
    own, tables, cells = _tables(30, 4, 2, 0)
    shared, ids = SharedRows(own, tables, cells), torch.arange(30)
    own += 1
    tables[1] *= 2
    assert torch.equal(shared.of(ids), _expected(own, tables, cells, ids))


def test_threads_change_nothing():
    own, tables, cells = _tables(20_000, 16, 4, 1)
    shared, ids = SharedRows(own, tables, cells), torch.randperm(20_000)
    with use_threads(1):
        alone = shared.of(ids)
    with use_threads(4):
        assert torch.equal(alone, shared.of(ids))


@pytest.mark.parametrize("variant", KERNEL.built_variants())
def test_every_variant_adds_the_same(variant, monkeypatch):
    if not KERNEL.runs(variant):
        pytest.skip(f"this processor does not run {variant}")
    monkeypatch.setitem(KERNEL.__dict__, "library", KERNEL.open_variant(variant))
    own, tables, cells = _tables(300, 19, 3, 2)
    ids = torch.randint(0, 300, (200,))
    assert torch.equal(SharedRows(own, tables, cells).of(ids), _expected(own, tables, cells, ids))


@pytest.mark.parametrize(
    ("change", "error", "says"),
    [
        ({"own": torch.zeros(5, 3, dtype=torch.float64)}, TypeError, "own is torch.float64"),
        ({"own": torch.zeros(3, 5).T}, TypeError, "own is"),
        ({"tables": [torch.zeros(2, 4)]}, ValueError, "table 0 is"),
        ({"tables": []}, ValueError, "0 tables and 1 columns"),
        ({"cells": [torch.zeros(5, dtype=torch.int64)]}, TypeError, "cells 0 is torch.int64"),
        ({"cells": [torch.zeros(4, dtype=torch.int32)]}, ValueError, "cells 0 is"),
        ({"cells": [torch.full((5,), 2, dtype=torch.int32)]}, ValueError, "outside 0 to 1"),
        ({"ids": torch.tensor([5])}, ValueError, "outside 0 to 4"),
        ({"ids": torch.tensor([-1])}, ValueError, "outside 0 to 4"),
        ({"ids": torch.tensor([1], dtype=torch.int32)}, TypeError, "ids is torch.int32"),
    ],
)
def test_what_does_not_fit_is_named_before_it_is_read(change, error, says):
    values = {
        "own": torch.zeros(5, 3),
        "tables": [torch.zeros(2, 3)],
        "cells": [torch.zeros(5, dtype=torch.int32)],
        "ids": torch.tensor([0]),
    } | change
    with pytest.raises(error, match=says):
        SharedRows(values["own"], values["tables"], values["cells"]).of(values["ids"])


@pytest.mark.parametrize(
    ("change", "error", "says"),
    [
        ({"rows": torch.zeros(3, 3)}, ValueError, r"rows is \[3, 3\]"),
        ({"rows": torch.zeros(2)}, ValueError, r"rows is \[2\]"),
        ({"members": torch.tensor([0, 4], dtype=torch.int32)}, ValueError, "outside 0 to 3"),
        ({"members": torch.tensor([0, 1])}, TypeError, "members is torch.int64"),
        ({"places": torch.tensor([0, 2])}, ValueError, "places holds numbers outside 0 to 1"),
        ({"places": torch.tensor([0, 1], dtype=torch.int32)}, TypeError, "places is torch.int32"),
    ],
)
def test_groups_that_do_not_fit_are_named(change, error, says):
    values = {"rows": torch.zeros(2, 3), "members": torch.tensor([0, 3], dtype=torch.int32), "places": None} | change
    with pytest.raises(error, match=says):
        added_by_member(values["rows"], values["members"], 4, values["places"])

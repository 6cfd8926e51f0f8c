"""Cells numbered without gaps."""

from __future__ import annotations

import numpy as np

from splashbench_methods.splashsplat.appearance.cells import cell_numbers


def test_cells_are_numbered_in_the_order_of_their_rows():
    rng = np.random.default_rng(0)
    for spread in (1, 7, 10**5):  # all in a few cells, and more room than an int64 can count
        cells = rng.integers(-spread, spread + 1, (500, 4))
        distinct = sorted({tuple(row) for row in cells.tolist()})
        assert cell_numbers(cells).tolist() == [distinct.index(tuple(row)) for row in cells.tolist()]
    assert len(cell_numbers(np.zeros((0, 4), dtype=np.int64))) == 0

"""Adam over the rows of tables of which each iteration touches only a few.

An iteration sees the carriers of one frame. Dense Adam would move every carrier of the sequence at every iteration,
by momentum alone; here a row moves, and its moments decay, only when it has a gradient (Adam, Kingma and Ba 2015,
with a step count per row).
"""

from __future__ import annotations

import torch
from torch import Tensor

_BETA1, _BETA2, _EPSILON = 0.9, 0.999, 1e-8


class RowAdam:
    """Adam for one table [rows, width], updated in place."""

    def __init__(self, table: Tensor, learning_rate: float) -> None:
        self.table = table
        self.learning_rate = learning_rate
        self._first = torch.zeros_like(table)
        self._second = torch.zeros_like(table)
        self._steps = torch.zeros(len(table), 1)

    @torch.no_grad()
    def step(self, rows: Tensor, gradient: Tensor, factor: float = 1.0) -> None:
        """Update `rows` (int64 [n], each at most once) with their `gradient` [n, width]; `factor` scales the rate."""
        # index_select and index_copy_ move whole rows; indexing with [] is several times slower.
        steps = self._steps.index_select(0, rows).add_(1)
        first = self._first.index_select(0, rows).mul_(_BETA1).add_(gradient, alpha=1 - _BETA1)
        second = self._second.index_select(0, rows).mul_(_BETA2).addcmul_(gradient, gradient, value=1 - _BETA2)
        for moments, values in ((self._steps, steps), (self._first, first), (self._second, second)):
            moments.index_copy_(0, rows, values)
        unbiased = first / (1 - _BETA1**steps)
        spread = (second / (1 - _BETA2**steps)).sqrt_().add_(_EPSILON)
        step = unbiased.mul_(self.learning_rate * factor).div_(spread)
        self.table.index_copy_(0, rows, self.table.index_select(0, rows).sub_(step))

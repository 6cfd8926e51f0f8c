"""Adam over the rows of tables of which each iteration touches only a few.

An iteration sees the carriers of one frame. Dense Adam would move every carrier of the sequence at every iteration,
by momentum alone. Here a row moves, and its moments decay, only when it has a gradient (Adam, Kingma and Ba 2015, with
a step count per row).
"""

from __future__ import annotations

import torch
from torch import Tensor

from ..kernel.row_adam import RowMoments

_BETA1, _BETA2, _EPSILON = 0.9, 0.999, 1e-8


class RowAdam:
    """Adam for one table [rows, width], updated in place: on the CPU by a kernel, elsewhere by torch."""

    def __init__(self, table: Tensor, learning_rate: float) -> None:
        self.table = table.detach()
        self.learning_rate = learning_rate
        on_cpu = table.device.type == "cpu" and table.dtype == torch.float32
        self._state: RowMoments | TorchRowMoments = (RowMoments if on_cpu else TorchRowMoments)(
            self.table, (_BETA1, _BETA2), _EPSILON
        )

    def step(self, rows: Tensor, gradient: Tensor, factor: float = 1.0) -> None:
        """Update `rows` (int64 [n], each at most once) with their `gradient` [n, width]; `factor` scales the rate."""
        self._state.step(rows, gradient, self.learning_rate * factor)


class TorchRowMoments:
    """What splashbench_methods.splashsplat.kernel.row_adam.RowMoments does, in plain torch on any device."""

    def __init__(self, table: Tensor, betas: tuple[float, float], epsilon: float) -> None:
        self._table, self._betas, self._epsilon = table, betas, epsilon
        self._first, self._second = torch.zeros_like(table), torch.zeros_like(table)
        self._steps = table.new_zeros(len(table), 1)

    @torch.no_grad()
    def step(self, rows: Tensor, gradient: Tensor, rate: float) -> None:
        """Move `rows` down their `gradient`."""
        beta1, beta2 = self._betas
        # index_select and index_copy_ move whole rows; indexing with [] is several times slower.
        steps = self._steps.index_select(0, rows).add_(1)
        first = self._first.index_select(0, rows).mul_(beta1).add_(gradient, alpha=1 - beta1)
        second = self._second.index_select(0, rows).mul_(beta2).addcmul_(gradient, gradient, value=1 - beta2)
        for moments, values in ((self._steps, steps), (self._first, first), (self._second, second)):
            moments.index_copy_(0, rows, values)
        unbiased = first / (1 - beta1**steps)
        spread = (second / (1 - beta2**steps)).sqrt_().add_(self._epsilon)
        step = unbiased.mul_(rate).div_(spread)
        self._table.index_copy_(0, rows, self._table.index_select(0, rows).sub_(step))

"""Adam over a model whose rows come and go: rates that decay, and rows that keep their moments.

The matrices of a network may take Muon's steps instead (Jordan et al. 2024): the momentum made orthogonal, so that a
step turns every direction of the matrix by as much. A network of coordinates learns in fewer steps by that.
"""

from __future__ import annotations

import operator
from collections.abc import Collection, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from .adam import Adam

# A short fit learns most where rates stay high for long, and has come to rest where they end before it does.
_SHORT_LAST, _SHORT_HOLD, _SHORT_UNTIL = 0.025, 0.35, 0.75
# Beside matrices that take Muon's steps; fits whose biases learned as fast by Adam were spoilt at high rates.
_BESIDE_MUON = 0.1


@dataclass(frozen=True)
class LearningRate:
    """A learning rate that falls exponentially from `first` to `last` until the share `until` of the fit.

    until: over 1 where the fit ends before. hold: share of the fit until which it stays `first`. begin: share before
    which it is 0.
    """

    first: float
    last: float
    until: float = 1.0
    begin: float = 0.0
    hold: float = 0.0

    @classmethod
    def constant(cls, value: float) -> LearningRate:
        """The same all along."""
        return cls(value, value)

    def short(self) -> LearningRate:
        """The same for a good third of a short fit; then it falls to a fortieth, for the last quarter."""
        return LearningRate(self.first, self.first * _SHORT_LAST, _SHORT_UNTIL, self.begin, _SHORT_HOLD)

    def at(self, done: float) -> float:
        """The rate when the share `done` of the fit is done."""
        if done < self.begin:
            return 0.0
        fallen = min(1.0, max(0.0, done - self.hold) / (self.until - self.hold))
        return self.first * (self.last / self.first) ** fallen


class RowOptimizer:
    """Updates `model` over `iterations` steps.

    rates: by attribute of the model, a parameter or a module; "part.inner" for one of a part's. rows: those of them
    that have a row per primitive. orthogonal: those of them whose matrices take Muon's steps; a step's entries are as
    large as Adam's at the same rate. What else these have learns at a tenth of the rate.
    """

    def __init__(
        self,
        model: nn.Module,
        rates: Mapping[str, LearningRate],
        rows: Collection[str],
        iterations: int,
        orthogonal: Collection[str] = (),
    ) -> None:
        self.model, self.rates, self.rows = model, dict(rates), tuple(rows)
        self.iterations, self.step_count = iterations, 0
        groups: list[dict[str, Any]] = []
        matrices: list[dict[str, Any]] = []
        for name in self.rates:
            parameters, share = self._parameters(name), 1.0
            if name in orthogonal:
                matrices.append({"params": [p for p in parameters if p.ndim == 2], "name": name, "share": share})
                parameters, share = [p for p in parameters if p.ndim != 2], _BESIDE_MUON
            groups.append({"params": parameters, "name": name, "share": share})
        self.adam = Adam(groups, eps=1e-15)
        self._optimizers: list[Adam | torch.optim.Optimizer] = [self.adam]
        if matrices:
            self._optimizers.append(
                torch.optim.Muon(matrices, lr=0.0, weight_decay=0.0, adjust_lr_fn="match_rms_adamw")
            )

    def _parameters(self, name: str) -> list[nn.Parameter]:
        part = operator.attrgetter(name)(self.model)
        return [part] if isinstance(part, nn.Parameter) else list(part.parameters())

    @property
    def done(self) -> float:
        """The share of the fit that is done."""
        return self.step_count / self.iterations

    def step(self) -> None:
        """One step along the gradients, which are then gone."""
        for optimizer in self._optimizers:
            for group in optimizer.param_groups:
                group["lr"] = group["share"] * self.rates[group["name"]].at(self.done)
            optimizer.step()
            optimizer.zero_grad()
        self.step_count += 1

    def replace_rows(self, kept: NDArray[np.int64], new: Mapping[str, Tensor]) -> None:
        """Keep the rows `kept` and append `new` ones, given for each of `rows`; these start without moments."""
        for group in self.adam.param_groups:
            name = group["name"]
            if name not in self.rows:
                continue
            old = getattr(self.model, name)
            index, rows = torch.from_numpy(kept).to(old.device), new[name].to(old.device)
            parameter = nn.Parameter(torch.cat([old.detach()[index], rows]))
            state = self.adam.state.pop(old, None)
            if state:
                blank = torch.zeros_like(rows)
                moments = {key: torch.cat([state[key][index], blank]) for key in ("exp_avg", "exp_avg_sq")}
                self.adam.state[parameter] = {**state, **moments}
            setattr(self.model, name, parameter)
            group["params"] = [parameter]

    def set_rows(self, name: str, values: Tensor, rows: Tensor | None = None) -> None:
        """Give the table `name`, or its `rows` (int64), new values; their moments are gone."""
        parameter = getattr(self.model, name)
        where = slice(None) if rows is None else rows
        with torch.no_grad():
            parameter[where] = values
        state = self.adam.state.get(parameter)
        if state:
            for key in ("exp_avg", "exp_avg_sq"):
                state[key][where] = 0

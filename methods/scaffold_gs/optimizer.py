"""Adam over a model whose anchors come and go: learning rates and their decay, and rows that keep their moments."""

from __future__ import annotations

from typing import Literal

import numpy as np
import torch
from numpy.typing import NDArray
from splashbench_methods.scaffold_gs.model import PER_ANCHOR, AnchorModel

# First and last learning rate, with exponential decay between: "published" are those of Scaffold-GS.
_RATES: dict[str, dict[str, tuple[float, float]]] = {
    "published": {
        "offsets": (0.01, 0.0001),
        "features": (0.0075, 0.0075),
        "log_scales": (0.007, 0.007),
        "opacity_head": (0.002, 0.00002),
        "shape_head": (0.004, 0.004),
        "color_head": (0.008, 0.00005),
    },
    "short": {
        "offsets": (0.01, 0.001),
        "features": (0.02, 0.002),
        "log_scales": (0.01, 0.001),
        "opacity_head": (0.002, 0.0002),
        "shape_head": (0.004, 0.0004),
        "color_head": (0.008, 0.0008),
    },
}


class AnchorOptimizer:
    """Updates `model`; the learning rates go from their first to their last value over `iterations` steps."""

    def __init__(self, model: AnchorModel, rates: Literal["short", "published"], iterations: int) -> None:
        self.model, self.rates, self.iterations, self.step_count = model, _RATES[rates], iterations, 0
        groups = [{"params": self._parameters(name), "name": name} for name in self.rates]
        self.adam = torch.optim.Adam(groups, lr=0.0, eps=1e-15, fused=True)

    def _parameters(self, name: str) -> list[torch.nn.Parameter]:
        part = getattr(self.model, name)
        return [part] if name in PER_ANCHOR else list(part.parameters())

    def step(self) -> None:
        """One step along the gradients, which are then gone."""
        done = self.step_count / self.iterations
        for group in self.adam.param_groups:
            first, last = self.rates[group["name"]]
            group["lr"] = first * (last / first) ** done
        self.adam.step()
        self.adam.zero_grad(set_to_none=True)
        self.step_count += 1

    def replace_anchors(self, kept: NDArray[np.int64], positions: torch.Tensor, new: dict[str, torch.Tensor]) -> None:
        """Keep the anchors `kept` and append new ones, at `positions` [n, 3] and with rows of each of PER_ANCHOR.

        Kept rows keep their moments; new ones start without any.
        """
        rows = torch.from_numpy(kept)
        self.model.positions = torch.cat([self.model.positions[rows], positions])
        for group in self.adam.param_groups:
            name = group["name"]
            if name not in PER_ANCHOR:
                continue
            old = getattr(self.model, name)
            parameter = torch.nn.Parameter(torch.cat([old.detach()[rows], new[name]]))
            state = self.adam.state.pop(old, None)
            if state:
                blank = torch.zeros_like(new[name])
                moments = {key: torch.cat([state[key][rows], blank]) for key in ("exp_avg", "exp_avg_sq")}
                self.adam.state[parameter] = {**state, **moments}
            setattr(self.model, name, parameter)
            group["params"] = [parameter]

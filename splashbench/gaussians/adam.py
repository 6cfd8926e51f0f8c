"""Adam (Kingma and Ba 2015) by PyTorch's fused kernel, for a fit that needs nothing else of torch.optim.

The optimisers of torch.optim load PyTorch's compiler when the first of them is made: seconds and 70 MB for each process
that fits, which never compiles anything. The function that they call does not, and gives the same bits.
"""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

import torch
from torch import Tensor

# From its own module: torch.optim has no name for it.
from torch.optim.adam import adam

_BETAS = (0.9, 0.999)


class Adam:
    """Updates the tensors of `groups`, each a dict with "params" and "lr"; other entries are the caller's own.

    param_groups: the groups; their entries may be changed between steps. state: by tensor, once it had a gradient, its
    number of steps "step" and moments "exp_avg" and "exp_avg_sq" of its shape. eps: added to the denominator.
    """

    def __init__(self, groups: Iterable[dict[str, Any]], eps: float = 1e-8) -> None:
        self.param_groups = list(groups)
        self.state: dict[Tensor, dict[str, Tensor]] = {}
        self._eps = eps

    def _state(self, parameter: Tensor) -> dict[str, Tensor]:
        state = self.state.get(parameter)
        if state is None:
            state = self.state[parameter] = {
                "step": torch.zeros((), dtype=torch.float32, device=parameter.device),
                "exp_avg": torch.zeros_like(parameter, memory_format=torch.preserve_format),
                "exp_avg_sq": torch.zeros_like(parameter, memory_format=torch.preserve_format),
            }
        return state

    @torch.no_grad()
    def step(self) -> None:
        """One step along the gradients; a tensor without one stays as it is."""
        for group in self.param_groups:
            parameters = [parameter for parameter in group["params"] if parameter.grad is not None]
            if not parameters:
                continue
            states = [self._state(parameter) for parameter in parameters]
            adam(
                parameters,
                [parameter.grad for parameter in parameters],
                [state["exp_avg"] for state in states],
                [state["exp_avg_sq"] for state in states],
                [],
                [state["step"] for state in states],
                fused=True,
                amsgrad=False,
                beta1=_BETAS[0],
                beta2=_BETAS[1],
                lr=group["lr"],
                weight_decay=0.0,
                eps=self._eps,
                maximize=False,
            )

    def zero_grad(self) -> None:
        """Drop the gradients."""
        for group in self.param_groups:
            for parameter in group["params"]:
                parameter.grad = None

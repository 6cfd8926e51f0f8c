"""What is learned, averaged over its last steps: about what it will be once the learning rates have fallen.

At full rates values wander about what they have found, and renders with them are worse than those of a finished fit by
some tenths of a decibel, more or less from one look to the next. Their running means do not wander.
"""

from __future__ import annotations

import copy
from collections.abc import Iterator
from contextlib import contextmanager

import torch
from torch import Tensor

from .decoder import Decoder

# By how much a mean moves towards a new value: a carrier's over about ten photographs, the heads' over fifty.
_OF_CARRIERS, _OF_HEADS = 0.1, 0.02
# Likewise of heads that are shown on the way: a mean over twenty photographs, of the first ones over a fifth of them.
_OF_SHOWN_HEADS, _FIRST_STEPS = 0.05, 5.0


class ShownHeads:
    """Running means of the weights of `decoder`, for states of the fit on its way. What the heads miss is common to
    all carriers, so that their means gain most of what means of everything would, and cost next to nothing."""

    def __init__(self, decoder: Decoder) -> None:
        self._decoder = decoder
        self._means = [parameter.detach().clone() for parameter in decoder.parameters()]
        self._steps = 0

    @torch.no_grad()
    def add(self) -> None:
        """Take in the weights after a step."""
        self._steps += 1
        share = min(1.0, max(_OF_SHOWN_HEADS, _FIRST_STEPS / self._steps))
        for mean, parameter in zip(self._means, self._decoder.parameters()):
            mean.lerp_(parameter, share)

    @torch.no_grad()
    def decoder(self) -> Decoder:
        """A decoder with the mean weights."""
        shown = copy.deepcopy(self._decoder)
        for parameter, mean in zip(shown.parameters(), self._means):
            parameter.copy_(mean)
        return shown


class Averages:
    """Running means of the values of `count` carriers, `size` each, and of the weights of `decoder`."""

    def __init__(self, count: int, size: int, decoder: Decoder) -> None:
        device = decoder.opacity.weight.device
        self._values = torch.zeros(count, size, device=device)
        self._known = torch.zeros(count, dtype=torch.bool, device=device)
        self._decoder = decoder
        self._heads = [parameter.detach().clone() for parameter in decoder.parameters()]

    @torch.no_grad()
    def add(self, ids: Tensor, values: Tensor) -> None:
        """values: [n, size], what the carriers `ids` (int64 [n]) have after a step; and the heads as they are."""
        before = self._values.index_select(0, ids)
        share = torch.where(self._known.index_select(0, ids), _OF_CARRIERS, 1.0)[:, None]
        self._values.index_copy_(0, ids, before + share * (values - before))
        self._known.index_fill_(0, ids, True)
        for mean, parameter in zip(self._heads, self._decoder.parameters()):
            mean.lerp_(parameter, _OF_HEADS)

    def of(self, ids: Tensor, values: Tensor) -> Tensor:
        """The means of the carriers `ids`; their `values` [n, size] where no step has touched them."""
        known = self._known.index_select(0, ids)[:, None]
        return torch.where(known, self._values.index_select(0, ids), values)

    @contextmanager
    @torch.no_grad()
    def heads(self) -> Iterator[None]:
        """Within, the decoder has the mean weights."""
        own = [parameter.detach().clone() for parameter in self._decoder.parameters()]
        self._set(self._heads)
        try:
            yield
        finally:
            self._set(own)

    def _set(self, weights: list[Tensor]) -> None:
        for parameter, weight in zip(self._decoder.parameters(), weights):
            parameter.data.copy_(weight)

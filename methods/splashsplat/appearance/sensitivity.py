"""How much photographs change with what was learned of each carrier: what may be stored how coarsely.

The squared error that a small error d of one carrier's values adds to a photograph is d' (J' J) d, with J the
derivative of its pixels. The outer product of J' s, with a random sign s for each pixel, is an unbiased sample of J' J
(Hutchinson, Comm. Stat. Sim. 18, 1989). The fit computes such products anyway: its main term is an absolute difference,
whose derivative by each pixel is the sign of what is left over, divided by the pixels of the mask. So what is learned
of a photograph counts by its share of it, and nothing has to be rendered to know it. Not in the paper.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

# Photographs of which the metric is taken that the others are measured by.
_FIRST = 8
# Share of its largest eigenvalue below which others count as if they had it.
_FLOOR = 1e-6


@dataclass(frozen=True)
class Sensitivity:
    """metric: float64 [D, D], the mean of J' J over carriers, D values each: features, then log-scales. carriers:
    float32 [count], of each relative to their mean; 0 where no photograph that was looked at shows it."""

    metric: np.ndarray
    carriers: np.ndarray

    @classmethod
    def of_spread(cls, values: np.ndarray) -> Sensitivity:
        """Where no photograph was looked at: each of the values [count, D] counts by its spread, all carriers alike."""
        variance = np.maximum(values.var(axis=0, dtype=np.float64), 1e-12) if len(values) else np.ones(values.shape[1])
        return cls(np.diag(1 / variance), np.ones(len(values), dtype=np.float32))

    def kept(self, rows: np.ndarray) -> Sensitivity:
        """Of the carriers `rows` alone."""
        return Sensitivity(self.metric, self.carriers[rows])


class Sensitivities:
    """Adds up, photograph by photograph, how much each changes with the values of `count` carriers, `size` each, on
    `device`."""

    def __init__(self, count: int, size: int, device: str = "cpu") -> None:
        self._metric = torch.zeros(size, size, dtype=torch.float64, device=device)
        self._squares = torch.zeros(count, device=device)
        self._first: list[tuple[Tensor, Tensor]] = []
        self._whiten: Tensor | None = None

    def add(self, ids: Tensor, derivative: Tensor) -> None:
        """ids: int64 [n], the carriers that one photograph shows. derivative: [n, size], J' s."""
        wide = derivative.to(torch.float64)
        self._metric += wide.T @ wide
        if self._whiten is not None:
            self._add(self._whiten, ids, derivative)
            return
        self._first.append((ids, derivative))
        if len(self._first) == _FIRST:
            self._measure_first()

    def found(self) -> Sensitivity | None:
        """All that was added; None where nothing was, or nothing of it shows in photographs."""
        self._measure_first()
        if not self._metric.any():
            return None
        seen = max(int((self._squares > 0).sum()), 1)
        mean = float(self._squares.sum()) / seen
        return Sensitivity((self._metric / seen).cpu().numpy(), (self._squares / max(mean, 1e-30)).cpu().numpy())

    def _measure_first(self) -> None:
        if self._first:
            self._whiten = _inverse_root(self._metric)
            for ids, derivative in self._first:
                self._add(self._whiten, ids, derivative)
            self._first = []

    def _add(self, whiten: Tensor, ids: Tensor, derivative: Tensor) -> None:
        # Relative to the metric all directions count alike: a sample of few signs is no chance hit of one of them.
        self._squares.index_add_(0, ids, (derivative @ whiten).square().mean(dim=1))


def _inverse_root(metric: Tensor) -> Tensor:
    eigenvalues, vectors = torch.linalg.eigh(metric)
    floor = max(float(eigenvalues[-1]) * _FLOOR, 1e-30)
    return ((vectors / eigenvalues.clamp_min(floor).sqrt()) @ vectors.T).to(torch.float32)

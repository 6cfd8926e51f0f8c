"""What was learned of each carrier as whole numbers: a transform coding in the metric of the photographs.

A step of one along any row of `basis` changes the photographs by as much. So one step serves all coefficients, most of
them are small or zero, and what no photograph shows costs next to nothing. Carriers that make up little of the
photographs have steps 2, 4 or 8 times as long (reverse water-filling: Cover and Thomas, Elements of Information Theory,
section 10.3.3). Not in the paper.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ..appearance.sensitivity import Sensitivity

#: A carrier's step is `2**coarseness` times the step of all.
LEAST, MOST = -2, 3
# Of a coefficient, in whole steps.
_LARGEST = 2**30
# Share of the largest eigenvalue below which directions of the metric count as if they had it.
_FLOOR = 1e-6


@dataclass(frozen=True)
class StoredValues:
    """N carriers with D values each. center: float32 [D]. basis: float32 [D, D]. coarseness: int8 [N]. coefficients:
    int8, int16 or int32 [D, N]. Values are center + 2**coarseness (coefficients' basis)."""

    center: NDArray[np.float32]
    basis: NDArray[np.float32]
    coarseness: NDArray[np.int8]
    coefficients: NDArray[np.signedinteger]


@dataclass(frozen=True)
class _Transform:
    """center: float64 [D]. forward: float64 [D, D] to coefficients, basis: back from them, for a step of 1."""

    center: NDArray[np.float64]
    forward: NDArray[np.float64]
    basis: NDArray[np.float64]


def _transform(values: NDArray[np.float32], sensitivity: Sensitivity) -> _Transform:
    wide = values.astype(np.float64)
    share = np.maximum(sensitivity.carriers.astype(np.float64), 1e-12)
    share /= max(share.sum(), 1e-12)
    center = share @ wide if len(values) else np.zeros(values.shape[1])
    root, back = _roots(sensitivity.metric)
    spread = (wide - center) * np.sqrt(share)[:, None]
    _, turn = np.linalg.eigh(root @ (spread.T @ spread) @ root)
    turn = turn[:, ::-1]
    return _Transform(center, root @ turn, turn.T @ back)


def typical_coefficient(values: NDArray[np.float32], sensitivity: Sensitivity) -> float:
    """Root mean square of the coefficients that `store_values` makes with a step of 1, before they are rounded."""
    found = _transform(values, sensitivity)
    return float(np.sqrt((((values - found.center) @ found.forward) ** 2).mean())) if len(values) else 1.0


def store_values(values: NDArray[np.float32], sensitivity: Sensitivity, step: float) -> StoredValues:
    """`values` [N, D] in whole numbers of steps; how long one is in the metric: `step`, times 2**coarseness."""
    found = _transform(values, sensitivity)
    weights = np.maximum(sensitivity.carriers.astype(np.float64), 1e-12)
    coarseness = np.clip(np.rint(-0.5 * np.log2(weights)), LEAST, MOST).astype(np.int8)
    scaled = (values - found.center) @ found.forward / (step * np.exp2(coarseness.astype(np.float64))[:, None])
    whole = np.rint(np.clip(scaled, -_LARGEST, _LARGEST))
    kind = np.min_scalar_type(-int(np.abs(whole).max(initial=0)) - 1)
    return StoredValues(
        found.center.astype(np.float32),
        (found.basis * step).astype(np.float32),
        coarseness,
        np.ascontiguousarray(whole.T).astype(kind),
    )


def read_values(stored: StoredValues) -> NDArray[np.float32]:
    """The values, float32 [N, D]. Raises ValueError where the arrays do not fit together."""
    size, count = stored.coefficients.shape
    if stored.center.shape != (size,) or stored.basis.shape != (size, size) or stored.coarseness.shape != (count,):
        raise ValueError(f"center, basis and coarseness do not fit {size} coefficients of {count} carriers")
    if count and (stored.coarseness.min() < LEAST or stored.coarseness.max() > MOST):
        raise ValueError(f"coarseness is not between {LEAST} and {MOST}")
    values = np.zeros((count, size), dtype=np.float32)
    # Sums in one order, by single operations: the same floats on every machine.
    for row, coefficients in zip(stored.basis, stored.coefficients):
        values += coefficients.astype(np.float32)[:, None] * row
    return values * np.exp2(stored.coarseness.astype(np.float32))[:, None] + stored.center


def _roots(metric: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """The symmetric root of a metric [D, D], and its inverse."""
    eigenvalues, vectors = np.linalg.eigh(metric)
    floor = max(_FLOOR * eigenvalues[-1], 1e-30)
    roots = np.sqrt(np.maximum(eigenvalues, floor))
    return (vectors * roots) @ vectors.T, (vectors / roots) @ vectors.T

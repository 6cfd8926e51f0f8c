"""What was learned of each carrier as whole numbers: a transform coding in the metric of the photographs.

A step of one along any row of `basis` changes the photographs by as much. So one step serves all coefficients, most of
them are small or zero, and what no photograph shows costs next to nothing. Carriers that make up little of the
photographs have steps 2, 4 or 8 times as long (reverse water-filling: Cover and Thomas, Elements of Information Theory,
section 10.3.3). Not in the paper.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ..appearance.sensitivity import Sensitivity

#: A carrier's step is `2**coarseness` times the step of all.
LEAST, MOST = -2, 3
# Of a coefficient, in whole steps.
_LARGEST = 2**30
# Carriers that are transformed at once.
_PART = 1 << 15
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
    count, size = values.shape
    weights = np.maximum(sensitivity.carriers.astype(np.float64), 1e-12)
    share = weights / max(weights.sum(), 1e-12)
    center = sum((share[rows] @ values[rows] for rows in _parts(count)), np.zeros(size))
    spread = np.zeros((size, size))
    for rows in _parts(count):
        part = (values[rows] - center) * np.sqrt(share[rows])[:, None]
        spread += part.T @ part
    root, back = _roots(sensitivity.metric)
    _, turn = np.linalg.eigh(root @ spread @ root)
    turn = turn[:, ::-1]
    return _Transform(center, root @ turn, turn.T @ back)


def _parts(count: int) -> Iterator[slice]:
    """Rows by the ten thousands: double precision of all of them would be the largest thing in memory."""
    for start in range(0, count, _PART):
        yield slice(start, min(start + _PART, count))


def typical_coefficient(values: NDArray[np.float32], sensitivity: Sensitivity) -> float:
    """Root mean square of the coefficients that `store_values` makes with a step of 1, before they are rounded."""
    if not len(values):
        return 1.0
    found = _transform(values, sensitivity)
    squares = sum(float((((values[rows] - found.center) @ found.forward) ** 2).sum()) for rows in _parts(len(values)))
    return float(np.sqrt(squares / values.size))


def store_values(values: NDArray[np.float32], sensitivity: Sensitivity, step: float) -> StoredValues:
    """`values` [N, D] in whole numbers of steps; how long one is in the metric: `step`, times 2**coarseness."""
    count, size = values.shape
    found = _transform(values, sensitivity)
    weights = np.maximum(sensitivity.carriers.astype(np.float64), 1e-12)
    coarseness = np.clip(np.rint(-0.5 * np.log2(weights)), LEAST, MOST).astype(np.int8)
    coefficients = np.empty((size, count), dtype=np.int32)
    for rows in _parts(count):
        steps = step * np.exp2(coarseness[rows].astype(np.float64))
        scaled = (values[rows] - found.center) @ found.forward / steps[:, None]
        coefficients[:, rows] = np.rint(np.clip(scaled, -_LARGEST, _LARGEST)).T
    largest = max(int(coefficients.max(initial=0)), -int(coefficients.min(initial=0)))
    return StoredValues(
        found.center.astype(np.float32),
        (found.basis * step).astype(np.float32),
        coarseness,
        coefficients.astype(np.min_scalar_type(-largest - 1)),
    )


def read_values(stored: StoredValues) -> NDArray[np.float32]:
    """The values, float32 [N, D]. Raises ValueError where the arrays do not fit together."""
    size, count = stored.coefficients.shape
    if stored.center.shape != (size,) or stored.basis.shape != (size, size) or stored.coarseness.shape != (count,):
        raise ValueError(f"center, basis and coarseness do not fit {size} coefficients of {count} carriers")
    if count and (stored.coarseness.min() < LEAST or stored.coarseness.max() > MOST):
        raise ValueError(f"coarseness is not between {LEAST} and {MOST}")
    values = np.zeros((count, size), dtype=np.float32)
    with np.errstate(over="ignore", invalid="ignore"):  # of files from strangers, which are refused below
        for rows in _parts(count):
            part = values[rows]
            # Sums in one order, by single operations: the same floats on every machine.
            for row, coefficients in zip(stored.basis, stored.coefficients):
                part += coefficients[rows].astype(np.float32)[:, None] * row
            part *= np.exp2(stored.coarseness[rows].astype(np.float32))[:, None]
            part += stored.center
    if not np.isfinite(values).all():
        raise ValueError("values are beyond the range of float32")
    return values


def _roots(metric: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """The symmetric root of a metric [D, D], and its inverse."""
    eigenvalues, vectors = np.linalg.eigh(metric)
    floor = max(_FLOOR * eigenvalues[-1], 1e-30)
    roots = np.sqrt(np.maximum(eigenvalues, floor))
    return (vectors * roots) @ vectors.T, (vectors / roots) @ vectors.T

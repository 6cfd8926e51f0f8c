"""What was learned of each carrier as whole numbers: a transform coding in the metric of the photographs.

A step of one along any row of `basis` changes the photographs by as much. So one step serves all coefficients, most of
them are small or zero, and what no photograph shows costs next to nothing. Carriers that make up little of the
photographs have steps 2, 4 or 8 times as long, those that make up much a half or a quarter (reverse water-filling:
Cover and Thomas, Elements of Information Theory, section 10.3.3). Not in the paper.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ..appearance.sensitivity import Sensitivity

# A carrier's step is this times 2**coarseness times the step of all, which a carrier of mean weight has.
_FINEST = 0.25
#: Kinds of coarseness that there are, and what the arrays of their coefficients are called, before its number.
LEVELS, COEFFICIENTS = 6, "coefficients."
# Of a coefficient, in whole steps.
_LARGEST = 2**30
# Carriers that are transformed at once.
_PART = 1 << 15
# Share of the largest eigenvalue below which directions of the metric count as if they had it.
_FLOOR = 1e-6


@dataclass(frozen=True)
class StoredValues:
    """N carriers with D values each. center: float32 [D]. basis: float32 [D, D]. coarseness: uint8 [N], below `LEVELS`.
    coefficients: for each coarseness those of its carriers, in their order, int8, int16 or int32 [D, n]. Values are
    center + 2**coarseness (coefficients' basis)."""

    center: NDArray[np.float32]
    basis: NDArray[np.float32]
    coarseness: NDArray[np.uint8]
    coefficients: tuple[NDArray[np.signedinteger], ...]

    @property
    def arrays(self) -> dict[str, np.ndarray]:
        """By the names in which they are stored. Carriers of one coarseness have numbers of one kind, which
        together compress to a fifth less than all of them in turn."""
        parts = {f"{COEFFICIENTS}{level}": part for level, part in enumerate(self.coefficients)}
        return {"center": self.center, "basis": self.basis, "coarseness": self.coarseness, **parts}

    @classmethod
    def of(cls, arrays: Mapping[str, np.ndarray]) -> StoredValues:
        """What `arrays` gave."""
        parts = tuple(arrays[f"{COEFFICIENTS}{level}"] for level in range(LEVELS))
        return cls(arrays["center"], arrays["basis"], arrays["coarseness"], parts)


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
    """`values` [N, D] in whole numbers of steps; how long one is in the metric: `step`, for a carrier that makes up as
    much of the photographs as others do on average."""
    found = _transform(values, sensitivity)
    weights = np.maximum(sensitivity.carriers.astype(np.float64), 1e-12)
    coarseness = np.clip(np.rint(-0.5 * np.log2(weights) - math.log2(_FINEST)), 0, LEVELS - 1).astype(np.uint8)
    finest = _FINEST * step
    return StoredValues(
        found.center.astype(np.float32),
        (found.basis * finest).astype(np.float32),
        coarseness,
        tuple(
            _coefficients(values, np.flatnonzero(coarseness == level), found, finest * 2.0**level)
            for level in range(LEVELS)
        ),
    )


def _coefficients(
    values: NDArray[np.float32], rows: NDArray[np.intp], transform: _Transform, step: float
) -> NDArray[np.signedinteger]:
    """Those of some rows of `values`, in the smallest whole numbers that hold them, [D, n]."""
    whole = np.empty((values.shape[1], len(rows)), dtype=np.int32)
    for part in _parts(len(rows)):
        scaled = (values[rows[part]] - transform.center) @ transform.forward / step
        whole[:, part] = np.rint(np.clip(scaled, -_LARGEST, _LARGEST)).T
    largest = max(int(whole.max(initial=0)), -int(whole.min(initial=0)))
    return whole.astype(np.min_scalar_type(-largest - 1))


def read_values(stored: StoredValues) -> NDArray[np.float32]:
    """The values, float32 [N, D]. Raises ValueError where the arrays do not fit together."""
    size, count = len(stored.center), len(stored.coarseness)
    shares = np.bincount(stored.coarseness, minlength=LEVELS) if stored.coarseness.dtype == np.uint8 else ()
    if len(shares) != LEVELS:
        raise ValueError(f"coarseness is no whole number from 0 to {LEVELS - 1}")
    if stored.basis.shape != (size, size):
        raise ValueError(f"a basis of {stored.basis.shape} does not fit {size} values")
    for level, (share, part) in enumerate(zip(shares, stored.coefficients)):
        if part.shape != (size, share):
            raise ValueError(f"coefficients of shape {part.shape} do not fit {share} carriers of coarseness {level}")
    values = np.empty((count, size), dtype=np.float32)
    with np.errstate(over="ignore", invalid="ignore"):  # of files from strangers, which are refused below
        for level, coefficients in enumerate(stored.coefficients):
            rows = np.flatnonzero(stored.coarseness == level)
            for some in _parts(len(rows)):
                # Sums in one order, by single operations: the same floats on every machine.
                found = np.zeros((len(rows[some]), size), dtype=np.float32)
                for row, numbers in zip(stored.basis, coefficients):
                    found += numbers[some].astype(np.float32)[:, None] * row
                values[rows[some]] = found * np.float32(2**level) + stored.center
    if not np.isfinite(values).all():
        raise ValueError("values are beyond the range of float32")
    return values


def _roots(metric: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """The symmetric root of a metric [D, D], and its inverse."""
    eigenvalues, vectors = np.linalg.eigh(metric)
    floor = max(_FLOOR * eigenvalues[-1], 1e-30)
    roots = np.sqrt(np.maximum(eigenvalues, floor))
    return (vectors * roots) @ vectors.T, (vectors / roots) @ vectors.T

"""Array types of stored results: numpy arrays to the type checker, and readable back from JSON.

The stages of `prepare` store their results as JSON and read them by their annotations. An array annotated with one of
these types comes back with its values, shape and kind as they were.
"""

from __future__ import annotations

from typing import Annotated, Any

import numpy as np
from numpy.typing import DTypeLike, NDArray
from pydantic import PlainValidator


def _stored(kind: DTypeLike) -> PlainValidator:
    """The validator that reads what `plain` made of an array."""

    def read(value: Any) -> NDArray[Any]:
        if isinstance(value, np.ndarray):
            return value
        return np.asarray(value["values"], dtype=kind).reshape(value["shape"])

    return PlainValidator(read)


def plain(array: NDArray[Any]) -> dict[str, Any]:
    """An array as JSON has it: its shape and its values in a row. Floats keep all their bits."""
    return {"shape": list(array.shape), "values": array.ravel().tolist()}


Floats = Annotated[NDArray[np.float64], _stored(np.float64)]
Indices = Annotated[NDArray[np.int64], _stored(np.int64)]
Flags = Annotated[NDArray[np.bool_], _stored(np.bool_)]

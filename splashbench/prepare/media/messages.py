"""Messages between a process and the one that decodes for it: a head in JSON, and arrays as they lie in memory.

Nothing is unpickled, and every size is checked before memory is taken for it: a decoder that a file has broken may say
anything.
"""

from __future__ import annotations

import json
import math
import os
import select
import struct
from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

#: Of one message: its head, and all of its arrays.
MAX_HEAD_BYTES, MAX_ARRAY_BYTES = 1 << 20, 1 << 30
_TYPES = {name: np.dtype(name) for name in ("u1", "i8", "f4")}
_TURNS = 50
_LENGTH = struct.Struct("<I")

Message = tuple[dict[str, Any], list[NDArray[Any]]]


class EndedError(Exception):
    """The other end is gone, or says what no message is."""


class SilenceError(Exception):
    """The other end has said nothing for too long."""


def send(
    descriptor: int, head: dict[str, Any], arrays: Sequence[NDArray[Any]] = (), patience_s: float | None = None
) -> None:
    """Write one message. Arrays are uint8, int64 or float32.

    patience_s: how long nobody may read, where the descriptor does not block; without end by default. Raises EndedError
    where nobody reads any more, and SilenceError.
    """
    laid_out = [np.ascontiguousarray(array) for array in arrays]
    stated = [[f"{array.dtype.kind}{array.dtype.itemsize}", *array.shape] for array in laid_out]
    text = json.dumps({**head, "arrays": stated}).encode("utf-8")
    parts = [memoryview(_LENGTH.pack(len(text)) + text), *(array.data.cast("B") for array in laid_out if array.size)]
    try:
        for left in parts:
            while left:
                if patience_s is not None:
                    _wait(descriptor, select.POLLOUT, patience_s)
                left = left[os.write(descriptor, left) :]
    except BrokenPipeError:
        raise EndedError from None


def receive(descriptor: int, patience_s: float | None = None) -> Message:
    """Read one message. patience_s: how long nothing may come, without end by default.

    Raises EndedError at the end, or at anything that is no message, and SilenceError.
    """
    (length,) = _LENGTH.unpack(_bytes(descriptor, _LENGTH.size, patience_s))
    if length > MAX_HEAD_BYTES:
        raise EndedError
    try:
        head = json.loads(_bytes(descriptor, length, patience_s))
        stated = [(_TYPES[kind], tuple(map(int, shape))) for kind, *shape in head.pop("arrays")]
    except (ValueError, KeyError, TypeError, AttributeError, RecursionError):
        raise EndedError from None
    if any(side < 0 for _, shape in stated for side in shape):
        raise EndedError
    if sum(kind.itemsize * math.prod(shape) for kind, shape in stated) > MAX_ARRAY_BYTES:
        raise EndedError
    arrays = []
    for kind, shape in stated:
        array = np.empty(shape, kind)
        if array.size:
            _fill(descriptor, array.data.cast("B"), patience_s)
        arrays.append(array)
    return head, arrays


def _bytes(descriptor: int, count: int, patience_s: float | None) -> bytes:
    content = bytearray(count)
    _fill(descriptor, memoryview(content), patience_s)
    return bytes(content)


def _fill(descriptor: int, left: memoryview, patience_s: float | None) -> None:
    """Read until `left` is full."""
    while left:
        if patience_s is not None:
            _wait(descriptor, select.POLLIN, patience_s)
        count = os.readv(descriptor, [left])
        if count == 0:
            raise EndedError
        left = left[count:]


def _wait(descriptor: int, until_what: int, patience_s: float) -> None:
    poll = select.poll()
    poll.register(descriptor, until_what)
    # In short turns: the time in which this process is stopped, as by Ctrl-Z, is one of them at the most.
    for _ in range(_TURNS):
        if poll.poll(patience_s * 1000 / _TURNS):
            return
    raise SilenceError

"""The weights in a TorchScript archive, read without PyTorch: nothing that a stranger wrote is compiled or run.

Scaffold-GS and the codes built on it save their heads by torch.jit.trace. Such an archive is a zip with code, which is
never looked at, and a pickle data.pkl of the modules' attributes that names its arrays, the files of the folder data. A
pickle is a program; this reads the few instructions that PyTorch writes for modules of weights, calls nothing, and
refuses every other.
"""

from __future__ import annotations

import pickletools
import warnings
import zipfile
import zlib
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from splashbench.errors import SplashbenchError

_MAX_PROGRAM_BYTES = 1 << 20
_MAX_MODULES = 10_000
_MAX_RANK = 4
_MAX_NAME, _MAX_PATH = 64, 256
_STORAGES = {"FloatStorage": "<f4", "DoubleStorage": "<f8", "HalfStorage": "<f2"}
_REBUILD = "torch._utils _rebuild_tensor_v2"
_EMPTY = {"EMPTY_TUPLE": tuple, "EMPTY_DICT": dict, "EMPTY_LIST": list}
_PLAIN = {"NONE": None, "NEWTRUE": True, "NEWFALSE": False}
_VALUES = ("BINUNICODE", "BININT", "BININT1", "BININT2", "LONG1", "BINFLOAT")
_TUPLES = {"TUPLE1": 1, "TUPLE2": 2, "TUPLE3": 3}
_DAMAGED = (OSError, ValueError, LookupError, TypeError, AttributeError, RuntimeError, EOFError, MemoryError, Warning)


@dataclass(frozen=True)
class _Global:
    """A name that the program gives for something to call."""

    name: str


@dataclass
class _Object:
    """What the program would make by calling `kind` with `arguments`; state: its attributes."""

    kind: str
    arguments: tuple = ()
    state: dict[str, Any] = field(default_factory=dict)


class _NotWeightsError(ValueError):
    """The program does what no module of weights needs."""


def is_traced(path: Path) -> bool:
    """Whether the file is a TorchScript archive: it has code, or the constants of code."""
    try:
        with zipfile.ZipFile(path) as archive:
            inner = {name.lower().partition("/")[2] for name in archive.namelist()}
    except (OSError, zipfile.BadZipFile, ValueError, RuntimeError):
        return False
    return any(name == "constants.pkl" or name.startswith("code/") for name in inner)


def traced_weights(path: Path, max_bytes: int) -> dict[str, NDArray[np.floating]]:
    """Every array of the modules in the archive, by the names that their `state_dict` has ("0.weight").

    Raises SplashbenchError for an archive that is damaged, holds over `max_bytes`, or more than modules of weights.
    """
    try:
        with zipfile.ZipFile(path) as archive:
            sizes = {entry.filename: entry.file_size for entry in archive.infolist()}
            if sum(sizes.values()) > max_bytes:
                raise SplashbenchError(
                    f"{path} unpacks to more than {max_bytes >> 20} MiB, more than such weights; see what file it is"
                )
            program = next(name for name in sizes if name.count("/") == 1 and name.endswith("/data.pkl"))
            if sizes[program] > _MAX_PROGRAM_BYTES:
                raise SplashbenchError(f"{path}: its list of weights is too long; give the file as the code saved it")
            with warnings.catch_warnings():
                warnings.simplefilter("error")  # of pickletools, at names that are none
                rebuilds = _arrays(_read(archive.read(program)))
            storages: dict[str, NDArray] = {}
            arrays = {}
            for name, arguments in rebuilds.items():
                arrays[name] = _array(arguments, archive, program.removesuffix(".pkl"), storages)
                if sum(array.nbytes for array in arrays.values()) > max_bytes:
                    raise _NotWeightsError("arrays in many places")
            return arrays
    except StopIteration:
        raise SplashbenchError(f"{path} lists no weights; give the file as the code saved it") from None
    except _NotWeightsError as error:
        raise SplashbenchError(
            f"{path} is TorchScript with more in it than weights ({str(error)[:80]}), which is not read; "
            "save state_dict() of the network with torch.save instead"
        ) from None
    except (zipfile.BadZipFile, zlib.error, *_DAMAGED) as error:
        cause = f"{type(error).__name__}: {error}"[:160]
        raise SplashbenchError(f"{path} is damaged ({cause}); copy it again") from None


def _read(program: bytes) -> Any:
    """What the pickle describes, with an _Object wherever it would call something."""
    stack: list[Any] = []
    marks: list[int] = []
    memory: dict[int, Any] = {}

    def since_mark() -> list[Any]:
        start = marks.pop()
        taken = stack[start:]
        del stack[start:]
        return taken

    for code, argument, _ in pickletools.genops(program):
        name, number = code.name, argument if isinstance(argument, int) else -1
        if name in _PLAIN:
            stack.append(_PLAIN[name])
        elif name in _EMPTY:
            stack.append(_EMPTY[name]())
        elif name in _VALUES:
            stack.append(argument)
        elif name == "GLOBAL":
            stack.append(_Global(str(argument)))
        elif name in ("BINPUT", "LONG_BINPUT"):
            memory[number] = stack[-1]
        elif name in ("BINGET", "LONG_BINGET"):
            stack.append(memory[number])
        elif name == "MARK":
            marks.append(len(stack))
        elif name == "TUPLE":
            stack.append(tuple(since_mark()))
        elif name in _TUPLES:
            stack[-_TUPLES[name] :] = [tuple(stack[-_TUPLES[name] :])]
        elif name == "SETITEMS":
            items = since_mark()
            # Keys are hashed, which a tuple of tuples of tuples makes last for ever, and names are joined.
            if not all(isinstance(key, str) and len(key) <= _MAX_NAME for key in items[::2]):
                raise _NotWeightsError("a table that is not by name")
            stack[-1].update(zip(items[::2], items[1::2], strict=True))
        elif name == "APPENDS":
            items = since_mark()
            stack[-1].extend(items)
        elif name == "BINPERSID":
            stack.append(_Object("storage", stack.pop()))
        elif name in ("NEWOBJ", "REDUCE"):
            arguments, kind = stack.pop(), stack.pop()
            stack.append(_Object(kind.name, arguments))
        elif name == "BUILD":
            state = stack.pop()
            stack[-1].state = dict(state)
        elif name == "STOP":
            return stack.pop()
        elif name != "PROTO":
            raise _NotWeightsError(f"instruction {name}")
    raise ValueError("the list of weights has no end")


def _arrays(root: Any) -> dict[str, tuple]:
    """How each array below `root` is to be rebuilt, by its name."""
    arrays: dict[str, tuple] = {}
    pending = [("", root)]
    for _ in range(_MAX_MODULES):
        if not pending:
            return arrays
        name, value = pending.pop()
        if len(name) > _MAX_PATH:
            break
        if value.kind == _REBUILD:
            arrays[name] = value.arguments
        elif value.kind.startswith("__torch__."):
            inner = [(f"{name}.{key}" if name else key, part) for key, part in value.state.items()]
            pending += [(key, part) for key, part in inner if isinstance(part, _Object)]
        else:
            raise _NotWeightsError(value.kind)
    raise _NotWeightsError("modules without end")


def _array(
    arguments: tuple, archive: zipfile.ZipFile, folder: str, storages: dict[str, NDArray]
) -> NDArray[np.floating]:
    """The array that `_rebuild_tensor_v2` would make: (storage, offset, shape, strides, ...), counted in elements."""
    storage, offset, shape, strides = arguments[:4]
    _, kind, key, _, _ = storage.arguments
    if not (isinstance(key, str) and key.isdecimal() and len(key) < 8):
        raise ValueError("an array has no number")
    if key not in storages:
        storages[key] = np.frombuffer(archive.read(f"{folder}/{key}"), _STORAGES[kind.name.removeprefix("torch ")])
    numbers = storages[key]
    if len(shape) > _MAX_RANK or not all(isinstance(n, int) and n >= 0 for n in (offset, *shape, *strides)):
        raise ValueError("an array has no shape")
    # Weights lie row by row; anything else would be a trick.
    count, by_rows = 1, []
    for size in reversed(shape):
        by_rows.append(count)
        count *= size
    if by_rows[::-1] != list(strides) or offset + count > len(numbers):
        raise ValueError("an array does not lie in its numbers")
    return numbers[offset : offset + count].reshape(shape)

"""Text files of data: JSON and the pydantic models in it, read with limits and written whole.

Size, nesting and number of values are bounded before anything is made of them, and what is read is Unicode: what has
been read can be written.
"""

from __future__ import annotations

import json
import re
from collections.abc import Callable
from pathlib import Path
from typing import Any, TypeVar

from pydantic import BaseModel, ValidationError
from pydantic_core import PydanticSerializationError

from splashbench.errors import SplashbenchError
from splashbench.files.atomic import write_text
from splashbench.files.plain import read_plain

MAX_JSON_BYTES = 64 << 20
#: Lists and tables within each other; what is written again must stay far below the writers' limits.
MAX_NESTING = 32
#: Values of a JSON file: a few bytes make one, and each takes some fifty in memory.
MAX_VALUES = 5_000_000
_MAX_PLACE = 200
# JSON can spell half of a surrogate pair, which is no character and cannot be written.
_SURROGATE = re.compile(r"\\u[dD][89a-fA-F]")

Model = TypeVar("Model", bound=BaseModel)


def read_document(path: Path, kind: str, parse: Callable[[str], Any], max_bytes: int) -> Any:
    """Parse a text file.

    Raises SplashbenchError where it is missing, no regular file, larger than `max_bytes`, nested deeper than
    MAX_NESTING, or not of its `kind`.
    """
    path = Path(path)
    try:
        data = parse(read_plain(path, max_bytes).decode("utf-8"))
        if _is_deep(data):
            raise ValueError(f"more than {MAX_NESTING} lists or tables within each other")
        return data
    except FileNotFoundError:
        raise SplashbenchError(f"{path} does not exist; check the path, or make it again") from None
    except (OSError, ValueError, RecursionError, MemoryError) as error:
        raise SplashbenchError(f"{path} cannot be read as {kind} ({_short(error)}); fix or restore it") from None


def _is_deep(data: Any) -> bool:
    """Whether lists and tables lie deeper within each other than MAX_NESTING."""
    level = [data]
    for _ in range(MAX_NESTING + 1):
        level = [
            child
            for parent in level
            if isinstance(parent, (dict, list))
            for child in (parent.values() if isinstance(parent, dict) else parent)
            if isinstance(child, (dict, list))
        ]
        if not level:
            return False
    return True


def _short(error: BaseException) -> str:
    return str(error)[:_MAX_PLACE]


def read_json(path: Path) -> Any:
    """Read a JSON file. Raises SplashbenchError where it is missing, too large or not JSON."""
    return read_document(path, "JSON", _parse_json, MAX_JSON_BYTES)


def _parse_json(text: str) -> Any:
    if text.count(",") + text.count("[") + text.count("{") > MAX_VALUES:
        raise ValueError(f"more than {MAX_VALUES} values")
    data = json.loads(text)
    if _SURROGATE.search(text):
        try:
            json.dumps(data, ensure_ascii=False).encode("utf-8")
        except UnicodeEncodeError:
            raise ValueError("it holds half of a surrogate pair, which is no character") from None
    return data


def write_json(path: Path, data: Any) -> None:
    """Write `data` as indented JSON, whole or not at all. NaN and infinity are refused: JSON has neither."""
    write_text(path, json.dumps(data, indent=1, allow_nan=False) + "\n")


def validate_model(path: Path, model: type[Model], data: Any) -> Model:
    """Validate `data`, read from `path`, against a pydantic model. Raises SplashbenchError with the first fault."""
    try:
        return model.model_validate(data)
    except ValidationError as error:
        first = error.errors(include_url=False, include_context=False, include_input=False)[0]
        place = ".".join(str(part) for part in first["loc"])[:_MAX_PLACE] or "the whole file"
        more = f" (and {error.error_count() - 1} more)" if error.error_count() > 1 else ""
        fault = first["msg"].removeprefix("Value error, ")
        raise SplashbenchError(f"{path}: {place}: {fault}{more}; fix this entry") from None


def read_model(path: Path, model: type[Model]) -> Model:
    """Read a JSON file as a pydantic model."""
    return validate_model(path, model, read_json(path))


def write_model(path: Path, model: BaseModel) -> None:
    """Write a pydantic model as JSON, whole or not at all. Raises SplashbenchError for what JSON cannot say."""
    try:
        text = model.model_dump_json(indent=1) + "\n"
    except (PydanticSerializationError, UnicodeEncodeError) as error:
        raise SplashbenchError(f"{path} cannot be written as JSON ({_short(error)}); change what it holds") from None
    write_text(path, text)

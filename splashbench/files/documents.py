"""JSON files and the pydantic models in them, read with limits and written whole."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any, TypeVar

from pydantic import BaseModel, ValidationError

from splashbench.errors import SplashbenchError
from splashbench.files.atomic import write_text
from splashbench.files.places import require_plain_file

MAX_JSON_BYTES = 256 << 20

Model = TypeVar("Model", bound=BaseModel)


def read_document(path: Path, kind: str, parse: Callable[[str], Any], max_bytes: int) -> Any:
    """Parse a text file. Raises SplashbenchError where it is missing, larger than `max_bytes` or not of its `kind`."""
    path = Path(path)
    try:
        require_plain_file(path)
        if path.stat().st_size > max_bytes:
            raise SplashbenchError(f"{path} is larger than {max_bytes >> 20} MiB; check that it is the right file")
        return parse(path.read_text(encoding="utf-8"))
    except FileNotFoundError:
        raise SplashbenchError(f"{path} does not exist; check the path, or make it again") from None
    except (OSError, ValueError, RecursionError) as error:
        raise SplashbenchError(f"{path} cannot be read as {kind} ({error}); fix or restore it") from None


def read_json(path: Path) -> Any:
    """Read a JSON file. Raises SplashbenchError where it is missing, too large or not JSON."""
    return read_document(path, "JSON", json.loads, MAX_JSON_BYTES)


def write_json(path: Path, data: Any) -> None:
    """Write `data` as indented JSON, whole or not at all. NaN and infinity are refused: JSON has neither."""
    write_text(path, json.dumps(data, indent=1, allow_nan=False) + "\n")


def validate_model(path: Path, model: type[Model], data: Any) -> Model:
    """Validate `data`, read from `path`, against a pydantic model. Raises SplashbenchError with the first fault."""
    try:
        return model.model_validate(data)
    except ValidationError as error:
        first = error.errors()[0]
        place = ".".join(str(part) for part in first["loc"]) or "the whole file"
        more = f" (and {error.error_count() - 1} more)" if error.error_count() > 1 else ""
        fault = first["msg"].removeprefix("Value error, ")
        raise SplashbenchError(f"{path}: {place}: {fault}{more}; fix this entry") from None


def read_model(path: Path, model: type[Model]) -> Model:
    """Read a JSON file as a pydantic model."""
    return validate_model(path, model, read_json(path))


def write_model(path: Path, model: BaseModel) -> None:
    """Write a pydantic model as JSON, whole or not at all."""
    write_text(path, model.model_dump_json(indent=1) + "\n")

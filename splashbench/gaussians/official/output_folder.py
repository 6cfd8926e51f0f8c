"""The output folder of an official code: its last point cloud, and the arguments of its training.

The folder holds `point_cloud/iteration_N/point_cloud.ply` and `cfg_args`, the arguments as Python would print them.
"""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from splashbench.errors import SplashbenchError
from splashbench.files import read_plain

_ITERATION = re.compile(r"iteration_(\d{1,9})")
_ARGUMENT = re.compile(r"(\w+)=('(?:[^'\\]|\\.)*'|\"(?:[^\"\\]|\\.)*\"|[^,()'\"\[\]]+)")
_MAX_ARGUMENTS_BYTES = 1 << 16


def last_iteration(folder: Path) -> int:
    """The largest N of the folders `folder`/iteration_N. Raises SplashbenchError where there is none."""
    matches = [_ITERATION.fullmatch(path.name) for path in folder.iterdir()] if folder.is_dir() else []
    numbers = [int(match[1]) for match in matches if match]
    if not numbers:
        raise SplashbenchError(f"{folder} holds no iteration_<n>; let the code save its last iteration")
    return max(numbers)


def last_point_cloud(output: Path) -> Path:
    """point_cloud/iteration_N/point_cloud.ply of the last iteration that was saved in `output`."""
    folder = output / "point_cloud"
    return folder / f"iteration_{last_iteration(folder)}" / "point_cloud.ply"


@dataclass(frozen=True)
class TrainingArguments:
    """cfg_args of an output folder: values as they are printed, by name. path: of the file, for messages."""

    path: Path
    values: dict[str, str]

    @classmethod
    def read(cls, output: Path) -> TrainingArguments:
        """Those of `output`; none where the file is missing."""
        path = output / "cfg_args"
        if not path.exists():
            return cls(path, {})
        text = read_plain(path, _MAX_ARGUMENTS_BYTES).decode("utf-8", "replace")
        if not text.lstrip().startswith("Namespace("):
            raise SplashbenchError(f"{path} does not begin with Namespace(; give the file as the code wrote it")
        return cls(path, {match[1]: match[2].strip() for match in _ARGUMENT.finditer(text)})

    def text(self, name: str, default: str | None = None) -> str:
        """The text `name`; `default` where there is none, or an error without one."""
        value = self._value(name, default)
        return value[1:-1] if value[:1] in ("'", '"') else value

    def number(self, name: str, default: float | None = None) -> float:
        """The finite number `name`."""
        value = self._value(name, None if default is None else repr(default))
        try:
            number = float(value)
        except ValueError:
            number = np.nan
        if not np.isfinite(number):
            raise SplashbenchError(f"{self.path}: {name} is {value[:40]}, not a number; give the code's own file")
        return number

    def flag(self, name: str) -> bool:
        """Whether the option `name` was given."""
        return self._value(name, "False") == "True"

    def _value(self, name: str, default: str | None) -> str:
        value = self.values.get(name, default)
        if value is None:
            raise SplashbenchError(
                f"{self.path} {'lacks ' + name if self.values else 'is missing'}; keep it beside point_cloud, as the "
                "code wrote it"
            )
        return value

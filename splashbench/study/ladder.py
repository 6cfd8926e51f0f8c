"""Ladders: what a method is made larger by, rung for rung, as typed or as the method declares it."""

from __future__ import annotations

import difflib
import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from splashbench.errors import SplashbenchError
from splashbench.harness.contract import Method
from splashbench.harness.runner import override_texts, parse_overrides


@dataclass(frozen=True)
class Ladder:
    """columns: setting (dotted where it is nested) -> its value on every rung, from the smallest model to the largest;
    all of one length."""

    columns: Mapping[str, tuple[Any, ...]]

    @property
    def height(self) -> int:
        """Number of rungs."""
        return len(next(iter(self.columns.values())))

    def settings(self, rung: int) -> dict[str, Any]:
        """The settings of rung `rung`, from 1 on, as `Method.Config.preset` takes them."""
        return parse_overrides(override_texts(self.row(rung)))

    def row(self, rung: int) -> dict[str, Any]:
        """Setting -> value on rung `rung`, from 1 on."""
        return {name: values[rung - 1] for name, values in self.columns.items()}

    def text(self, rung: int) -> str:
        """The settings of rung `rung` as one types them: "iterations=400 points=2000"."""
        return " ".join(override_texts(self.row(rung)))


def parse_ladder(texts: Sequence[str]) -> Ladder:
    """The ladder of `texts`, each SETTING=V1,V2,...; several are climbed together.

    Values are JSON where they parse, else text. Raises SplashbenchError, one line, where they make no ladder.
    """
    columns: dict[str, tuple[Any, ...]] = {}
    for text in texts:
        name, separator, values = text.partition("=")
        if not separator or not name or not all(value.strip() for value in values.split(",")):
            raise SplashbenchError(f"--ladder {text!r} is not SETTING=V1,V2,...; write it like iterations=100,400,1600")
        if name in columns:
            raise SplashbenchError(f"--ladder gives {name} twice; give it once, with a value for each rung")
        columns[name] = _values(values)
    return _checked(columns, "--ladder")


def declared_ladder(method: Method) -> Ladder | None:
    """The ladder that `method` declares (`MethodConfig.capacity`), None where it declares none.

    Raises SplashbenchError, one line, for a setting it has not, unequal lengths, values that fall, and equal rungs.
    """
    declared = method.Config.capacity
    if not declared:
        return None
    where = f"the ladder that {method.id} declares ({method.Config.__name__}.capacity)"
    for name, values in declared.items():
        if name not in method.Config.model_fields:
            near = difflib.get_close_matches(name, method.Config.model_fields, n=1)
            hint = f", did you mean {near[0]!r}?" if near else ""
            raise SplashbenchError(f"{where} has {name!r}, which is no setting{hint}")
        if all(_is_number(value) for value in values) and sorted(values) != list(values):
            raise SplashbenchError(f"{where} does not rise: {name} is {', '.join(map(str, values))}; sort the rungs")
    return _checked({name: tuple(values) for name, values in declared.items()}, where)


def ladder_of(method: Method, texts: Sequence[str], preset: str) -> Ladder:
    """The ladder of `texts`, or where there are none the one that `method` declares.

    Raises SplashbenchError, one line, where there is neither; it names the remedy and the numeric settings.
    """
    if texts:
        return parse_ladder(texts)
    declared = declared_ladder(method)
    if declared is not None:
        return declared
    settings = method.Config.preset(preset)
    numeric = [name for name in method.Config.model_fields if _is_number(getattr(settings, name))]
    if not numeric:
        raise SplashbenchError(f"method {method.id} declares no ladder and has no numeric setting to climb by")
    raise SplashbenchError(
        f"method {method.id} declares no ladder; give one, such as --ladder {numeric[0]}=V1,V2,V3; "
        f"its numeric settings: {', '.join(numeric)}"
    )


def _checked(columns: dict[str, tuple[Any, ...]], where: str) -> Ladder:
    lengths = {name: len(values) for name, values in columns.items()}
    if len(set(lengths.values())) > 1:
        counts = ", ".join(f"{name} has {count}" for name, count in lengths.items())
        raise SplashbenchError(f"{where}: settings are climbed together and need as many values each, but {counts}")
    ladder = Ladder(columns)
    if ladder.height == 0:
        raise SplashbenchError(f"{where} has no rung; give each setting a value at least")
    rows = [ladder.text(rung) for rung in range(1, ladder.height + 1)]
    twice = next((row for row in rows if rows.count(row) > 1), None)
    if twice is not None:
        raise SplashbenchError(f"{where}: two rungs are {twice}; leave one out")
    return ladder


def _values(text: str) -> tuple[Any, ...]:
    """The values of V1,V2,...: a JSON list without its brackets, or else texts between commas."""
    try:
        return tuple(json.loads(f"[{text}]"))
    except (ValueError, RecursionError):
        return tuple(parse_overrides([f"x={value.strip()}"])["x"] for value in text.split(","))


def _is_number(value: Any) -> bool:
    return isinstance(value, (int, float)) and not isinstance(value, bool)

"""JSON from strangers: what was written is read, and what is damaged is told in a line."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

from hypothesis import given, settings
from hypothesis import strategies as st

from splashbench.files import read_json, write_json

Outcome = Callable[[str, int], str]


@settings(settings.get_profile("files"), max_examples=60)
@given(number=st.integers(0, 2**40))
def test_no_damaged_json_is_more_than_one_line(number: int, outcome: Outcome) -> None:
    assert outcome("json", number) == ""


_WORDS = st.text(st.characters(codec="utf-8"), max_size=12)
_VALUES = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats(allow_nan=False, allow_infinity=False) | _WORDS,
    lambda inner: st.lists(inner, max_size=4) | st.dictionaries(_WORDS, inner, max_size=4),
    max_leaves=20,
)


@settings(settings.get_profile("files"), max_examples=60)
@given(data=_VALUES)
def test_what_was_written_is_read(data: Any, tmp_path: Path) -> None:
    write_json(path := tmp_path / "a.json", data)
    assert read_json(path) == data

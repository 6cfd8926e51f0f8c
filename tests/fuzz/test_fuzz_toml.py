"""TOML from strangers: what was written is read, and what is damaged is told in a line."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

from hypothesis import given, settings
from hypothesis import strategies as st

from splashbench import toml

Outcome = Callable[[str, int], str]


@settings(settings.get_profile("files"), max_examples=60)
@given(number=st.integers(0, 2**40))
def test_no_damaged_toml_is_more_than_one_line(number: int, outcome: Outcome) -> None:
    assert outcome("toml", number) == ""


_WORDS = st.text(st.characters(codec="utf-8"), max_size=12)
_VALUES = st.recursive(
    st.booleans() | st.integers(-(2**63), 2**63 - 1) | st.floats(allow_nan=False) | _WORDS,
    lambda inner: st.lists(inner, max_size=4) | st.dictionaries(_WORDS, inner, max_size=4),
    max_leaves=12,
)


@settings(settings.get_profile("files"), max_examples=60)
@given(data=st.dictionaries(_WORDS, _VALUES, max_size=5))
def test_what_was_written_is_read(data: dict[str, Any], tmp_path: Path) -> None:
    (path := tmp_path / "a.toml").write_bytes(toml.dumps(data).encode("utf-8"))
    assert toml.load(path) == data

"""Meshes from strangers: none that is damaged stops more than its own reading."""

from __future__ import annotations

from collections.abc import Callable

from hypothesis import given, settings
from hypothesis import strategies as st

Outcome = Callable[[str, int], str]


@settings(settings.get_profile("files"), max_examples=60)
@given(number=st.integers(0, 2**40))
def test_no_damaged_mesh_is_more_than_one_line(number: int, outcome: Outcome) -> None:
    assert outcome("mesh", number) == ""

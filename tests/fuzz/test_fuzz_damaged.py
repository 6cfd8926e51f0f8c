"""Files from strangers: what is damaged is told in a line, and what `check` passes `score` takes."""

from __future__ import annotations

from collections.abc import Callable

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

# How many cases of each kind, by how long they take.
COUNTS = {"toml": 60, "json": 60, "npz": 80, "image": 80, "mesh": 60, "media": 60, "submission": 20, "scene": 15}


@pytest.mark.parametrize("kind", COUNTS)
def test_no_damaged_file_is_more_than_one_line(kind: str, outcome: Callable[[str, int], str]) -> None:
    @settings(settings.get_profile("files"), max_examples=COUNTS[kind])
    @given(number=st.integers(0, 2**40))
    def told(number: int) -> None:
        assert outcome(kind, number) == ""

    told()

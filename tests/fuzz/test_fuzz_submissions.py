"""Submissions from strangers: `check` and `score` say in a line what is wrong, and agree."""

from __future__ import annotations

from collections.abc import Callable

from hypothesis import given, settings
from hypothesis import strategies as st

Outcome = Callable[[str, int], str]


@settings(settings.get_profile("files"), max_examples=20)
@given(number=st.integers(0, 2**40))
def test_no_damaged_submission_is_more_than_one_line(number: int, outcome: Outcome) -> None:
    assert outcome("submission", number) == ""

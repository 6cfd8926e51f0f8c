"""Markdown from strangers' texts: no cell leaves its column, and no text opens an HTML tag."""

import pytest

from splashbench.markdown import bullets, one_line, table


def test_a_table_has_a_line_per_row_and_numbers_to_the_right() -> None:
    text = table({"Method": ["a", "b"], "PSNR": ["20.13", "–"]}, right={"PSNR"})
    assert text.splitlines() == ["| Method | PSNR |", "| --- | ---: |", "| a | 20.13 |", "| b | – |"]


def test_odd_text_stays_in_its_cell() -> None:
    assert table({"Note": ["a | b\nc <script>"]}).splitlines()[2] == "| a \\| b c &lt;script> |"


def test_columns_of_different_lengths_are_refused() -> None:
    with pytest.raises(ValueError, match="shorter"):
        table({"a": ["1", "2"], "b": ["1"]})


def test_lists_take_their_lines_as_they_are() -> None:
    assert bullets([one_line(" a\n b"), "c"]) == "- a b\n- c"

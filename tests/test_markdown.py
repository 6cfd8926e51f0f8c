"""Markdown from strangers' texts: no cell leaves its column, and no text opens an HTML tag."""

import pytest

from splashbench.markdown import bullets, escaped, one_line, table


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


@pytest.mark.parametrize(
    ("text", "safe"),
    [
        ("spacetime_gaussians__bowl (ab12)", "spacetime_gaussians__bowl (ab12)"),
        ("[x](http://evil.example)", "\\[x\\](http\\://evil.example)"),
        ("![picture](a)", "!\\[picture\\](a)"),
        ("see https://evil.example or www.evil.example", "see https\\://evil.example or www\\.evil.example"),
        ("me@evil.example", "me\\@evil.example"),
        ("# heading", "\\# heading"),
        ("- item", "\\- item"),
        ("1. item", "1\\. item"),
        ("`code` *b* _i_ __b__ ~~s~~ $x$", "\\`code\\` \\*b\\* \\_i\\_ \\_\\_b\\_\\_ \\~\\~s\\~\\~ \\$x\\$"),
        ("<b>&lt;", "&lt;b>\\&lt;"),
        ("a\x1b[31m\nb\u202e", "a?\\[31m b?"),
        ("-2.5", "-2.5"),
    ],
)
def test_no_text_of_a_stranger_is_markup(text: str, safe: str) -> None:
    assert escaped(text) == safe


def test_a_backslash_before_a_bar_opens_no_column() -> None:
    assert table({"a": [escaped("x\\|y")]}).splitlines()[2] == "| x\\\\\\|y |"

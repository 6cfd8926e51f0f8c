"""What options take: limits of numbers and sizes, and one line that says them."""

from __future__ import annotations

import argparse

import pytest

from splashbench.cli.arguments import image_size, positive_number, whole_number


@pytest.mark.parametrize(
    ("least", "greatest", "good", "bad"),
    [
        (0, None, {"0": 0, "007": 7, "123456": 123456}, ["-1", "1.5", "", "one", "1e3", "+1"]),
        (1, None, {"1": 1}, ["0"]),
        (2, 40, {"2": 2, "40": 40}, ["1", "41"]),
    ],
)
def test_a_whole_number_lies_within_its_limits(
    least: int, greatest: int | None, good: dict[str, int], bad: list[str]
) -> None:
    parse = whole_number(least, greatest)
    assert {text: parse(text) for text in good} == good
    limits = f"of {least} or more" if greatest is None else f"from {least} to {greatest}"
    for text in bad:
        with pytest.raises(argparse.ArgumentTypeError, match=f"is not a whole number {limits}"):
            parse(text)


def test_a_positive_number_is_finite_and_above_0() -> None:
    parse = positive_number("seconds")
    assert [parse(text) for text in ("0.5", "1e3", "7")] == [0.5, 1000.0, 7.0]
    for text in ("0", "-1", "inf", "nan", "", "ten"):
        with pytest.raises(argparse.ArgumentTypeError, match="is not a number of seconds above 0"):
            parse(text)


def test_a_positive_number_may_have_an_upper_limit() -> None:
    parse = positive_number("metres", below=10)
    assert parse("9.99") == 9.99
    for text in ("0", "10", "11"):
        with pytest.raises(argparse.ArgumentTypeError, match="is not a number of metres between 0 and 10"):
            parse(text)


def test_an_image_size_is_two_numbers_of_pixels() -> None:
    assert [image_size(text) for text in ("480x270", "1X1", "8192x8192")] == [(480, 270), (1, 1), (8192, 8192)]
    for text in ("480", "480x", "x270", "480x270x3", "-1x5", "4.5x5"):
        with pytest.raises(argparse.ArgumentTypeError, match="is no size; write it like 480x270"):
            image_size(text)
    for text in ("0x5", "5x0", "8193x5", "5x8193"):
        with pytest.raises(argparse.ArgumentTypeError, match="is out of range; give 1x1 to 8192x8192"):
            image_size(text)

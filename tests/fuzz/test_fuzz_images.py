"""Images from strangers: what was written is read, and what is damaged is told in a line."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as arrays

from splashbench.files import read_png, require_png, write_png

Outcome = Callable[[str, int], str]


@settings(settings.get_profile("files"), max_examples=80)
@given(number=st.integers(0, 2**40))
def test_no_damaged_image_is_more_than_one_line(number: int, outcome: Outcome) -> None:
    assert outcome("image", number) == ""


@settings(settings.get_profile("files"), max_examples=40)
@given(
    pixels=arrays.arrays(
        np.uint8,
        st.tuples(st.integers(1, 40), st.integers(1, 40), st.just(3))
        | st.tuples(st.integers(1, 40), st.integers(1, 40)),
    )
)
def test_what_was_written_is_read(pixels: np.ndarray, tmp_path: Path) -> None:
    write_png(path := tmp_path / "a.png", pixels)
    colour = "RGB" if pixels.ndim == 3 else "grey"
    header = require_png(path, colour, pixels=True)
    assert (header.height, header.width) == pixels.shape[:2]
    np.testing.assert_array_equal(read_png(path, colour), pixels)

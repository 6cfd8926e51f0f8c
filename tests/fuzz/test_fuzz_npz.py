"""Arrays from strangers: what numpy wrote is read, and what is damaged is told in a line."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as arrays

from splashbench.files import read_npz, write_npz

Outcome = Callable[[str, int], str]


@settings(settings.get_profile("files"), max_examples=80)
@given(number=st.integers(0, 2**40))
def test_no_damaged_archive_is_more_than_one_line(number: int, outcome: Outcome) -> None:
    assert outcome("npz", number) == ""


@settings(settings.get_profile("files"), max_examples=80)
@given(
    array=arrays.arrays(
        arrays.floating_dtypes(endianness="?", sizes=(16, 32, 64))
        | arrays.integer_dtypes(endianness="?")
        | arrays.unsigned_integer_dtypes(endianness="?")
        | arrays.boolean_dtypes(),
        arrays.array_shapes(min_dims=0, max_dims=4, min_side=0, max_side=5),
        elements={"allow_nan": False, "allow_infinity": False},
    ),
    how=st.sampled_from(["plain", "packed", "ours", "in columns"]),
)
def test_what_numpy_wrote_is_read(array: np.ndarray, how: str, tmp_path: Path) -> None:
    path = tmp_path / "a.npz"
    if how == "ours":
        write_npz(path, {"a": array})
    else:
        save = np.savez_compressed if how == "packed" else np.savez
        save(path, a=np.asarray(array, order="F") if how == "in columns" else array)
    found = read_npz(path, {"a": array.ndim})["a"]
    assert found.dtype == array.dtype
    np.testing.assert_array_equal(found, array)

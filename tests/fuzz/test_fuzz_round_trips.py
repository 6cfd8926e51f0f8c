"""What was written is read: JSON, TOML, arrays and images of every kind that there is."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as arrays

from splashbench import toml
from splashbench.files import read_json, read_npz, read_png, require_png, write_json, write_npz, write_png

_WORDS = st.text(st.characters(codec="utf-8"), max_size=12)


def _values(leaves: st.SearchStrategy[Any]) -> st.SearchStrategy[Any]:
    return st.recursive(
        leaves | st.booleans() | _WORDS,
        lambda inner: st.lists(inner, max_size=4) | st.dictionaries(_WORDS, inner, max_size=4),
        max_leaves=20,
    )


@settings(settings.get_profile("files"), max_examples=60)
@given(data=_values(st.none() | st.integers() | st.floats(allow_nan=False, allow_infinity=False)))
def test_json(data: Any, tmp_path: Path) -> None:
    write_json(path := tmp_path / "a.json", data)
    assert read_json(path) == data


@settings(settings.get_profile("files"), max_examples=60)
@given(data=st.dictionaries(_WORDS, _values(st.integers(-(2**63), 2**63 - 1) | st.floats(allow_nan=False)), max_size=5))
def test_toml(data: dict[str, Any], tmp_path: Path) -> None:
    (path := tmp_path / "a.toml").write_bytes(toml.dumps(data).encode("utf-8"))
    assert toml.load(path) == data


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
def test_arrays(array: np.ndarray, how: str, tmp_path: Path) -> None:
    path = tmp_path / "a.npz"
    if how == "ours":
        write_npz(path, {"a": array})
    else:
        save = np.savez_compressed if how == "packed" else np.savez
        save(path, a=np.asarray(array, order="F") if how == "in columns" else array)
    found = read_npz(path, {"a": array.ndim})["a"]
    assert found.dtype == array.dtype
    np.testing.assert_array_equal(found, array)


@settings(settings.get_profile("files"), max_examples=40)
@given(
    pixels=arrays.arrays(
        np.uint8,
        st.tuples(st.integers(1, 40), st.integers(1, 40), st.just(3))
        | st.tuples(st.integers(1, 40), st.integers(1, 40)),
    )
)
def test_images(pixels: np.ndarray, tmp_path: Path) -> None:
    write_png(path := tmp_path / "a.png", pixels)
    colour = "RGB" if pixels.ndim == 3 else "grey"
    header = require_png(path, colour, pixels=True)
    assert (header.height, header.width) == pixels.shape[:2]
    np.testing.assert_array_equal(read_png(path, colour), pixels)

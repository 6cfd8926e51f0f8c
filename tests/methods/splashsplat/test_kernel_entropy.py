"""Codes of whole numbers: what is read is what was written, short where it should be; damage ends in ValueError."""

from __future__ import annotations

import resource
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

from splashbench_methods.splashsplat.kernel.entropy import (
    read_field,
    read_frames,
    read_table,
    write_field,
    write_frames,
    write_table,
)

RNG = np.random.default_rng(5)
LARGEST = 2**31 - 1
TABLES = {
    "none": np.zeros((0, 3), np.int32),
    "no columns": np.zeros((4, 0), np.int32),
    "one": np.array([[7]], np.int32),
    "zeros": np.zeros((5000, 2), np.int32),
    "small": RNG.normal(0, 3, (4000, 5)).astype(np.int32),
    "skewed": np.stack([RNG.geometric(0.2, 3000), -(RNG.geometric(0.01, 3000) ** 2)], 1).astype(np.int32),
    "extremes": RNG.choice(np.array([-LARGEST, LARGEST, 0, -1, 1, 2**30, -(2**30)], np.int32), (800, 3)),
    "bits": RNG.integers(-LARGEST, LARGEST + 1, (700, 3)).astype(np.int32),
    "powers": np.array([[s * 2**k + d] for k in range(31) for s in (1, -1) for d in (-1, 0)], np.int32),
    "bytes": RNG.integers(0, 256, (3000, 1)).astype(np.uint8),
}


@pytest.mark.parametrize("near", [0, 1, 2])
@pytest.mark.parametrize("name", TABLES)
def test_a_table_is_read_as_it_was_written(name: str, near: Any) -> None:
    table = TABLES[name]
    code = write_table(table, near)
    assert code.dtype == np.uint8
    found = read_table(code, table.shape, near)
    assert found.dtype == np.int32
    np.testing.assert_array_equal(found, table)
    np.testing.assert_array_equal(write_table(np.asfortranarray(found), near), code)


def field_of(shape: tuple[int, ...]) -> np.ndarray:
    field = np.cumsum(RNG.normal(0, 40, shape), axis=3).astype(np.int16)
    field[:, : shape[1] // 2] = 0
    return field


@pytest.mark.parametrize("shape", [(3, 5, 4, 6, 3), (1, 2, 2, 2, 3), (0, 4, 4, 4, 3), (4, 1, 1, 1, 1), (2, 3, 1, 7, 2)])
def test_a_field_is_read_as_it_was_written(shape: tuple[int, int, int, int, int]) -> None:
    for field in (
        field_of(shape),
        RNG.integers(-32768, 32768, shape).astype(np.int16),
        np.full(shape, -32768, np.int16),
    ):
        found = read_field(write_field(field), shape)
        assert found.dtype == np.int16
        np.testing.assert_array_equal(found, field)


def distances(shape: tuple[int, ...]) -> np.ndarray:
    """Of a ball that moves."""
    axes = np.meshgrid(*(np.arange(n) for n in shape[1:]), indexing="ij")
    frames = [
        np.sqrt(sum((axis - 0.5 * n - t) ** 2 for axis, n in zip(axes, shape[1:]))) - 0.3 * shape[1]
        for t in range(shape[0])
    ]
    return np.clip(np.floor(4 * np.stack(frames)), -13, 12).astype(np.int8) if frames else np.zeros(shape, np.int8)


@pytest.mark.parametrize("shape", [(4, 20, 17, 23), (1, 4, 4, 4), (3, 1, 1, 1), (0, 5, 5, 5), (2, 3, 9, 4)])
def test_frames_are_read_as_they_were_written(shape: tuple[int, ...]) -> None:
    noise = RNG.integers(-13, 13, shape).astype(np.int8)
    for frames, ends in ((distances(shape), (-13, 12)), (noise, (-13, 12)), (np.sign(noise), (-128, 127))):
        found = list(read_frames(write_frames(frames, ends), shape, ends))
        assert len(found) == shape[0]
        for given, read in zip(frames, found):
            np.testing.assert_array_equal(read, given)


def test_codes_are_as_short_as_what_they_say() -> None:
    # By the entropy of what was drawn, to within what learning the probabilities takes.
    drawn = np.random.default_rng(0).choice([0, 1, -1], p=[0.9, 0.05, 0.05], size=(40_000, 1))
    bits = -0.9 * np.log2(0.9) - 0.1 * np.log2(0.05)
    assert len(write_table(drawn, 0)) * 8 == pytest.approx(40_000 * bits, rel=0.04)
    assert len(write_table(np.zeros((100_000, 1), np.int32), 0)) < 160
    # Where large rows follow large ones the rows before say so, and else the columns before, in the same row.
    rng = np.random.default_rng(1)
    for runs, near in ((100, 1), (1, 2)):
        scale = np.repeat(rng.choice([0.3, 300.0], 20_000 // runs), runs)[:, None]
        table = np.rint(scale * rng.normal(size=(20_000, 3))).astype(np.int32)
        sizes = [len(write_table(table, each)) for each in (0, 1, 2)]
        assert sizes[near] < 0.95 * sizes[near - 1], sizes
    # A ball that moves is known from its frames before, and empty space costs nothing.
    shape = (6, 40, 40, 40)
    code = write_frames(distances(shape), (-13, 12))
    assert len(code) < 0.35 * 6 * 40**3 / 8
    assert len(write_frames(np.zeros((6, 200, 200, 200), np.int8), (-13, 12))) < 2000


def read_as(kind: str, code: np.ndarray) -> None:
    if kind == "table":
        read_table(code, (500, 3), 2)
    elif kind == "field":
        read_field(code, (3, 5, 4, 6, 3))
    else:
        for _ in read_frames(code, (3, 12, 11, 13), (-13, 12)):
            pass


CODES: dict[str, Callable[[], np.ndarray]] = {
    "table": lambda: write_table(RNG.normal(0, 9, (500, 3)).astype(np.int32), 2),
    "field": lambda: write_field(field_of((3, 5, 4, 6, 3))),
    "frames": lambda: write_frames(distances((3, 12, 11, 13)), (-13, 12)),
}


@pytest.mark.parametrize("kind", CODES)
def test_damage_is_refused_or_other_numbers_and_never_more(kind: str) -> None:
    """What a checksum would have caught, it did not; a code has none of its own."""
    whole, rng = CODES[kind](), np.random.default_rng(3)
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    errors = []
    for _ in range(600):
        code = whole.copy()
        how = rng.integers(4)
        if how == 0:
            code[rng.integers(len(code))] ^= np.uint8(1 << rng.integers(8))
        elif how == 1:
            code = rng.integers(0, 256, len(code)).astype(np.uint8)
        elif how == 2:
            code = code[: rng.integers(len(code))]
        else:
            code = np.append(code, rng.integers(0, 256, 1 + rng.integers(9)).astype(np.uint8))
        try:
            read_as(kind, code)
        except ValueError as error:
            errors.append(str(error))
    assert len(errors) > 500
    assert not [error for error in errors if "\n" in error]
    for pattern in (0, 0xFF, 0x80):
        with pytest.raises(ValueError, match=r"bytes|goes on"):
            read_as(kind, np.full(3 * len(whole), pattern, np.uint8))
    assert resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before < 50_000  # kilobytes


def test_more_than_so_few_bytes_can_say_is_refused_before_it_is_made() -> None:
    few = np.zeros(40, np.uint8)
    with pytest.raises(ValueError, match="cannot be"):
        read_table(few, (2**40, 1), 0)
    with pytest.raises(ValueError, match="cannot be"):
        read_table(few, (-1, 3), 0)
    with pytest.raises(ValueError, match="cannot be"):
        read_field(few, (2**20, 2**20, 2**20, 2**20, 3))
    with pytest.raises(ValueError, match="cannot be"):
        list(read_frames(few, (1, 2**20, 2**20, 2**20), (-13, 12)))
    with pytest.raises(ValueError, match="numbers are more than"):
        read_table(np.zeros(10**6, np.uint8), (2**29 + 1, 1), 0)  # which an archive of a hundred bytes may hold
    with pytest.raises(ValueError, match="columns"):
        read_table(np.zeros(1000, np.uint8), (1, 10_000), 0)
    for code in (np.zeros(40), np.zeros((4, 10), np.uint8), np.zeros(40, np.int8)):
        with pytest.raises(ValueError, match="not bytes"):
            read_table(code, (4, 1), 0)
    for shape in ((0, 3), (4, 1)):
        with pytest.raises(ValueError, match="bytes"):
            read_table(np.zeros(0, np.uint8), shape, 0)


def test_numbers_that_are_too_long_are_not_written() -> None:
    for number in (2**31, -(2**31), 2**40):
        with pytest.raises(ValueError, match="too large"):
            write_table(np.array([[number]]), 0)


def test_numbers_beyond_the_ends_of_a_scale_are_refused() -> None:
    code = write_frames(np.full((1, 4, 4, 4), 20, np.int8), (-128, 127))
    with pytest.raises(ValueError, match="frames"):
        list(read_frames(code, (1, 4, 4, 4), (-13, 12)))

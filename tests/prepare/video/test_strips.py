"""Statistics over frames: the same in strips as at once, and in little memory."""

from __future__ import annotations

import tracemalloc
from collections.abc import Iterator

import numpy as np
import pytest

from splashbench.prepare.video import strips


@pytest.fixture
def frames() -> list[np.ndarray]:
    rng = np.random.default_rng(3)
    scene = rng.uniform(30, 220, (41, 60, 3))
    return [np.clip(scene + rng.normal(0, 4, scene.shape), 0, 255).astype(np.uint8) for _ in range(14)]


@pytest.mark.parametrize("held_bytes", [1, 14 * 60 * 3 * 10, 1 << 30])
@pytest.mark.parametrize("strip_bytes", [1, 14 * 60 * 3 * 7, 1 << 30])
def test_strips_change_nothing(
    frames: list[np.ndarray], strip_bytes: int, held_bytes: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(strips, "_STRIP_BYTES", strip_bytes)
    monkeypatch.setattr(strips, "HELD_BYTES", held_bytes)
    stack = np.stack(frames)
    np.testing.assert_array_equal(strips.median_frame(frames), np.median(stack, axis=0).round().astype(np.uint8))
    np.testing.assert_array_equal(
        strips.median_frame([frame[..., 0] for frame in frames]), np.median(stack[..., 0], axis=0).round()
    )
    np.testing.assert_array_equal(strips.median_of(lambda: iter(frames), len(frames)), strips.median_frame(frames))
    median, deviation = strips.median_and_deviation(lambda: iter(frames), len(frames))
    whole = np.median(stack, axis=0).astype(np.float32)
    np.testing.assert_array_equal(median, whole)
    np.testing.assert_array_equal(deviation, np.median(np.abs(stack - whole), axis=0).mean(axis=-1))
    assert median.dtype == deviation.dtype == np.float32


def test_the_median_of_a_static_clip_has_less_noise() -> None:
    rng = np.random.default_rng(3)
    scene = rng.uniform(30, 220, (40, 60, 3))
    frames = [np.clip(scene + rng.normal(0, 4, scene.shape), 0, 255).astype(np.uint8) for _ in range(15)]
    assert np.std(strips.median_frame(frames) - scene) < 0.5 * np.std(frames[0] - scene)


def test_large_frames_take_little_beside_themselves() -> None:
    """At once it took forty times a frame."""
    frames = [np.full((1080, 1920, 3), k, np.uint8) for k in range(15)]
    tracemalloc.start()
    strips.median_and_deviation(lambda: frames, len(frames))
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert peak < 25 * frames[0].nbytes


def test_frames_that_are_too_many_are_read_several_times(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(strips, "HELD_BYTES", 4 << 20)
    reads = []

    def read() -> Iterator[np.ndarray]:
        reads.append(1)
        return (np.full((480, 640, 3), k, np.uint8) for k in range(15))

    tracemalloc.start()
    assert np.all(strips.median_of(read, 15) == 7)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert len(reads) == 4
    assert peak < 20 << 20  # all of them have 13.8 MB, and their median takes as much again

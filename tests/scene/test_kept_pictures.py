"""Photographs of a small scene are read once, those of a large one whenever they are asked for."""

from __future__ import annotations

import numpy as np
import pytest

from splashbench.scene import Scene, kept_pictures
from splashbench.scene.kept_pictures import KeptPictures


def counted(reads: list[tuple[str, int]]):
    def read(camera: str, t: int) -> np.ndarray:
        reads.append((camera, t))
        return np.full((2, 2), t, np.uint8)

    return read


def test_what_was_read_is_kept_and_nobody_spoils_it() -> None:
    reads: list[tuple[str, int]] = []
    kept = KeptPictures(100)
    first = kept.get("image", "1", 3, counted(reads))
    first[:] = 9
    np.testing.assert_array_equal(kept.get("image", "1", 3, counted(reads)), 3)
    kept.get("mask", "1", 3, counted(reads))
    kept.get("image", "2", 3, counted(reads))
    assert reads == [("1", 3), ("1", 3), ("2", 3)]


def test_of_a_large_scene_nothing_is_kept() -> None:
    reads: list[tuple[str, int]] = []
    kept = KeptPictures(kept_pictures.MAX_KEPT_BYTES + 1)
    for _ in range(2):
        kept.get("image", "1", 0, counted(reads))
    assert len(reads) == 2


def test_a_training_scene_gives_what_the_files_hold(balls: Scene, monkeypatch: pytest.MonkeyPatch) -> None:
    training = balls.training()
    for _ in range(2):
        np.testing.assert_array_equal(training.image("2", 1), balls.image("2", 1))
        np.testing.assert_array_equal(training.mask("2", 1), balls.mask("2", 1))
    assert training.mask("2", 1).dtype == bool
    monkeypatch.setattr(kept_pictures, "MAX_KEPT_BYTES", 4 * 64 * 96 * 5 * 8 - 1)
    larger = balls.training()
    np.testing.assert_array_equal(larger.image("2", 1), balls.image("2", 1))
    assert larger._pictures._pictures is None
    monkeypatch.setattr(kept_pictures, "MAX_KEPT_BYTES", 4 * 64 * 96 * 5 * 8)
    assert balls.training()._pictures._pictures == {}


def test_masks_of_a_large_scene_are_kept_packed(monkeypatch: pytest.MonkeyPatch) -> None:
    reads: list[int] = []
    masks = np.random.default_rng(0).random((3, 13, 17)) < 0.5

    def read(camera: str, t: int) -> np.ndarray:
        reads.append(t)
        return masks[t].copy()

    kept = KeptPictures(kept_pictures.MAX_KEPT_BYTES + 1)
    for t in (0, 1, 0, 1, 0):
        mask = kept.mask("1", t, read)
        np.testing.assert_array_equal(mask, masks[t])
        assert mask.dtype == bool
        mask[:] = False  # nobody spoils it
    assert reads == [0, 1]
    monkeypatch.setattr(kept_pictures, "MAX_PACKED_BYTES", kept._packed_bytes)
    for _ in range(2):
        np.testing.assert_array_equal(kept.mask("1", 2, read), masks[2])
    assert reads == [0, 1, 2, 2]

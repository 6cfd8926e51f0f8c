"""Images' memory is used again once nobody holds them, and never while somebody does."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from splashbench.native import memory

SHAPE = (600, 500, 3)


def address(array: np.ndarray) -> int:
    return array.__array_interface__["data"][0]


@pytest.fixture(autouse=True)
def _no_buffers(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(memory, "_buffers", [])


def test_memory_nobody_holds_is_used_again():
    first = memory.empty(SHAPE)
    place = address(first)
    del first
    again = memory.empty(SHAPE)
    assert (address(again), again.shape, again.dtype) == (place, SHAPE, np.float32)
    del again
    assert address(memory.empty((500, 500, 3))) == place


def test_memory_that_is_held_is_left_alone():
    first = memory.empty(SHAPE)
    tensor = torch.from_numpy(first)
    part = tensor[5:7].permute(2, 0, 1)
    place = address(first)
    del first, tensor
    part[:] = 7.0
    others = [memory.empty(SHAPE) for _ in range(3)]
    assert place not in {address(array) for array in others}
    for array in others:
        array[:] = 0
    assert (part == 7).all()
    del part
    assert address(memory.empty(SHAPE)) == place


def test_a_small_need_does_not_take_a_large_buffer():
    large = memory.empty((2000, 1000))
    place = address(large)
    del large
    assert address(memory.empty((600, 1000))) != place


def test_a_larger_buffer_takes_the_place_of_one_little_smaller():
    """Needs that grow from step to step leave no row of buffers behind."""
    held = memory.empty((550, 500, 3))
    far_smaller = memory.empty((200, 500, 3))
    for rows in range(560, 620, 10):
        memory.empty((rows, 500, 3))
    del far_smaller
    assert sorted(len(buffer) // 1500 for buffer in memory._buffers) == [200, 550, 610]
    held[:] = 7


def test_what_nobody_holds_is_forgotten():
    held = memory.empty(SHAPE)
    place = address(held)
    memory.empty((700, 500, 3))
    assert len(memory._buffers) == 2
    memory.forget()
    assert [address(buffer) for buffer in memory._buffers] == [place]
    del held
    memory.forget()
    assert memory._buffers == []


def test_only_so_much_is_kept(monkeypatch):
    monkeypatch.setattr(memory, "MAX_BYTES", 10_000_000)
    arrays = [memory.empty(SHAPE) for _ in range(8)]  # 3.6 MB each
    assert len(memory._buffers) == 2
    for i, array in enumerate(arrays):
        array[:] = i
    assert [array[0, 0, 0] for array in arrays] == list(range(8))


def test_small_arrays_are_ordinary_ones():
    assert memory.empty((10, 3)).base is None
    assert memory.empty((0, 3)).shape == (0, 3)
    assert memory._buffers == []


def test_giving_back_leaves_what_is_in_use():
    kept = memory.empty(SHAPE)
    kept[:] = 7
    freed = [np.ones(300_000) for _ in range(50)]
    del freed
    memory.give_back()
    assert (kept == 7).all()

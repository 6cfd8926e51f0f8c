"""Packed phi in blocks: the same nodes as the array, in less memory."""

import numpy as np
import pytest

from splashbench_methods.splashsplat.fields.sparse_frames import SparseFrames


def _balls(shape: tuple[int, int, int], frames: int) -> np.ndarray:
    """A ball that grows, as packed phi that ends three voxels from its surface: int8 [frames, *shape]."""
    nodes = np.stack(np.meshgrid(*(np.arange(n) for n in shape), indexing="ij"), -1)
    depth = np.linalg.norm(nodes - np.array(shape) / 2, axis=-1)
    phi = [np.clip(np.rint(16 * (depth - 4 - t)), -54, 50).astype(np.int8) for t in range(frames)]
    return np.stack(phi)


@pytest.mark.parametrize("shape", [(40, 36, 48), (41, 38, 43), (5, 2, 3), (1, 1, 1)])
def test_frames_are_what_was_added(shape: tuple[int, int, int]) -> None:
    for frames in (_balls(shape, 3), np.random.default_rng(0).integers(-128, 128, (2, *shape), dtype=np.int8)):
        sparse = SparseFrames(shape, frames)
        assert sparse.shape == frames.shape
        assert len(sparse) == len(frames)
        assert sparse.nbytes == frames.nbytes
        for t, frame in enumerate(sparse):
            np.testing.assert_array_equal(frame, frames[t])
            assert frame.flags.c_contiguous
            assert frame.dtype == np.int8
        np.testing.assert_array_equal(np.asarray(sparse), frames)


@pytest.mark.parametrize("value", [-128, -1, 0, 127])
def test_frames_that_are_all_alike_take_a_byte_a_block(value: int) -> None:
    sparse = SparseFrames((16, 16, 16), [np.full((16, 16, 16), value, np.int8)])
    assert sparse.held_bytes == 64
    assert (sparse[0] == value).all()


def test_a_splash_takes_a_part_of_its_nodes() -> None:
    frames = _balls((96, 96, 96), 4)
    assert SparseFrames((96, 96, 96), frames).held_bytes < 0.1 * frames.nbytes


def test_frames_are_told_apart_from_what_is_held() -> None:
    frames = _balls((12, 12, 12), 1)
    sparse = SparseFrames((12, 12, 12), frames)
    sparse[0][:] = 0
    np.testing.assert_array_equal(sparse[0], frames[0])


def test_the_last_frame_counts_from_the_end() -> None:
    frames = _balls((12, 12, 12), 3)
    np.testing.assert_array_equal(SparseFrames((12, 12, 12), frames)[-1], frames[-1])


@pytest.mark.parametrize("frame", [np.zeros((4, 4, 5), np.int8), np.zeros((4, 4, 4), np.int16)])
def test_other_frames_are_refused(frame: np.ndarray) -> None:
    with pytest.raises(ValueError, match=r"a frame is int(8|16) \(4, 4, [45]\), not int8 \(4, 4, 4\)"):
        SparseFrames((4, 4, 4), [frame])

"""A few timesteps that stand for all."""

import pytest

from splashbench.scene.frames import spread_frames


@pytest.mark.parametrize(
    ("n_frames", "most", "expected"),
    [(1, 8, [0]), (3, 8, [0, 1, 2]), (50, 3, [0, 24, 49]), (50, 2, [0, 49]), (50, 1, [0]), (9, 5, [0, 2, 4, 6, 8])],
)
def test_timesteps_are_evenly_spread(n_frames: int, most: int, expected: list[int]) -> None:
    assert spread_frames(n_frames, most).tolist() == expected

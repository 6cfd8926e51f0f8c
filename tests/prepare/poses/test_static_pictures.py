"""Which frames structure from motion is given: sharp ones of the sweep."""

from __future__ import annotations

import cv2
import numpy as np

from splashbench.prepare.poses.structure_from_motion import sharpest_per_bin, sharpness_of


def test_the_sharpest_frame_of_each_bin_is_taken() -> None:
    assert sharpest_per_bin([1, 5, 2, 9, 3, 3, 7, 0], 4) == [1, 3, 4, 6]
    assert sharpest_per_bin([1.0, 2.0], 25) == [0, 1]
    rng = np.random.default_rng(2)
    sharp = rng.integers(0, 255, (60, 80)).astype(np.uint8)
    assert sharpness_of(sharp) > 2 * sharpness_of(cv2.GaussianBlur(sharp, (0, 0), 1.0))

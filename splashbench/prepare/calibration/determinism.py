"""Keeping OpenCV's solvers to one thread, so that the same recordings give the same bits.

OpenCV's calibration adds up its normal equations in the order in which threads finish, and the last bits of a lens
differ from run to run. Per-pixel operations do not, and may keep their threads.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

import cv2


@contextmanager
def one_opencv_thread() -> Iterator[None]:
    """Within, OpenCV uses one thread."""
    before = cv2.getNumThreads()
    cv2.setNumThreads(1)
    try:
        yield
    finally:
        cv2.setNumThreads(before)

"""Distances in the image: from pixels to the outline of a mask, in whole frames and between two of them."""

from __future__ import annotations

import numpy as np


def _inner(mask: np.ndarray) -> np.ndarray:
    """Distance in pixels from the pixels of `mask` to its outline, float32 [h, w], -0.5 outside it."""
    import cv2

    distance = cv2.distanceTransform(mask.astype(np.uint8), cv2.DIST_L2, cv2.DIST_MASK_PRECISE)
    # OpenCV's root differs in the last bit with the alignment of its buffers; the squares are whole numbers.
    return np.sqrt(np.rint(distance**2)) - np.float32(0.5)


def outline_distance(mask: np.ndarray) -> np.ndarray:
    """Distance in pixels from the pixels of `mask` [h, w] to its outline, float32, below 0 outside it; infinite where
    there is no outline."""
    if not mask.any() or mask.all():
        return np.full(mask.shape, np.inf if mask.any() else -np.inf, np.float32)
    return np.where(mask, _inner(mask), -_inner(~mask)).astype(np.float32)


def inner_distance(mask: np.ndarray) -> np.ndarray:
    """Distance in pixels from the pixels of `mask` [h, w] to its outline, float32, -0.5 outside it; see below."""
    return np.ascontiguousarray(_inner(np.pad(mask, 1))[1:-1, 1:-1])


def signed_distance_2d(mask: np.ndarray) -> np.ndarray:
    """Signed distance in pixels from pixel centres to the outline of `mask`, negative inside.

    mask: bool [h, w]; the result is float32 [h, w].
    The outline runs between pixels, half a pixel from the centres on either side. Beyond the image there is no liquid.
    An empty mask is farther than anything in the image.
    """
    if not mask.any():
        return np.full(mask.shape, float(sum(mask.shape)), dtype=np.float32)
    padded = np.pad(mask, 1)
    distance = np.where(padded, -_inner(padded), _inner(~padded))
    return np.ascontiguousarray(distance[1:-1, 1:-1])


def blended(first: np.ndarray, second: np.ndarray, share: float) -> np.ndarray:
    """The signed distance between two frames: (1 - share) first + share second, float32 [h, w].

    A part of the nearer frame that moves by more than its own size would vanish between the two; it stays where it is.
    """
    import cv2

    between = (1 - np.float32(share)) * first + np.float32(share) * second
    nearer = first if share <= 0.5 else second
    count, labels = cv2.connectedComponents((nearer < 0).astype(np.uint8), connectivity=8)
    present = np.zeros(count, dtype=bool)
    present[labels[between < 0]] = True
    lost = ~present
    lost[0] = False
    return np.where(lost[labels], np.minimum(nearer, between), between)

"""PSNR and SSIM of one rendered frame within the liquid's mask (paper, "Metrics"; docs/protocol.md).

The test views are mostly static background, so everything here looks at the mask: PSNR averages over its pixels only
(averaging a masked image over all pixels would inflate it), SSIM is that of the masked images.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Image = NDArray[np.float64]
Mask = NDArray[np.bool_]

_K1, _K2 = 0.01, 0.03
# Where scikit-image cuts the Gaussian: radius int(3.5 sigma + 0.5), so 11 x 11 for sigma 1.5.
_TRUNCATE = 3.5


def psnr(render: Image, truth: Image, mask: Mask, cap_db: float = 100.0) -> float:
    """Peak signal-to-noise ratio in dB over the pixels of `mask`, at most `cap_db`.

    Args:
        render, truth: [H, W, 3] in [0, 1].
        mask: [H, W], with at least one pixel.
    """
    difference = render[mask] - truth[mask]
    error = float(np.mean(np.square(difference)))
    return cap_db if error == 0 else min(cap_db, -10.0 * np.log10(error))


def outside_filled(image: Image, truth: Image, mask: Mask, outside: str) -> Image:
    """`image` [H, W, 3] with the pixels outside `mask` black (`outside="black"`) or the ground truth's ("truth")."""
    return np.where(mask[..., None], image, 0.0 if outside == "black" else truth)


def ssim(render: Image, truth: Image, mask: Mask, sigma: float = 1.5) -> tuple[float, float]:
    """SSIM over the whole image and over the liquid alone, (ssim, ssim_fg).

    Both images must be equal outside `mask` (see `outside_filled`). `ssim` is scikit-image's structural_similarity
    with gaussian_weights=True, use_sample_covariance=False, data_range=1: the mean over channels and over all pixels
    whose window lies within the image. `ssim_fg` = 1 - (1 - ssim) / f, with f the share of those pixels whose window
    touches the mask (the mask dilated by the window's 5 px): elsewhere both images agree and SSIM is exactly 1.

    Args:
        render, truth: [H, W, 3] in [0, 1].
        mask: [H, W].

    Raises ValueError for images smaller than the window.
    """
    from scipy.ndimage import maximum_filter

    radius = int(_TRUNCATE * sigma + 0.5)
    height, width = mask.shape
    if min(height, width) <= 2 * radius:
        raise ValueError(f"SSIM needs images of more than {2 * radius} px a side, not {width}x{height}")
    touched = maximum_filter(mask, size=2 * radius + 1)[radius : height - radius, radius : width - radius]
    n_touched = int(touched.sum())
    if n_touched == 0:
        return 1.0, 1.0
    # Only the windows that touch the mask can differ from 1: the sum over their box is the sum over the image.
    rows, columns = np.flatnonzero(touched.any(axis=1)), np.flatnonzero(touched.any(axis=0))
    box = np.s_[rows[0] : rows[-1] + 1 + 2 * radius, columns[0] : columns[-1] + 1 + 2 * radius]
    similarity = _ssim_map(render[box], truth[box], sigma)[radius:-radius, radius:-radius]
    loss = float(np.sum(1.0 - similarity)) / similarity.shape[-1]
    return 1.0 - loss / touched.size, 1.0 - loss / n_touched


def _ssim_map(first: Image, second: Image, sigma: float) -> Image:
    """Structural similarity per pixel and channel (Wang et al. 2004), Gaussian window, data range 1."""
    from scipy.ndimage import gaussian_filter

    def smooth(values: Image) -> Image:
        return gaussian_filter(values, sigma, truncate=_TRUNCATE, axes=(0, 1))

    mean_first, mean_second = smooth(first), smooth(second)
    variance_first = smooth(first * first) - mean_first * mean_first
    variance_second = smooth(second * second) - mean_second * mean_second
    covariance = smooth(first * second) - mean_first * mean_second
    c1, c2 = _K1**2, _K2**2
    luminance = (2 * mean_first * mean_second + c1) / (mean_first**2 + mean_second**2 + c1)
    structure = (2 * covariance + c2) / (variance_first + variance_second + c2)
    return luminance * structure

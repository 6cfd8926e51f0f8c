"""The SSIM that fits descend on, against scikit-image and finite differences."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from splashbench.gaussians.ssim import SsimTarget, _band_rows, ssim, ssim_by_torch


def images(height: int = 14, width: int = 17) -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(0)
    image = rng.random((height, width, 3)).astype(np.float32)
    return image, np.clip(image + 0.2 * rng.normal(size=image.shape), 0, 1).astype(np.float32)


def test_it_equals_scikit_image_inside_the_border():
    from skimage.metrics import structural_similarity

    a, b = images(40, 50)
    for image in (a, b):  # the borders' treatment differs; black borders make it moot
        image[:8], image[-8:], image[:, :8], image[:, -8:] = 0, 0, 0, 0
    theirs = structural_similarity(
        a, b, channel_axis=2, data_range=1.0, gaussian_weights=True, use_sample_covariance=False, full=True
    )[1].mean()
    assert float(ssim(torch.from_numpy(a), SsimTarget(b))) == pytest.approx(theirs, abs=1e-5)
    assert float(ssim(torch.from_numpy(a), SsimTarget(a))) == pytest.approx(1, abs=1e-6)


@pytest.mark.parametrize("masked", [False, True])
def test_the_gradient_is_that_of_finite_differences(masked: bool):
    image, noisy = images()
    weight = np.ones(image.shape[:2], np.float32)
    if masked:
        weight[3:6, 4:9] = 0
    target = SsimTarget(torch.from_numpy(image), weight if masked else None)
    at = torch.from_numpy(noisy).requires_grad_()
    ssim(at, target).backward()
    direction = torch.from_numpy(np.random.default_rng(1).normal(size=image.shape).astype(np.float32))
    plus, minus = (float(ssim(at.detach() + step * direction, target)) for step in (1e-2, -1e-2))
    assert float((at.grad * direction).sum()) == pytest.approx((plus - minus) / 2e-2, rel=0.02)
    assert (at.grad[weight == 0] == 0).all()


def test_pixels_without_weight_count_as_black_in_both():
    image, noisy = images()
    weight = (np.random.default_rng(2).random(image.shape[:2]) < 0.7).astype(np.float32)
    black = torch.from_numpy(noisy * weight[..., None])
    expected = float(ssim(black, SsimTarget(image * weight[..., None])))
    assert float(ssim(torch.from_numpy(noisy), SsimTarget(image, weight))) == pytest.approx(expected, abs=1e-7)


def test_images_of_different_sizes_do_not_compare():
    image, noisy = images()
    with pytest.raises(ValueError, match="another size"):
        ssim(torch.from_numpy(noisy[1:]), SsimTarget(image))


# The last band of the second has one row, that of the third two; the fourth is too low for a second band.
@pytest.mark.parametrize("size", [(640, 300), (513, 256), (130, 4000), (3, 70_000)])
def test_images_of_several_bands_of_rows_are_as_torch_has_them_whole(size: tuple[int, int]) -> None:
    assert (_band_rows(*size) < size[0]) == (size[0] > 3)
    rng = np.random.default_rng(3)
    image, noisy = (rng.random((*size, 1), dtype=np.float32) for _ in range(2))
    target = SsimTarget(image)
    banded, whole = (torch.from_numpy(noisy.copy()).requires_grad_() for _ in range(2))
    value = ssim(banded, target)
    expected = ssim_by_torch(whole, torch.from_numpy(target.image))
    value.backward()
    expected.backward()
    assert value.item() == pytest.approx(expected.item(), rel=1e-5)
    scale = float(whole.grad.abs().max())
    np.testing.assert_allclose(banded.grad.numpy(), whole.grad.numpy(), atol=1e-4 * scale)

"""The SSIM that fits descend on, against scikit-image and finite differences."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

from splashbench.gaussians import ssim as module
from splashbench.gaussians.ssim import KERNEL, SsimTarget, similarity, ssim, ssim_by_torch
from splashbench.native.threads import use_threads


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


def blurred(rows: np.ndarray) -> np.ndarray:
    """The window over `rows` [h, w], zeros beyond, each sum in the order of the taps: columns first."""
    for axis in (0, 1):
        padded = np.pad(rows, [(5, 5) if which == axis else (0, 0) for which in (0, 1)])
        sums = np.zeros_like(rows)
        for tap, weight in enumerate(module._WINDOW):
            sums += weight * np.take(padded, np.arange(tap, tap + rows.shape[axis]), axis)
        rows = sums
    return rows


def plainly(a: np.ndarray, b: np.ndarray, weight: np.ndarray) -> tuple[float, np.ndarray]:
    """`similarity` by numpy, in single precision, each operation in the kernel's order."""
    total, gradient = [], np.empty_like(a)
    one, two, c1, c2 = np.float32(1), np.float32(2), module._C1, module._C2
    for channel in range(a.shape[2]):
        x, y = a[..., channel] * weight, b[..., channel]
        mean_a, square_a, product, mean_b, square_b = (blurred(of) for of in (x, x * x, x * y, y, y * y))
        squares = mean_a * mean_a + mean_b * mean_b
        luminance, structure = two * mean_a * mean_b + c1, two * (product - mean_a * mean_b) + c2
        by_means, by_variances = one / (squares + c1), one / (square_a + square_b - squares + c2)
        value = luminance * structure * by_means * by_variances
        by_mean = two * mean_b * (structure - luminance) * by_means * by_variances
        by_mean = by_mean - two * mean_a * value * (by_means - by_variances)
        first, second, third = (
            blurred(of) for of in (by_mean, -value * by_variances, two * luminance * by_means * by_variances)
        )
        gradient[..., channel] = (first + (two * x * second + y * third)) * weight / np.float32(a.size)
        rows = np.cumsum(value.astype(np.float64), axis=1)[:, -1]
        total.append(np.cumsum(rows)[-1])
    return float(np.sum(total) / a.size), gradient


@pytest.mark.parametrize("variant", KERNEL.built_variants())
@pytest.mark.parametrize("masked", [False, True])
def test_every_kind_of_processor_gives_the_same_bits(
    variant: str, masked: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    if not KERNEL.runs(variant):
        pytest.skip(f"this processor does not run {variant}")
    monkeypatch.setattr(module, "KERNEL", replace(KERNEL))
    monkeypatch.setenv("SPLASHBENCH_SIMD", variant)
    monkeypatch.delenv("SPLASHBENCH_KERNEL", raising=False)  # which may hold one variant alone
    for size in [(1, 1, 1), (3, 70, 1), (14, 17, 3), (80, 33, 4), (200, 5, 3)]:
        rng = np.random.default_rng(4)
        image, noisy = (rng.random(size, dtype=np.float32) for _ in range(2))
        weight = (rng.random(size[:2]) < (0.7 if masked else 2)).astype(np.float32)
        target = SsimTarget(image, weight)
        value, gradient = similarity(noisy, target.image, weight if masked else None)
        expected, expected_gradient = plainly(noisy, target.image, weight)
        assert value == expected
        np.testing.assert_array_equal(gradient, expected_gradient)


# With several threads rows are worked on in pieces; the last one of the second has one row.
@pytest.mark.parametrize("size", [(640, 300), (513, 256), (3, 70_000)])
def test_the_number_of_threads_does_not_matter(size: tuple[int, int]) -> None:
    rng = np.random.default_rng(3)
    image, noisy = (rng.random((*size, 1), dtype=np.float32) for _ in range(2))
    found = []
    for threads in (1, 2, 7):
        with use_threads(threads):
            found.append(similarity(noisy, image))
    for value, gradient in found[1:]:
        assert value == found[0][0]
        np.testing.assert_array_equal(gradient, found[0][1])
    target = SsimTarget(image)
    at = torch.from_numpy(noisy.copy()).requires_grad_()
    expected = ssim_by_torch(at, target.on(at.device)[0])
    expected.backward()
    assert found[0][0] == pytest.approx(expected.item(), rel=1e-5)
    np.testing.assert_allclose(found[0][1], at.grad.numpy(), atol=1e-4 * float(at.grad.abs().max()))


def test_a_part_of_an_image_and_bytes_are_taken_as_they_lie() -> None:
    rng = np.random.default_rng(5)
    whole, truth = rng.random((40, 50, 3), dtype=np.float32), rng.integers(0, 256, (20, 30, 3)).astype(np.uint8)
    value, gradient = similarity(whole[7:27, 11:41], truth)
    floats = (torch.from_numpy(truth).to(torch.float32) / 255).numpy()
    expected, expected_gradient = similarity(whole[7:27, 11:41].copy(), floats)
    assert value == expected
    np.testing.assert_array_equal(gradient, expected_gradient)
    turned, turned_gradient = similarity(whole[7:27, 11:41].transpose(1, 0, 2), floats.transpose(1, 0, 2))
    assert turned == pytest.approx(value, rel=1e-6)
    np.testing.assert_allclose(turned_gradient, gradient.transpose(1, 0, 2), atol=1e-7)


@pytest.mark.parametrize(
    ("image", "truth", "weight", "error", "words"),
    [
        (np.zeros((4, 4, 3)), np.zeros((4, 4, 3), np.float32), None, TypeError, "float64 and float32 are not float32"),
        (np.zeros((4, 4, 3), np.float32), np.zeros((4, 4, 3), bool), None, TypeError, "float32 and bool"),
        (np.zeros((4, 4), np.float32), np.zeros((4, 4), np.float32), None, ValueError, "does not compare"),
        (*[np.zeros((4, 4, 3), np.float32)] * 2, np.zeros((3, 4), np.float32), ValueError, "a weight float32"),
        (*[np.zeros((0, 4, 3), np.float32)] * 2, None, ValueError, "no pixels"),
    ],
)
def test_what_does_not_fit_is_refused(image, truth, weight, error, words) -> None:
    with pytest.raises(error, match=words):
        similarity(image, truth, weight)

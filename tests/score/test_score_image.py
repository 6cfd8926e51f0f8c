"""PSNR, SSIM, silhouettes and jitter on images with known answers."""

import numpy as np
import pytest
from skimage.metrics import structural_similarity

from splashbench.score.image.fidelity import outside_filled, psnr, ssim
from splashbench.score.image.jitter import JitterError
from splashbench.score.image.silhouette import iou, spill, spill_rgb


@pytest.fixture
def pair() -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Two noisy images [60, 80, 3] and a mask that touches the border."""
    rng = np.random.default_rng(0)
    mask = np.zeros((60, 80), bool)
    mask[20:45, 10:50] = True
    mask[0:6, 70:80] = True
    return rng.random((60, 80, 3)), rng.random((60, 80, 3)), mask


def test_psnr_looks_at_mask_pixels_only(pair: tuple) -> None:
    truth, noise, mask = pair
    render = np.where(mask[..., None], truth + 0.1, noise)
    assert psnr(render, truth, mask) == pytest.approx(20.0, abs=1e-9)


def test_psnr_of_equal_images_is_the_cap(pair: tuple) -> None:
    truth, _, mask = pair
    assert psnr(truth, truth, mask) == 100.0
    assert psnr(truth + 1e-12, truth, mask) == 100.0


def test_ssim_equals_scikit_image(pair: tuple) -> None:
    first, second, mask = pair
    first, second = (outside_filled(image, image, mask, "black") for image in (first, second))
    expected = structural_similarity(
        first, second, data_range=1.0, channel_axis=-1, gaussian_weights=True, use_sample_covariance=False
    )
    assert ssim(first, second, mask)[0] == pytest.approx(expected, abs=1e-12)


def test_foreground_ssim_is_the_mean_over_the_dilated_mask(pair: tuple) -> None:
    first, second, mask = pair
    first, second = (outside_filled(image, image, mask, "black") for image in (first, second))
    _, full = structural_similarity(
        first, second, data_range=1.0, channel_axis=-1, gaussian_weights=True, use_sample_covariance=False, full=True
    )
    dilated = np.zeros_like(mask)
    for row, column in np.argwhere(mask):
        dilated[max(0, row - 5) : row + 6, max(0, column - 5) : column + 6] = True
    inner = np.s_[5:-5, 5:-5]
    assert ssim(first, second, mask)[1] == pytest.approx(full[inner][dilated[inner]].mean(), abs=1e-12)


def test_foreground_ssim_does_not_depend_on_how_much_lies_around_the_liquid(pair: tuple) -> None:
    first, second, mask = pair
    mask = mask.copy()
    mask[:10] = False
    first, second = (outside_filled(image, image, mask, "black") for image in (first, second))
    wide = [np.pad(image, ((40, 40), (40, 40), (0, 0))) for image in (first, second)]
    narrow_all, narrow_liquid = ssim(first, second, mask)
    wide_all, wide_liquid = ssim(wide[0], wide[1], np.pad(mask, 40))
    assert wide_liquid == pytest.approx(narrow_liquid, abs=1e-12)
    assert wide_all > narrow_all + 0.1


def test_equal_images_have_ssim_exactly_one(pair: tuple) -> None:
    truth, _, mask = pair
    assert ssim(truth, truth, mask) == (1.0, 1.0)


def test_images_smaller_than_the_window_are_refused() -> None:
    with pytest.raises(ValueError, match="more than 10 px"):
        ssim(np.zeros((10, 50, 3)), np.zeros((10, 50, 3)), np.ones((10, 50), bool))


def test_iou_of_empty_masks() -> None:
    empty, full = np.zeros((4, 5)), np.ones((4, 5))
    assert iou(empty, empty.astype(bool)) == 1.0
    assert iou(empty, full.astype(bool)) == 0.0
    assert iou(full, empty.astype(bool)) == 0.0
    assert iou(full, full.astype(bool)) == 1.0


def test_iou_counts_opacity_above_one_half() -> None:
    alpha = np.array([[0.5, 0.51, 0.9, 0.9]])
    assert iou(alpha, np.array([[True, True, True, False]])) == pytest.approx(2 / 4)


def test_spill_is_opacity_outside_in_units_of_the_mask() -> None:
    mask = np.zeros((4, 5), bool)
    mask[0, :4] = True
    alpha = np.where(mask, 1.0, 0.25)
    assert spill(alpha, mask) == pytest.approx(16 * 0.25 / 4)
    nothing = np.full((4, 5, 3), 0.5)
    render = nothing + np.where(mask, 0.4, 0.1)[..., None]
    assert spill_rgb(render, nothing, mask) == pytest.approx(16 * 0.1 / 4)


def _jitter(render: np.ndarray, truth: np.ndarray, masks: np.ndarray) -> float | None:
    error = JitterError()
    for frame in zip(render, truth, masks):
        error.add(*frame)
    return error.value()


def test_jitter_error_against_a_direct_computation() -> None:
    rng = np.random.default_rng(1)
    truth, render = rng.random((4, 6, 7, 3)), rng.random((4, 6, 7, 3)) * 0.5
    masks = rng.random((4, 6, 7)) > 0.6
    union = masks[1:] | masks[:-1]
    luma = [images @ [0.299, 0.587, 0.114] for images in (render, truth)]
    deviations = [np.diff(values, axis=0)[union].std() for values in luma]
    assert _jitter(render, truth, masks) == pytest.approx(abs(deviations[0] - deviations[1]), abs=1e-12)


def test_a_frozen_picture_is_charged_the_full_jitter_of_the_footage() -> None:
    rng = np.random.default_rng(2)
    truth = rng.random((5, 6, 7, 3))
    masks = np.ones((5, 6, 7), bool)
    frozen = np.repeat(truth[:1], 5, axis=0)
    assert _jitter(truth, truth, masks) == 0.0
    assert _jitter(frozen, truth, masks) == pytest.approx(np.diff(truth @ [0.299, 0.587, 0.114], axis=0).std())


def test_jitter_without_liquid_is_unknown() -> None:
    images = np.zeros((3, 6, 7, 3))
    assert _jitter(images, images, np.zeros((3, 6, 7), bool)) is None

"""The compiled losses of a window against SplashSplat's own, in plain torch and float64."""

from __future__ import annotations

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from splashbench.gaussians.ssim import ssim_by_torch
from splashbench.native.threads import use_threads
from splashbench_methods.splashsplat.appearance import losses
from splashbench_methods.splashsplat.kernel.window_loss import WindowPhotograph, window_losses

Case = tuple[torch.Tensor, torch.Tensor, WindowPhotograph]


def case(rows: int, columns: int, around: tuple[int, int, int, int] = (0, 0, 0, 0), seed: int = 0) -> Case:
    """Image, opacity, and a photograph with `around` pixels above, right of, below and left of it; some pixels are
    black in both."""
    torch.manual_seed(seed)
    top, right, bottom, left = around
    truth = torch.randint(0, 256, (rows, columns, 3), dtype=torch.uint8)
    black = torch.rand(rows, columns) < 0.2
    truth[black] = 0
    photograph = WindowPhotograph(truth, torch.rand(rows, columns) < 0.4, top, left)
    height, width = top + rows + bottom, left + columns + right
    image = torch.rand(height, width, 3)
    image[photograph.box][black] = 0
    return image, torch.rand(height, width), photograph


def outcome(sample: Case, kernel: bool) -> list[torch.Tensor]:
    """The four losses, and the gradients of their sum with weights."""
    image, alpha, photograph = sample
    kind = torch.float32 if kernel else torch.float64
    image, alpha = (value.to(kind, copy=True).requires_grad_() for value in (image, alpha))
    if kernel:
        terms = window_losses(image, alpha, photograph, with_ssim=True)
    else:
        truth = photograph.image.double() / 255
        mask = torch.zeros_like(alpha)
        mask[photograph.box] = photograph.mask.double()
        near = photograph.box
        terms = (
            losses.foreground_loss(image[near], truth, mask[near]),
            losses.gradient_loss(image[near], truth, mask[near]),
            losses.silhouette_loss(alpha, mask, 1.0),
            ssim_by_torch(image[near].float(), truth.permute(2, 0, 1).float()).to(kind),
        )
    total = 0.5 * terms[0] + 0.3 * terms[1] + 0.7 * terms[2] - 0.2 * terms[3]
    gradients = torch.autograd.grad(total, [image, alpha])
    return [term.detach() for term in terms] + list(gradients)


@settings(max_examples=30, deadline=None, derandomize=True)
@given(
    rows=st.sampled_from([1, 2, 15, 16, 17, 40]),
    columns=st.integers(1, 40),
    around=st.tuples(*[st.sampled_from([0, 1, 7])] * 4),
    seed=st.integers(0, 1000),
)
def test_losses_and_gradients_are_those_of_the_definition(rows, columns, around, seed):
    sample = case(rows, columns, around, seed)
    for got, expected in zip(outcome(sample, True), outcome(sample, False)):
        assert got.shape == expected.shape
        torch.testing.assert_close(got.double(), expected, rtol=1e-5, atol=1e-8)


def test_the_number_of_threads_does_not_matter():
    results = []
    for threads in (1, 2, 5):
        with use_threads(threads):
            results.append(outcome(case(100, 90, (3, 4, 5, 6)), True))
    for other in results[1:]:
        assert all(torch.equal(one, two) for one, two in zip(results[0], other))


def test_an_empty_mask_leaves_the_silhouette_alone():
    image, alpha, photograph = case(20, 20)
    photograph.mask.fill_(False)
    foreground, gradient, silhouette, ssim = window_losses(image, alpha, photograph)
    assert ssim is None
    assert float(foreground) == float(gradient) == 0
    assert float(silhouette) == pytest.approx(float(alpha.sum()), rel=1e-5)


def test_what_does_not_fit_is_refused():
    image, alpha, photograph = case(8, 9)
    with pytest.raises(ValueError, match="a box of 9x8 px at 1, 0 leaves 9x8 px"):
        window_losses(image, alpha, WindowPhotograph(photograph.image, photograph.mask, 0, 1))
    with pytest.raises(ValueError, match=r"an image \[8, 9, 3\] does not go with alpha \[7, 9\]"):
        window_losses(image, alpha[:7], photograph)
    with pytest.raises(TypeError, match="not float32"):
        window_losses(image.double(), alpha, photograph)
    with pytest.raises(TypeError, match="not contiguous uint8 and bool"):
        window_losses(image, alpha, WindowPhotograph(photograph.image.float(), photograph.mask, 0, 0))

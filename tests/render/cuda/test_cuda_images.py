"""The CUDA backend draws what the CPU draws: images, gradients, modes, compact tiles, frozen Gaussians."""

from __future__ import annotations

import gc
from typing import Any

import numpy as np
import pytest
import torch
from cuda_comparison import (
    SIDE,
    SMALL,
    VIEW,
    ComparedBackend,
    assert_same,
    assert_same_gradients,
    assert_same_image,
    gradients_of,
    random_gaussians,
    render,
)

from splashbench.render import COLOR, OPACITY, SKIP, cuda, freeze, rasterize, tile_grid, to_tiles


@pytest.mark.parametrize("seed", [0, 1, 2])
@pytest.mark.parametrize("depth", [False, True])
@pytest.mark.parametrize("background", [None, "flat", "image"])
def test_images_and_gradients_are_those_of_the_cpu(
    backend: ComparedBackend, seed: int, depth: bool, background: str | None
) -> None:
    gaussians = random_gaussians(seed, 60)
    shape = {None: None, "flat": (3,), "image": (VIEW.height, VIEW.width, 3)}[background]
    behind = None if shape is None else torch.rand(shape, generator=torch.Generator().manual_seed(seed))
    assert_same(backend, gaussians, VIEW, backend.smooth(gaussians, VIEW), depth=depth, background=behind)


def test_a_crowded_scene(backend: ComparedBackend) -> None:
    """Opaque pixels, where compositing stops early."""
    gaussians = random_gaussians(20, 600)
    gaussians[2] = gaussians[2].clamp(min=0.8)
    smooth = backend.smooth(gaussians, VIEW)
    _, opacity, _ = render(gaussians, VIEW, "cpu")
    assert (opacity[smooth] > 0.999).sum() > 100
    assert_same(backend, gaussians, VIEW, smooth, depth=True, background=torch.tensor([0.2, 0.4, 0.6]))


@pytest.mark.parametrize("channels", [1, 6, 32])
def test_depth_follows_any_number_of_channels(backend: ComparedBackend, channels: int) -> None:
    gaussians = random_gaussians(3, 40, channels)
    assert_same(backend, gaussians, VIEW, backend.smooth(gaussians, VIEW), depth=True, background=torch.ones(channels))


@pytest.mark.parametrize("depth", [False, True])
def test_opacity_alone(backend: ComparedBackend, depth: bool) -> None:
    gaussians = random_gaussians(4, 40)
    assert_same(backend, [*gaussians[:3], None], VIEW, backend.smooth(gaussians, VIEW), depth=depth)


def _modes() -> np.ndarray:
    return np.array([[COLOR, OPACITY, SKIP], [SKIP, COLOR, OPACITY], [OPACITY, SKIP, COLOR]], np.uint8)


@pytest.mark.parametrize("background", [None, "flat", "image"])
@pytest.mark.parametrize("compact", [False, True])
def test_tile_modes(backend: ComparedBackend, background: str | None, compact: bool) -> None:
    gaussians = random_gaussians(5, 60)
    shape = {None: None, "flat": (3,), "image": (VIEW.height, VIEW.width, 3)}[background]
    behind = None if shape is None else torch.rand(shape, generator=torch.Generator().manual_seed(5))
    smooth = backend.smooth(gaussians, VIEW)
    if compact:
        smooth = torch.from_numpy(to_tiles(smooth.numpy(), _modes()))
    assert_same(backend, gaussians, VIEW, smooth, modes=_modes(), compact=compact, depth=True, background=behind)


def test_tiles_without_color_cost_no_color_and_give_it_no_gradient(stand_in: ComparedBackend) -> None:
    gaussians = random_gaussians(5, 60)
    modes = np.full(tile_grid(VIEW.width, VIEW.height), OPACITY, np.uint8)
    behind = torch.tensor([0.2, 0.4, 0.6])
    color, opacity, leaves = render(gaussians, VIEW, "cuda", modes=modes, background=behind)
    _, expected, _ = render(gaussians, VIEW, "cpu")
    assert torch.equal(color, behind.expand(VIEW.height, VIEW.width, 3))
    assert_same_image(opacity, expected, stand_in.smooth(gaussians, VIEW), stand_in.image_tolerance)
    assert stand_in.calls[0]["colors"].shape == (60, 1)
    *others, of_colors = gradients_of(opacity.sum(), leaves)
    assert all(gradient.abs().max() > 0 for gradient in others)
    assert torch.equal(of_colors, torch.zeros_like(of_colors))


def test_compact_output_of_all_tiles(backend: ComparedBackend) -> None:
    gaussians = random_gaussians(6, 60)
    everywhere = np.full(tile_grid(VIEW.width, VIEW.height), COLOR, np.uint8)
    smooth = torch.from_numpy(to_tiles(backend.smooth(gaussians, VIEW).numpy(), everywhere))
    assert_same(backend, gaussians, VIEW, smooth, compact=True, background=torch.tensor([0.2, 0.4, 0.6]))


@pytest.mark.parametrize("colored", [False, True])
def test_frozen_gaussians_are_rendered_and_get_no_gradients(backend: ComparedBackend, colored: bool) -> None:
    foreground, behind = random_gaussians(7, 40), random_gaussians(8, 40)
    behind[0][4], behind[2][4] = foreground[0][1], 0.9  # at the place of an opaque one, which comes first
    union = [torch.cat(pair) for pair in zip(foreground, behind)]
    smooth = backend.smooth(union, VIEW)
    if not colored:
        foreground, behind = [*foreground[:3], None], [*behind[:3], None]  # type: ignore[list-item]
    frozen = freeze(*behind, VIEW, depth=True)  # type: ignore[arg-type]
    assert_same(backend, foreground, VIEW, smooth, frozen=frozen, depth=True)
    if backend.device == "cuda":
        joint, _ = rasterize(*(None if t is None else t.cuda() for t in [*union[:3], union[3] if colored else None]),
                             VIEW, depth=True, backend="cuda")  # fmt: skip
        alone, _ = rasterize(*(None if t is None else t.cuda() for t in foreground),
                             VIEW, frozen=frozen, depth=True, backend="cuda")  # fmt: skip
        assert torch.equal(joint, alone)


def test_frozen_gaussians_alone(backend: ComparedBackend) -> None:
    behind = random_gaussians(8, 40)
    nothing = [tensor[:0] for tensor in behind]
    color, opacity, leaves = render(nothing, VIEW, "cuda", backend.device, frozen=freeze(*behind, VIEW))
    expected, _, _ = render(behind, VIEW, "cpu")
    assert_same_image(color, expected, backend.smooth(behind, VIEW), backend.image_tolerance)
    assert [g.shape for g in gradients_of(color.sum() + opacity.sum(), leaves)] == [t.shape for t in nothing]


def test_frozen_gaussians_move_to_the_device_once_and_leave_it_with_their_owner(stand_in: ComparedBackend) -> None:
    foreground = random_gaussians(7, 10)
    frozen = freeze(*random_gaussians(8, 10), VIEW)
    for _ in range(2):
        rasterize(*foreground, VIEW, frozen=frozen, backend="cuda")
    assert len(cuda._frozen_on_device) == 1
    del frozen
    gc.collect()
    assert not cuda._frozen_on_device


def test_several_cameras(backend: ComparedBackend) -> None:
    """One call of gsplat per size; images in the order of the cameras, each with its own colors and options."""
    gaussians = random_gaussians(9, 40)
    cameras = [VIEW, SMALL, SIDE]
    colors = torch.rand((3, 40, 3), generator=torch.Generator().manual_seed(9))
    backgrounds = [torch.tensor([0.9, 0.5, 0.1]), None, torch.rand((90, 140, 3))]
    modes = [_modes(), None, None]
    inputs = [*gaussians[:3], colors]
    ours = render(inputs, cameras, "cuda", backend.device, background=backgrounds, modes=modes, depth=True)
    theirs = render(inputs, cameras, "cpu", background=backgrounds, modes=modes, depth=True)
    assert [call["viewmats"].shape for call in backend.calls] in ([], [(2, 4, 4), (1, 4, 4)])
    losses = []
    for color, opacity, leaves in (ours, theirs):
        total = torch.zeros(())
        for camera, image, alpha in zip(cameras, color, opacity):
            smooth = backend.smooth(gaussians, camera)
            weights = torch.randn(image.shape, generator=torch.Generator().manual_seed(1))
            total = total + (image * weights * smooth[..., None]).sum() + (alpha * smooth).sum()
        losses.append(gradients_of(total, leaves))
    for mine, expected, camera in zip(ours[0], theirs[0], cameras):
        assert mine.shape == expected.shape
        smooth = backend.smooth(gaussians, camera)
        assert_same_image(mine, expected, smooth, backend.image_tolerance)
    assert_same_gradients(*losses, backend.gradient_tolerance)


def test_frozen_gaussians_of_several_cameras(backend: ComparedBackend) -> None:
    foreground, behind = random_gaussians(14, 30), random_gaussians(15, 30)
    union = [torch.cat(pair) for pair in zip(foreground, behind)]
    frozen = [freeze(*behind, VIEW), None]
    colors, _, _ = render(foreground, [VIEW, SIDE], "cuda", backend.device, frozen=frozen)
    for color, camera, all_of_them in zip(colors, (VIEW, SIDE), (union, foreground)):
        expected, _, _ = render(all_of_them, camera, "cpu")
        assert_same_image(color, expected, backend.smooth(all_of_them, camera), backend.image_tolerance)


def test_no_cameras(stand_in: ComparedBackend) -> None:
    with pytest.raises(ValueError, match="cameras is empty"):
        rasterize(*random_gaussians(0, 4), [], backend="cuda")


@pytest.mark.parametrize("compact", [False, True])
def test_nothing_to_draw(backend: ComparedBackend, compact: bool) -> None:
    """No Gaussians, or every tile skipped: the background, and gradients of 0."""
    gaussians = random_gaussians(0, 10)
    behind = torch.tensor([0.2, 0.4, 0.6])
    skipped = np.full(tile_grid(VIEW.width, VIEW.height), SKIP, np.uint8)
    for inputs, modes in (([t[:0] for t in gaussians], None), (gaussians, skipped)):
        options: dict[str, Any] = {"background": behind, "modes": modes, "depth": True, "compact": compact}
        color, opacity, leaves = render(inputs, VIEW, "cuda", backend.device, **options)
        expected_color, expected_opacity, _ = render(inputs, VIEW, "cpu", **options)
        assert torch.equal(color, expected_color)
        assert torch.equal(opacity, expected_opacity)
        for gradient, tensor in zip(gradients_of(color.sum() + opacity.sum(), leaves), inputs):
            assert torch.equal(gradient, torch.zeros_like(tensor))
    assert backend.calls == []


def test_gaussians_that_nobody_sees(backend: ComparedBackend) -> None:
    gaussians = random_gaussians(0, 10)
    gaussians[0] = gaussians[0] + torch.tensor([0.0, 0.0, -10.0])
    color, opacity, leaves = render(gaussians, VIEW, "cuda", backend.device, background=torch.ones(3))
    assert torch.equal(color, torch.ones_like(color))
    assert torch.equal(opacity, torch.zeros_like(opacity))
    assert all(gradient.abs().max() == 0 for gradient in gradients_of(color.sum() + opacity.sum(), leaves))


def test_other_dtypes_and_layouts_are_converted(backend: ComparedBackend) -> None:
    plain = random_gaussians(12, 30)
    expected, _, _ = render(plain, VIEW, "cuda", backend.device)
    for convert in (
        lambda t: t.double(),
        lambda t: torch.stack([t, t], -1)[..., 0],
    ):
        color, opacity, leaves = render([convert(t) for t in plain], VIEW, "cuda", backend.device)
        assert torch.equal(color, expected)
        assert (color.dtype, opacity.dtype) == (torch.float32, torch.float32)
        assert [g.dtype for g in gradients_of(color.sum(), leaves)] == [leaf.dtype for leaf in leaves]

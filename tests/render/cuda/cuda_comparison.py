"""Renders the same random Gaussians with the CUDA backend and on the CPU, and holds images and gradients together."""

from __future__ import annotations

from dataclasses import dataclass, field
from types import ModuleType
from typing import Any

import numpy as np
import torch

from splashbench.render import rasterize
from splashbench.scene.camera import Camera


@dataclass
class ComparedBackend:
    """What the tests render with, and how near it comes to the CPU's images and gradients."""

    reference: ModuleType
    device: str
    image_tolerance: float  # largest difference
    gradient_tolerance: float  # relative L2
    calls: list[dict[str, Any]] = field(default_factory=list)

    def smooth(self, gaussians: list[torch.Tensor], camera: Camera) -> torch.Tensor:
        """bool [H, W], where rounding decides nothing; most of the image."""
        smooth = ~self.reference.threshold_pixels(*gaussians[:3], camera)
        assert smooth.float().mean() > 0.9
        return smooth


def camera_at(name: str, width: int, height: int, turn: float = 0.0) -> Camera:
    """A camera 3 units before the origin, turned about the vertical axis; the principal point is off the center."""
    c, s = np.cos(turn), np.sin(turn)
    w2c = np.eye(4)
    w2c[:3, :3] = [[c, 0, s], [0, 1, 0], [-s, 0, c]]
    w2c[2, 3] = 3.0
    focal = 1.1 * width
    K = np.array([[focal, 0, width / 2 + 3.3], [0, 1.05 * focal, height / 2 - 2.1], [0, 0, 1.0]])
    return Camera(name, width, height, K, w2c)


VIEW = camera_at("a", 140, 90)  # 3 x 3 tiles, those at the right and the bottom cut off by the image's edge
SIDE = camera_at("b", 140, 90, turn=0.4)
SMALL = camera_at("c", 70, 33, turn=-0.3)


def random_gaussians(seed: int, count: int, channels: int = 3) -> list[torch.Tensor]:
    """Means, factors, opacities and colors: balls, discs and needles, some behind the camera or beyond the edges."""
    rng = np.random.default_rng(seed)
    means = rng.uniform([-1.6, -1.1, -1.0], [1.6, 1.1, 1.0], (count, 3))
    means[::9, 2] -= 3.5
    rotations = np.linalg.qr(rng.normal(size=(count, 3, 3)))[0]
    factors = rotations * np.exp(rng.uniform(np.log(0.01), np.log(0.3), (count, 1, 3)))
    opacities = rng.uniform(0.05, 1.0, count)
    opacities[:3] = 0.0, 1.0, 0.002
    arrays = means, factors, opacities, rng.uniform(size=(count, channels))
    return [torch.tensor(array, dtype=torch.float32) for array in arrays]


def render(
    gaussians: list[torch.Tensor | None], cameras: Any, backend: str, device: str = "cpu", **options: Any
) -> tuple[Any, Any, list[torch.Tensor]]:
    """Color and opacity, on the CPU, and the leaves whose gradients to look at."""
    leaves = [None if t is None else t.clone().to(device).requires_grad_() for t in gaussians]
    color, opacity = rasterize(*leaves, cameras, backend=backend, **options)  # type: ignore[arg-type]
    if isinstance(cameras, Camera):
        color, opacity = color.cpu(), opacity.cpu()
    else:
        color, opacity = [image.cpu() for image in color], [image.cpu() for image in opacity]
    return color, opacity, [leaf for leaf in leaves if leaf is not None]


def gradients_of(loss: torch.Tensor, leaves: list[torch.Tensor]) -> list[torch.Tensor]:
    loss.backward()
    gradients = []
    for leaf in leaves:
        assert leaf.grad is not None
        gradients.append(leaf.grad.cpu())
    return gradients


def assert_same_image(ours: torch.Tensor, expected: torch.Tensor, smooth: torch.Tensor, tolerance: float) -> None:
    """Colors [H, W, C] or opacity [H, W] agree at smooth pixels; a channel beyond 1 (depth) relatively to its range."""
    assert (ours.shape, ours.dtype) == (expected.shape, expected.dtype)
    if ours.ndim == 3:
        ours, expected, smooth = ours.flatten(0, 1), expected.flatten(0, 1), smooth.reshape(-1, 1)
        tolerance = tolerance * expected.detach().abs().amax(0).clamp(min=1)
    assert (((ours - expected) * smooth).abs() <= tolerance).all()


def assert_same_gradients(ours: list[torch.Tensor], expected: list[torch.Tensor], tolerance: float) -> None:
    for mine, theirs in zip(ours, expected, strict=True):
        assert theirs.norm() > 0
        assert (mine - theirs).norm() <= tolerance * theirs.norm()


def assert_same(
    backend: ComparedBackend, gaussians: list[torch.Tensor | None], camera: Camera, smooth: torch.Tensor, **options: Any
) -> None:
    """Both backends give the same color, opacity and gradients at smooth pixels (in the layout of the output)."""
    color, opacity, leaves = render(gaussians, camera, "cuda", backend.device, **options)
    expected_color, expected_opacity, expected_leaves = render(gaussians, camera, "cpu", **options)
    over_channels = smooth[..., None]
    if options.get("compact"):
        assert color.shape == (len(smooth), color.shape[1], *smooth.shape[1:])
        over_channels = smooth[:, None]
        for ours, theirs, tile in zip(color, expected_color, smooth, strict=True):
            planes = ours.permute(1, 2, 0), theirs.permute(1, 2, 0)
            assert_same_image(*planes, tile, backend.image_tolerance)
        for ours, theirs, tile in zip(opacity, expected_opacity, smooth, strict=True):
            assert_same_image(ours, theirs, tile, backend.image_tolerance)
    else:
        assert_same_image(color, expected_color, smooth, backend.image_tolerance)
        assert_same_image(opacity, expected_opacity, smooth, backend.image_tolerance)
    generator = torch.Generator().manual_seed(1)
    weights = torch.randn(color.shape, generator=generator) * over_channels
    opacity_weights = torch.randn(opacity.shape, generator=generator) * smooth
    ours = gradients_of((color * weights).sum() + (opacity * opacity_weights).sum(), leaves)
    theirs = gradients_of(
        (expected_color * weights).sum() + (expected_opacity * opacity_weights).sum(), expected_leaves
    )
    assert_same_gradients(ours, theirs, backend.gradient_tolerance)

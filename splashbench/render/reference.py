"""The renderer's definition, written for the reader: torch, any dtype, every Gaussian at every pixel, no tiles.

Slow, memory-hungry and differentiable by autograd throughout; the tests hold the fast kernels against it.
"""

from __future__ import annotations

import torch

from splashbench.render.constants import (
    BLUR_VARIANCE,
    JACOBIAN_MARGIN,
    MAX_ALPHA,
    MIN_ALPHA,
    MIN_TRANSMITTANCE,
    NEAR_PLANE,
)
from splashbench.scene.camera import Camera


def project(
    means: torch.Tensor, covariances: torch.Tensor, camera: Camera
) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    """Pixels [N, 2], image covariances [N, 2, 2] (px^2, blurred) and depths [N] of Gaussians in front of the camera."""
    w2c, K = (torch.as_tensor(matrix, dtype=means.dtype) for matrix in (camera.w2c.copy(), camera.K.copy()))
    rotation = w2c[:3, :3]
    x, y, z = (means @ rotation.T + w2c[:3, 3]).unbind(-1)
    fx, fy, cx, cy = K[0, 0], K[1, 1], K[0, 2], K[1, 2]
    margin_x, margin_y = JACOBIAN_MARGIN * camera.width / fx, JACOBIAN_MARGIN * camera.height / fy
    tx = torch.clamp(x / z, -cx / fx - margin_x, (camera.width - cx) / fx + margin_x)
    ty = torch.clamp(y / z, -cy / fy - margin_y, (camera.height - cy) / fy + margin_y)
    zero = torch.zeros_like(z)
    jacobian = torch.stack([fx / z, zero, -fx * tx / z, zero, fy / z, -fy * ty / z], -1).reshape(-1, 2, 3)
    linear = jacobian @ rotation
    blur = BLUR_VARIANCE * torch.eye(2, dtype=means.dtype)
    image_covariances = linear @ covariances @ linear.transpose(1, 2) + blur
    return torch.stack([fx * x / z + cx, fy * y / z + cy], -1), image_covariances, z


def rasterize(
    means: torch.Tensor,
    covariances: torch.Tensor,
    opacities: torch.Tensor,
    colors: torch.Tensor,
    camera: Camera,
    background: torch.Tensor | None = None,
) -> tuple[torch.Tensor, torch.Tensor]:
    """(rgb [H, W, 3], alpha [H, W]) in the dtype of `means`; arguments as `splashbench.render.rasterize`."""
    world = torch.as_tensor(camera.w2c.copy(), dtype=means.dtype)
    depths = (means @ world[:3, :3].T + world[:3, 3])[:, 2]
    front = torch.nonzero((depths >= NEAR_PLANE) & (opacities >= MIN_ALPHA))[:, 0]
    order = front[torch.argsort(depths[front], stable=True)]
    pixels, image_covariances, _ = project(means[order], covariances[order], camera)
    conics = torch.linalg.inv(image_covariances)
    rows, columns = torch.meshgrid(
        torch.arange(camera.height, dtype=means.dtype) + 0.5,
        torch.arange(camera.width, dtype=means.dtype) + 0.5,
        indexing="ij",
    )
    centers = torch.stack([columns, rows], -1)
    rgb = torch.zeros((camera.height, camera.width, 3), dtype=means.dtype)
    transmittance = torch.ones((camera.height, camera.width), dtype=means.dtype)
    running = torch.ones_like(transmittance, dtype=torch.bool)
    for k, i in enumerate(order.tolist()):
        offset = centers - pixels[k]
        distance = torch.einsum("hwi,ij,hwj->hw", offset, conics[k], offset)
        alpha = torch.clamp(opacities[i] * torch.exp(-distance / 2), max=MAX_ALPHA)
        after = transmittance * (1 - alpha)
        visible = running & (alpha >= MIN_ALPHA)
        running = running & ~(visible & (after <= MIN_TRANSMITTANCE))
        drawn = visible & running
        weight = torch.where(drawn, alpha * transmittance, torch.zeros_like(alpha))
        rgb = rgb + weight[..., None] * colors[i]
        transmittance = torch.where(drawn, after, transmittance)
    if background is not None:
        rgb = rgb + transmittance[..., None] * background
    return rgb, 1 - transmittance

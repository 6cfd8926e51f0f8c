"""How hard a loss pulls at Gaussians within the image, which tells where more of them are needed.

The renderer gives the gradient g by the mean in space. With h = R g, R the camera's rotation, and a mean at depth z,
the gradient by its projection (u, v) is

    dL/du = h_x z / fx,    dL/dv = h_y z / fy:

moving the mean parallel to the image moves its projection by f / z and leaves its footprint alone, but for small terms
off the optical axis. So these two components hold dL/d(u, v) without the footprint's share, which lies in h_z. (The
projection's pseudo-inverse would mix h_z in.) Gradients are taken in normalised device coordinates, W/2 and H/2
pixels a unit, in which the published thresholds are given.
"""

from __future__ import annotations

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from splashbench.scene import Camera


def screen_gradients(camera: Camera, means: NDArray, gradients: NDArray) -> NDArray[np.float32]:
    """Norms [N] of the gradients by the projected means, in normalised device coordinates.

    means, gradients: [N, 3], of a loss by them. Gaussians that were not drawn have none; neither do they get one here.
    """
    local = gradients @ camera.w2c[:3, :3].T.astype(np.float32)
    depth = means @ camera.w2c[2, :3].astype(np.float32) + np.float32(camera.w2c[2, 3])
    half = np.array([camera.width / 2 / camera.K[0, 0], camera.height / 2 / camera.K[1, 1]], np.float32)
    return np.asarray(np.linalg.norm(local[:, :2] * half, axis=1) * np.abs(depth), dtype=np.float32)


def screen_gradients_of(camera: Camera, means: Tensor, gradients: Tensor) -> Tensor:
    """`screen_gradients` of tensors [N, 3] without gradients of their own, on the device where they lie."""
    if means.device.type == "cpu":
        return torch.from_numpy(screen_gradients(camera, means.numpy(), gradients.numpy()))
    return _screen_gradients_by_torch(camera, means, gradients)


def _screen_gradients_by_torch(camera: Camera, means: Tensor, gradients: Tensor) -> Tensor:
    w2c = torch.tensor(camera.w2c, dtype=torch.float32, device=means.device)
    # Sums of three products, not matrix products: a caller may have allowed TF32 for those.
    across = (gradients[:, None] * w2c[:2, :3]).sum(dim=2)
    depth = (means * w2c[2, :3]).sum(dim=1) + w2c[2, 3]
    u, v = camera.width / 2 / camera.K[0, 0], camera.height / 2 / camera.K[1, 1]
    return torch.hypot(across[:, 0] * float(u), across[:, 1] * float(v)) * depth.abs()

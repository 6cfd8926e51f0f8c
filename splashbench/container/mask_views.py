"""Masks at a working resolution, each with its outline and the camera of its window."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from splashbench.arrays import Floats
from splashbench.container.contours import Contour, find_contour
from splashbench.container.stance import Stance, camera_of_mesh
from splashbench.observe import mesh_kernels
from splashbench.observe.container import depth_image
from splashbench.scene.camera import Camera
from splashbench.scene.container import ContainerMesh


@dataclass(frozen=True, eq=False)
class MaskView:
    """A camera of a window of the image, at the working resolution, and the mask there (shares from 0 to 1)."""

    camera: Camera
    mask: NDArray[np.float32]
    contour: Contour
    factor: float  # working pixels per pixel of the image

    def depth(self, mesh: ContainerMesh, stance: Stance) -> NDArray[np.float32]:
        """Depth [H, W] of the mesh in scene units; inf where it is not seen."""
        return _mesh_depth(mesh, camera_of_mesh(self.camera, stance)) * np.float32(stance.scale)


def _mesh_depth(mesh: ContainerMesh, camera: Camera) -> NDArray[np.float32]:
    """`depth_image`, faster for a mesh that lies wholly before the camera: each vertex is projected once."""
    local = mesh.vertices @ camera.w2c[:3, :3].T + camera.w2c[:3, 3]
    z = local[:, 2:]
    if z.min() <= 1e-3 * z.max():
        return depth_image(mesh, camera)
    pixels = (local @ camera.K.T)[:, :2] / z
    return mesh_kernels.raster(np.concatenate([pixels, 1 / z], axis=1)[mesh.faces], camera.height, camera.width)


def make_view(camera: Camera, mask: NDArray[np.bool_], extent: float, margin: float) -> MaskView:
    """The view of `mask` [H, W], reduced until its longer side is at most `extent` pixels, and cut out.

    margin: share of the mask's longer side that stays around it.
    """
    import cv2

    rows, columns = np.flatnonzero(mask.any(axis=1)), np.flatnonzero(mask.any(axis=0))
    longer = max(rows[-1] - rows[0], columns[-1] - columns[0]) + 1
    scaled = camera.scaled(min(1.0, extent / longer))
    ratio = np.array([scaled.width / camera.width, scaled.height / camera.height])
    room = max(margin * longer * ratio.max(), 8.0)
    x0, y0 = (max(0, int(low * r - room)) for low, r in zip((columns[0], rows[0]), ratio))
    x1 = min(scaled.width, int(np.ceil((columns[-1] + 1) * ratio[0] + room)))
    y1 = min(scaled.height, int(np.ceil((rows[-1] + 1) * ratio[1] + room)))
    small = cv2.resize(mask.astype(np.float32), (scaled.width, scaled.height), interpolation=cv2.INTER_AREA)
    window = np.ascontiguousarray(small[y0:y1, x0:x1])
    return MaskView(scaled.cropped(x0, y0, x1 - x0, y1 - y0), window, find_contour(window), float(ratio.max()))


def centre_of(mask: NDArray) -> Floats:
    """Centre (u, v) of a silhouette [H, W] in pixels."""
    total = float(mask.sum())
    columns, rows = mask.sum(axis=0, dtype=np.float64), mask.sum(axis=1, dtype=np.float64)
    return np.array([columns @ (np.arange(mask.shape[1]) + 0.5), rows @ (np.arange(mask.shape[0]) + 0.5)]) / total

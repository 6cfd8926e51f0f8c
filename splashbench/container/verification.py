"""Verifying a placed container by projecting it into the calibrated images, as the paper does (Sec. S1.3)."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from splashbench.container.contours import find_contour, intersection_over_union
from splashbench.container.stance import Stance, camera_of_mesh
from splashbench.observe.container import depth_image
from splashbench.scene.camera import Camera
from splashbench.scene.container import ContainerMesh

_MASK_COLOUR = (255, 176, 0)
_PROJECTED_COLOUR = (0, 190, 255)


@dataclass(frozen=True)
class Projection:
    """How a projected mesh and a mask agree in one camera.

    Attributes:
        iou: intersection over union of the silhouettes.
        contour_rms_px, contour_median_px: distance between the outlines, from the points of each to the other, in
            pixels of the image; None where one has no outline inside the image.
    """

    iou: float
    contour_rms_px: float | None
    contour_median_px: float | None


def silhouette(mesh: ContainerMesh, pose: ArrayLike, camera: Camera) -> NDArray[np.bool_]:
    """Where `camera` sees the mesh under `pose` [4, 4] (a rotation, a scale and a translation): bool [H, W]."""
    matrix = np.asarray(pose, dtype=np.float64)
    scale = float(np.cbrt(np.linalg.det(matrix[:3, :3])))
    stance = Stance(scale, matrix[:3, :3] / scale, matrix[:3, 3])
    return np.isfinite(depth_image(mesh, camera_of_mesh(camera, stance)))


def project(mesh: ContainerMesh, pose: ArrayLike, camera: Camera, mask: NDArray[np.bool_]) -> Projection:
    """Compare the mesh under `pose` with `mask` [H, W]."""
    shown = silhouette(mesh, pose, camera)
    iou = intersection_over_union(shown, mask)
    projected, drawn = find_contour(shown), find_contour(mask)
    if not len(projected.points) or not len(drawn.points):
        return Projection(iou, None, None)
    distances = np.concatenate([projected.distances_to(drawn), drawn.distances_to(projected)])
    return Projection(iou, float(np.sqrt(np.mean(distances**2))), float(np.median(distances)))


def verify(
    mesh: ContainerMesh, pose: ArrayLike, cameras: Sequence[Camera], masks: Mapping[str, NDArray[np.bool_]]
) -> dict[str, Projection]:
    """`project` for every camera with a mask, those that decided the placement and those held out."""
    return {camera.name: project(mesh, pose, camera, masks[camera.name]) for camera in cameras if camera.name in masks}


def overlay(
    mesh: ContainerMesh,
    pose: ArrayLike,
    camera: Camera,
    mask: NDArray[np.bool_] | None = None,
    image: NDArray[np.uint8] | None = None,
    width: int | None = None,
) -> NDArray[np.uint8]:
    """A picture to judge by eye: RGB uint8 [H, W, 3], the projected outline in thin blue on the mask's in broad amber.

    image: RGB of the camera's size, shown darker; black where None. width: of the picture in pixels, the image's
    where None; lines keep their thickness.
    """
    import cv2

    factor = 1.0 if width is None else width / camera.width
    small = camera.scaled(factor)
    size = (small.width, small.height)
    picture = np.zeros((small.height, small.width, 3), np.uint8)
    if image is not None:
        picture = cv2.resize(image, size, interpolation=cv2.INTER_AREA)
        picture = np.array(picture * 0.6, dtype=np.uint8)
    thickness = 1 if max(size) < 800 else 2
    outlines = [(silhouette(mesh, pose, small), _PROJECTED_COLOUR, thickness)]
    if mask is not None:
        resized = cv2.resize(mask.astype(np.float32), size, interpolation=cv2.INTER_AREA) >= 0.5
        # Broad beneath, so that both are seen where they agree.
        outlines.insert(0, (resized, _MASK_COLOUR, 3 * thickness))
    for shape, colour, breadth in outlines:
        lines, _ = cv2.findContours(shape.astype(np.uint8), cv2.RETR_CCOMP, cv2.CHAIN_APPROX_NONE)
        cv2.drawContours(picture, lines, -1, colour, breadth)
    return picture

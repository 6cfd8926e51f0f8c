"""Container masks of a cropped scene, cut from those of the scene before it was cropped.

The release has container masks beside its whole images alone. Crops of these show the same pixels through cameras of
which only the principal point differs, and the size.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from splashbench.errors import SplashbenchError
from splashbench.scene.camera import Camera
from splashbench.scene.scene import Scene

# By how much poses of one camera may differ, as a share of their largest entry.
_SAME_POSE = 1e-6
# By how many pixels a crop may reach beyond the whole image: principal points are rounded.
_BEYOND = 1.0


def cut_container_masks(crop: Scene, whole: Scene) -> dict[str, NDArray[np.bool_]]:
    """Container masks [H, W] for the cameras of `crop` that have one in `whole`; a pixel has the nearest one's value.

    Raises SplashbenchError for a camera that stands elsewhere in `whole` or does not see all of the crop, for a mask
    that cannot be read, and where no training camera has a mask.
    """
    masks = {}
    for name, camera in crop.cameras.items():
        mask = whole.container_mask(name) if name in whole.cameras else None
        if mask is not None:
            require_same_pose(crop, whole, name)
            masks[name] = _cut(mask, whole.cameras[name], camera, f"{whole.directory}: camera {name}")
    if not any(name in masks for name in crop.train):
        raise SplashbenchError(
            f"{whole.directory / 'container_mask'} has no mask of a training camera; draw <camera>.png there"
        )
    return masks


def require_same_pose(crop: Scene, whole: Scene, name: str) -> None:
    """Raise SplashbenchError unless camera `name` stands in `whole` as in `crop`."""
    poses = crop.cameras[name].w2c, whole.cameras[name].w2c
    if not np.allclose(*poses, atol=_SAME_POSE * max(1.0, float(np.abs(poses[0]).max()))):
        raise SplashbenchError(
            f"{whole.directory}: camera {name} stands elsewhere than in {crop.directory}; give the same scene's folder"
            " before it was cropped"
        )


def _cut(mask: NDArray[np.bool_], whole: Camera, crop: Camera, what: str) -> NDArray[np.bool_]:
    columns, rows = (_nearest(axis, whole, crop, what) for axis in (0, 1))
    return mask[np.ix_(rows, columns)]


def _nearest(axis: int, whole: Camera, crop: Camera, what: str) -> NDArray[np.int64]:
    """The pixels of `whole` along `axis` (0 for columns, 1 for rows) that show what those of `crop` show."""
    count, size = ((camera.width, camera.height)[axis] for camera in (crop, whole))
    scale = whole.K[axis, axis] / crop.K[axis, axis]
    places = (np.arange(count) + 0.5 - crop.K[axis, 2]) * scale + whole.K[axis, 2]
    if places[0] < -_BEYOND or places[-1] > size + _BEYOND:
        raise SplashbenchError(f"{what} does not see all that the crop shows; give the scene before it was cropped")
    return np.clip(np.floor(places).astype(np.int64), 0, size - 1)

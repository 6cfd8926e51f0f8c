"""Masks at the resolution that a hull can use.

Carving needs the outline of a silhouette to a fraction of a voxel. Where a voxel is many pixels wide, distances in full
images are time spent on nothing: the masks are averaged over squares of pixels first, and the cameras with them.
"""

from __future__ import annotations

import numpy as np

from splashbench.observe.image_window import ImageWindow
from splashbench.observe.silhouettes import MaskedScene, Silhouettes

#: pixels per voxel that are kept, at least
PIXELS_PER_VOXEL = 2.0


class HeldMasks:
    """The masks that `silhouettes` of `scene` hold, as a scene: to read large ones anew takes seconds."""

    def __init__(self, scene: MaskedScene, silhouettes: Silhouettes) -> None:
        self._silhouettes = silhouettes
        self.name, self.train, self.n_frames = scene.name, silhouettes.views, silhouettes.n_frames
        self.cameras = dict(zip(silhouettes.views, silhouettes.cameras))
        # What `Silhouettes` looks for in scenes whose cameras have times of their own.
        self.times = getattr(scene, "times", None)
        self.camera_times = getattr(scene, "camera_times", {})

    def mask(self, camera: str, t: int) -> np.ndarray:
        """Liquid mask of `camera` in frame `t`: bool [h, w]."""
        view = self.train.index(camera)
        mask = np.zeros((self.cameras[camera].height, self.cameras[camera].width), dtype=bool)
        mask[self._silhouettes.windows[view].slices] = self._silhouettes.mask(view, t)
        return mask


class ReducedScene:
    """`scene` with masks and cameras reduced by the whole number `factor`; other images are not there.

    A pixel is liquid where a line across its square would be: thin streams stay whole.
    """

    def __init__(self, scene: MaskedScene, factor: int) -> None:
        self._scene, self.factor = scene, factor
        self.name, self.train, self.n_frames = scene.name, scene.train, scene.n_frames
        self.cameras = {name: camera.binned(factor) for name, camera in scene.cameras.items()}
        # What `Silhouettes` looks for in scenes whose cameras have times of their own.
        self.times = getattr(scene, "times", None)
        self.camera_times = getattr(scene, "camera_times", {})

    def mask(self, camera: str, t: int) -> np.ndarray:
        """Liquid mask of `camera` in frame `t`: bool [h, w]."""
        view, factor = self.cameras[camera], self.factor
        mask = self._scene.mask(camera, t)
        beyond = view.height * factor - mask.shape[0], view.width * factor - mask.shape[1]
        squares = np.pad(mask, ((0, beyond[0]), (0, beyond[1]))).reshape(view.height, factor, view.width, factor)
        return np.count_nonzero(squares, axis=(1, 3)) >= factor


def reduction(scene: MaskedScene, cells: int, pixels: float = PIXELS_PER_VOXEL) -> int:
    """The whole number by which `scene` is reduced as far as a hull of `cells` voxels along the liquid's longest side
    allows. pixels: of a voxel that are kept, at least.

    The longest side is taken from what the views ever see of the liquid, in the view that sees it smallest.
    """
    longest = []
    for view in scene.train:
        windows = [
            ImageWindow.around(mask) for mask in (scene.mask(view, t) for t in range(scene.n_frames)) if mask.any()
        ]
        if windows:
            union = windows[0]
            for window in windows[1:]:
                union = union.joined(window)
            longest.append(max(union.shape))
    return max(1, int(min(longest) / cells / pixels)) if longest else 1


def reduced(scene: MaskedScene, cells: int) -> MaskedScene:
    """`scene`, reduced as far as a hull of `cells` voxels along the liquid's longest side allows; see `reduction`."""
    factor = reduction(scene, cells)
    return ReducedScene(scene, factor) if factor > 1 else scene

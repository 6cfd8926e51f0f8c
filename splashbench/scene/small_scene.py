"""A training scene with smaller photographs, for a first look: each is read once, and kept."""

from __future__ import annotations

from collections.abc import Mapping

import cv2
import numpy as np
from numpy.typing import NDArray

from splashbench.scene.kept_pictures import KeptPictures
from splashbench.scene.scene import TrainingScene

#: Bytes that its photographs and masks may take: more than of others, as it is there for a moment.
MAX_KEPT_BYTES = 256 << 20


def smaller(scene: TrainingScene, side: int) -> TrainingScene:
    """`scene` with photographs whose longest side is less than twice `side` pixels; itself where none is larger."""
    factors = {name: max(1, max(camera.width, camera.height) // side) for name, camera in scene.cameras.items()}
    return SmallScene(scene, factors) if max(factors.values()) > 1 else scene


class SmallScene(TrainingScene):
    """`scene` with squares of pixels for pixels, `factors` long by camera: means of photographs, and liquid where half
    of a square or more is. Squares at the right and lower edge repeat the last pixels of the image, and are wet by what
    they have. Test cameras stay as they are."""

    def __init__(self, scene: TrainingScene, factors: Mapping[str, int]) -> None:
        super().__init__(scene._scene)
        self._large, self._factors = scene, factors
        self.cameras = {name: camera.binned(factors[name]) for name, camera in scene.cameras.items()}
        self.camera_times = scene.camera_times
        pixels = sum(camera.width * camera.height for camera in self.cameras.values())
        self._pictures = KeptPictures(4 * pixels * self.n_frames, MAX_KEPT_BYTES)
        self.variation = f"{scene.variation}/{sorted(factors.items())}"

    def image(self, camera: str, t: int) -> NDArray[np.uint8]:
        """sRGB uint8 [H, W, 3] of a training camera at timestep `t`."""
        self._training_only(camera)
        return self._pictures.get("image", camera, t, lambda name, at: self._mean(name, self._large.image(name, at)))

    def mask(self, camera: str, t: int) -> NDArray[np.bool_]:
        """Liquid mask [H, W] of a training camera at timestep `t`."""
        self._training_only(camera)
        return self._pictures.mask(camera, t, lambda name, at: self._mostly(name, self._large.mask(name, at)))

    def container_mask(self, camera: str) -> NDArray[np.bool_] | None:
        """Container mask [H, W] of a training camera, or None."""
        mask = self._large.container_mask(camera)
        return None if mask is None else self._mostly(camera, mask)

    def _mean(self, camera: str, image: NDArray[np.uint8]) -> NDArray[np.uint8]:
        """Means over squares of pixels, rounded."""
        f = self._factors[camera]
        down, right = -image.shape[0] % f, -image.shape[1] % f
        if down or right:
            image = np.asarray(cv2.copyMakeBorder(image, 0, down, 0, right, cv2.BORDER_REPLICATE), np.uint8)
        size = image.shape[1] // f, image.shape[0] // f
        return np.asarray(cv2.resize(image, size, interpolation=cv2.INTER_AREA), np.uint8)

    def _mostly(self, camera: str, mask: NDArray[np.bool_]) -> NDArray[np.bool_]:
        return np.asarray(self._mean(camera, np.where(mask, np.uint8(255), np.uint8(0))) > 127)

"""The control `nearest_camera`: the closest training view's image and mask, warped to the test view.

The warp is the homography of one plane: through the point that all training cameras look at, facing the test camera.
It is exact there, and wrong elsewhere by the parallax a reconstruction exists to get right.
"""

from __future__ import annotations

from pathlib import Path
from typing import ClassVar

import cv2
import numpy as np
from numpy.typing import NDArray

from splashbench.background.depth import common_target
from splashbench.background.plane_sweep import for_opencv, plane_homography
from splashbench.files import write_json
from splashbench.harness.contract import Fitted, Method, MethodConfig, Render, Run
from splashbench.scene import Camera, Particles, TrainingScene


class NearestCamera(Method):
    """Copies the nearest training view at the nearest time."""

    id: ClassVar[str] = "nearest_camera"
    title: ClassVar[str] = "control: nearest training view"
    torch_optim: ClassVar[bool] = False
    Config: ClassVar[type[MethodConfig]] = MethodConfig
    control: ClassVar[bool] = True

    def fit(self, scene: TrainingScene, config: MethodConfig, run: Run) -> Fitted:
        run.progress(1.0, "nothing to fit: the training views are the model")
        return NearestView(scene)

    def load(self, directory: Path, scene: TrainingScene) -> Fitted:
        return NearestView(scene)


class NearestView(Fitted):
    """Looks the images up in the scene itself; nothing is learned, so nothing but a note is saved."""

    def __init__(self, scene: TrainingScene) -> None:
        self.scene = scene
        self.center = common_target(list(scene.cameras.values()))

    def source(self, camera: Camera) -> Camera:
        """The training camera that sees the scene's centre from the most similar direction."""
        direction = _direction(camera.center, self.center)
        return max(self.scene.cameras.values(), key=lambda c: float(direction @ _direction(c.center, self.center)))

    def render(self, camera: Camera, time: float) -> Render:
        source = self.source(camera)
        t = int(np.abs(self.scene.camera_times[source.name] - time).argmin())
        warp = for_opencv(homography(camera, source, self.center))
        size = (camera.width, camera.height)
        image, mask = (
            cv2.warpPerspective(
                layer.astype(np.float32), warp, size, flags=cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP, borderMode=border
            )
            for layer, border in (
                (self.scene.image(source.name, t), cv2.BORDER_REPLICATE),
                (self.scene.mask(source.name, t), cv2.BORDER_CONSTANT),
            )
        )
        return Render(np.clip(image / 255, 0, 1).astype(np.float32), np.clip(mask, 0, 1).astype(np.float32))

    def particles(self) -> Particles | None:
        return None

    def save(self, directory: Path) -> None:
        write_json(directory / "nearest_camera.json", {"center": self.center.tolist()})


def _direction(eye: NDArray, target: NDArray) -> NDArray:
    offset = np.asarray(target) - np.asarray(eye)
    return offset / max(float(np.linalg.norm(offset)), 1e-12)


def homography(target: Camera, source: Camera, point: NDArray) -> NDArray[np.float64]:
    """Pixels of `target` to pixels of `source`, [3, 3], over the plane through `point` that faces `target`.

    Where the point does not lie before the target camera, the plane at infinity is taken.
    """
    depth = float(target.w2c[2, :3] @ point + target.w2c[2, 3])
    return plane_homography(target, source, 1 / depth if depth > 1e-9 else 0.0)

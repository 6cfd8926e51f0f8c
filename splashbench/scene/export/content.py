"""What every export of a scene shares: which views have pixels, when they were taken, and initial points.

Other people's codes read an export. It holds pixels of training views only. Test views are poses and times, unless
their images are asked for.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal, NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray

from splashbench.errors import SplashbenchError
from splashbench.files import write_png
from splashbench.progress import track
from splashbench.scene.camera import Camera

#: Of test views: no images; black ones, for codes that open them while loading; the ground truth.
TestImages = Literal["none", "blank", "true"]

#: More static points than this help no code, and in COLMAP's layout each frame holds them anew.
MAX_STATIC = 100_000
MAX_STATIC_PER_FRAME = 10_000


def max_static(format_name: str) -> int:
    """The largest number of static points in the export or, of `colmap`, in each of its timesteps."""
    return MAX_STATIC_PER_FRAME if format_name == "colmap" else MAX_STATIC


# Off-diagonal entries of K, relative to the focal length: beyond rounding, a pinhole of four numbers is another camera.
_NO_SKEW = 1e-9


class Recording(Protocol):
    """What an export needs of a scene; attributes and methods as `Scene` has them."""

    train: tuple[str, ...]
    test: tuple[str, ...]
    cameras: dict[str, Camera]
    camera_times: dict[str, NDArray[np.float64]]
    n_frames: int

    def image(self, camera: str, t: int) -> NDArray[np.uint8]:
        """sRGB uint8 [H, W, 3] of `camera` at timestep `t`."""

    def mask(self, camera: str, t: int) -> NDArray[np.bool_]:
        """Liquid mask [H, W] of `camera` at timestep `t`."""


@dataclass(frozen=True)
class Clock:
    """Seconds to a time in [0, 1]: 0 is the first exposure of any camera, 1 the last one, `span` seconds later."""

    origin: float
    span: float

    @classmethod
    def of(cls, scene: Recording) -> Clock:
        """The clock of `scene`."""
        times = np.stack([scene.camera_times[name] for name in scene.cameras])
        return cls(float(times.min()), float(times.max() - times.min()))

    def unit(self, seconds: float) -> float:
        """`seconds` on the scene's clock as a time in [0, 1]; a scene of one instant is at 0."""
        return (seconds - self.origin) / self.span if self.span > 0 else 0.0


@dataclass(frozen=True)
class InitialPoints:
    """Coloured points that a reconstruction starts from.

    Attributes:
        static: [N, 6] x, y, z in scene units, r, g, b in [0, 1]; there at all times.
        liquid: of each timestep, [n, 6], on the surface of its visual hull.
    """

    static: NDArray[np.float64]
    liquid: tuple[NDArray[np.float64], ...]

    def cloud(self) -> NDArray[np.float64]:
        """All of them, [N, 6]: for codes that start from one cloud."""
        return np.concatenate([thinned(self.static, MAX_STATIC), *self.liquid])

    def frame(self, t: int) -> NDArray[np.float64]:
        """Those of timestep `t`, [N, 6]: for codes that start from a cloud per frame."""
        return np.concatenate([thinned(self.static, MAX_STATIC_PER_FRAME), self.liquid[t]])


def thinned(points: NDArray[np.float64], limit: int) -> NDArray[np.float64]:
    """At most `limit` of `points` [N, D], evenly through the array."""
    if len(points) <= limit:
        return points
    return points[np.linspace(0, len(points) - 1, limit).round().astype(int)]


class ExportView(NamedTuple):
    """One photograph: camera, timestep, and when it was taken, in seconds and in [0, 1]."""

    camera: Camera
    t: int
    seconds: float
    time: float

    @property
    def id(self) -> str:
        """A name that no other view of the scene has, such as "3_000012"."""
        return f"{self.camera.name}_{self.t:06d}"


@dataclass(frozen=True)
class Export:
    """One export under way: what is written, where to, and how much of the test views.

    photographs: whether there are images at all; without them an export has cameras and points.
    """

    scene: Recording
    directory: Path
    points: InitialPoints
    clock: Clock
    test_images: TestImages = "none"
    masks: bool = False
    photographs: bool = True

    def views(self, names: Sequence[str]) -> list[ExportView]:
        """The views of the cameras `names`, all of a camera's after one another."""
        cameras, times = self.scene.cameras, self.scene.camera_times
        return [
            ExportView(cameras[name], t, float(times[name][t]), self.clock.unit(float(times[name][t])))
            for name in names
            for t in range(self.scene.n_frames)
        ]

    @property
    def train_views(self) -> list[ExportView]:
        """Views that have images and are trained on."""
        return self.views(self.scene.train)

    @property
    def test_views(self) -> list[ExportView]:
        """Views that are to be rendered."""
        return self.views(self.scene.test)

    def has_image(self, view: ExportView) -> bool:
        """Whether `view` has an image file in this export."""
        return self.photographs and (self.test_images != "none" or view.camera.name in self.scene.train)

    def has_mask(self, view: ExportView) -> bool:
        """Whether `view` has a mask file in this export. A test mask is ground truth, as a test image is."""
        return self.masks and (self.test_images == "true" or view.camera.name in self.scene.train)

    def write_images(self, folder: str, mask_folder: str, name: str = "{id}.png") -> None:
        """Write image and mask of every view that has them as PNG files: `folder`/`name`, `mask_folder`/`name`.

        The patterns may hold {id}, {camera}, {t}, and {split}: "test/" for test views, else nothing.
        """
        views = [view for view in self.train_views + self.test_views if self.has_image(view)]
        for view in track(views, "exporting"):
            split = "" if view.camera.name in self.scene.train else "test/"
            words = {"id": view.id, "camera": view.camera.name, "t": view.t, "split": split}
            write_png(self.directory / folder.format(**words) / name.format(**words), self.image(view))
            if self.has_mask(view):
                mask = np.where(self.scene.mask(view.camera.name, view.t), 255, 0).astype(np.uint8)
                write_png(self.directory / mask_folder.format(**words) / name.format(**words), mask)

    def image(self, view: ExportView) -> NDArray[np.uint8]:
        """sRGB uint8 [H, W, 3] of `view`; black where a test view's image is blank."""
        if view.camera.name in self.scene.train or self.test_images == "true":
            return self.scene.image(view.camera.name, view.t)
        return np.zeros((view.camera.height, view.camera.width, 3), np.uint8)


def pinhole(camera: Camera) -> tuple[float, float, float, float]:
    """fx, fy, cx, cy of `camera`. Raises SplashbenchError for a K that holds more than these."""
    fx, fy, cx, cy = (float(camera.K[place]) for place in ((0, 0), (1, 1), (0, 2), (1, 2)))
    if np.abs(camera.K - [[fx, 0, cx], [0, fy, cy], [0, 0, 1]]).max() > _NO_SKEW * max(fx, fy):
        raise SplashbenchError(
            f"camera {camera.name}: K has more than focal lengths and principal point, which this format cannot say; "
            "undistort its images to a plain pinhole"
        )
    return fx, fy, cx, cy

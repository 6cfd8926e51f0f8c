"""A reconstruction as nerfstudio reads a capture: cameras, photographs where the scene is at hand, and its points.

The layout is that of `splashbench scene export`, whose writer makes it (scene/export/transforms.py). What differs are
the points to start from: those of the fitted liquid and background, instead of the masks' hull.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from splashbench.errors import SplashbenchError
from splashbench.export.instants import all_or, timesteps
from splashbench.export.manifest import Manifest, export_folder, write_manifest
from splashbench.export.placement import Placement
from splashbench.replay import Reconstruction
from splashbench.scene import Camera, Gaussians
from splashbench.scene.export.content import Clock, Export, InitialPoints, thinned
from splashbench.scene.export.transforms import write_nerfstudio
from splashbench.submission.withheld import kept_timesteps

DEFAULT_POINTS = 20_000
# Fainter Gaussians are haze, and no place to start from.
_SOLID = 0.1
_GREY = 0.5
_NO_IMAGES = (
    "a submission holds no photographs: images/ is missing, which nerfstudio needs; give the scene (--scene), or put "
    "them where transforms.json names them"
)


class _Recording:
    """The scene of a reconstruction as an export sees it: placed cameras, and the timesteps that were chosen."""

    def __init__(self, reconstruction: Reconstruction, steps: NDArray[np.int64], placement: Placement) -> None:
        self._scene = reconstruction.scene
        self.train, self.test = reconstruction.train, reconstruction.test
        self.cameras: dict[str, Camera] = {
            name: placement.camera(camera) for name, camera in reconstruction.cameras.items()
        }
        self.camera_times = {name: times[steps] for name, times in reconstruction.camera_times.items()}
        self.n_frames = len(steps)
        self._steps = steps
        if self._scene is not None:
            kept = kept_timesteps(self._scene.n_frames, reconstruction.submission.identity.withheld)
            self._steps = np.asarray(kept)[steps]

    def image(self, camera: str, t: int) -> NDArray[np.uint8]:
        """sRGB uint8 [H, W, 3] of `camera` at the chosen timestep number `t`."""
        assert self._scene is not None  # no images are asked for without one
        return self._scene.image(camera, int(self._steps[t]))

    def mask(self, camera: str, t: int) -> NDArray[np.bool_]:
        """Liquid mask [H, W] likewise."""
        assert self._scene is not None
        return self._scene.mask(camera, int(self._steps[t]))


def export_nerfstudio(
    reconstruction: Reconstruction,
    out: Path | str,
    times: NDArray[np.float64] | None = None,
    placement: Placement | None = None,
    *,
    points: int = DEFAULT_POINTS,
    replace: bool = False,
) -> Manifest:
    """Write transforms.json, points3d.ply and, with the scene at hand, images/ into the folder `out`.

    Cameras are in OpenGL's convention, a frame for each training camera and each of `times` [F] (timesteps in seconds;
    all by default). Test cameras are poses alone, in transforms_test.json. The points are at most `points` of the
    liquid at the first of the times, and as many of the background. placement: units and axes, the scene's own by
    default.

    Raises SplashbenchError for instants that are no timesteps, for a reconstruction without any points, for cameras
    that the layout cannot express, and for places that are taken.
    """
    instants, placed = all_or(reconstruction, times), placement or Placement()
    steps = timesteps(reconstruction, instants, "photographs")
    liquid = _liquid_points(reconstruction, int(steps[0]), points)
    static = _static_points(reconstruction, points)
    if not len(liquid) + len(static):
        raise SplashbenchError(
            f"{reconstruction.submission.directory} has no points to start from at {instants[0]:g} s; give a time at "
            "which there is liquid (--times)"
        )
    for table in (liquid, static):
        table[:, :3] = placed.points(table[:, :3])
    recording = _Recording(reconstruction, steps, placed)
    has_images = reconstruction.scene is not None
    with export_folder(reconstruction, out, replace) as staging:
        cloud = InitialPoints(static, (liquid,))
        write_nerfstudio(Export(recording, staging, cloud, Clock.of(recording), photographs=has_images))
        files = ["transforms.json", "transforms_test.json", "points3d.ply", *(["images"] if has_images else [])]
        return write_manifest(
            staging,
            reconstruction,
            "nerfstudio",
            instants,
            placed,
            files,
            options={"points": points, "images": has_images},
            counts={"liquid_points": [len(liquid)], "background_points": [len(static)]},
            notes=[] if has_images else [_NO_IMAGES],
        )


def _liquid_points(reconstruction: Reconstruction, t: int, most: int) -> NDArray[np.float64]:
    """Coloured points [N, 6] of the liquid at timestep `t`: means of its Gaussians, or else its particles, in grey."""
    gaussians = reconstruction.gaussians(float(reconstruction.times[t]))
    if gaussians is not None:
        return _means(gaussians, most)
    particles = reconstruction.particles()
    if particles is None:
        return np.zeros((0, 6))
    positions = thinned(particles.at(t).astype(np.float64), most)
    return np.concatenate([positions, np.full((len(positions), 3), _GREY)], axis=1)


def _static_points(reconstruction: Reconstruction, most: int) -> NDArray[np.float64]:
    """Coloured points [N, 6] of what stands still: means of the background's Gaussians, or else the scene's own."""
    gaussians = reconstruction.static_gaussians()
    if gaussians is not None and len(gaussians):
        return _means(gaussians, most)
    sparse = None if reconstruction.scene is None else reconstruction.scene.initial_points()
    return np.zeros((0, 6)) if sparse is None else thinned(sparse[:, :6].astype(np.float64), most)


def _means(gaussians: Gaussians, most: int) -> NDArray[np.float64]:
    solid = gaussians.kept(gaussians.opacities >= _SOLID)
    finite = np.isfinite(solid.means).all(axis=1) & np.isfinite(solid.colors).all(axis=1)
    table = np.concatenate([solid.means, solid.colors], axis=1)[finite].astype(np.float64)
    return thinned(table, most)

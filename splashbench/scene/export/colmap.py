"""A COLMAP model per timestep, as SpacetimeGaussians reads it: colmap_<t>/images/<cam>.png and sparse/0/*.bin.

PINHOLE cameras with the true principal point. The models hold the training cameras; the same layout below test/ holds
the test cameras. A timestep's points are the static ones and those of the liquid at that time.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from splashbench.progress import track
from splashbench.scene.camera import Camera
from splashbench.scene.export.content import Export, pinhole


def write_colmap(export: Export) -> None:
    """Write the models."""
    scene = export.scene
    train, test = ([scene.cameras[name] for name in names] for names in (scene.train, scene.test))
    for t in track(range(scene.n_frames), "exporting points"):
        points = export.points.frame(t)
        for folder, cameras in ((model_folder(t), train), (Path("test", model_folder(t)), test)):
            write_model_files(export.directory / folder / "sparse" / "0", cameras, points)
    export.write_images("{split}colmap_{t}/images", "{split}colmap_{t}/masks", "{camera}.png")


def model_folder(t: int) -> Path:
    """The folder of timestep `t`."""
    return Path(f"colmap_{t}")


def write_model_files(directory: Path, cameras: Sequence[Camera], points: NDArray[np.float64]) -> None:
    """Write cameras.bin, images.bin and points3D.bin: an image NAME.png per camera, `points` [N, 6] without tracks."""
    from splashbench.colmap import pycolmap

    model = pycolmap.Reconstruction()
    for number, camera in enumerate(cameras, 1):
        lens = pycolmap.Camera(
            model="PINHOLE", width=camera.width, height=camera.height, params=pinhole(camera), camera_id=number
        )
        model.add_camera_with_trivial_rig(lens)
        image = pycolmap.Image(name=f"{camera.name}.png", camera_id=number, image_id=number)
        pose = pycolmap.Rigid3d(pycolmap.Rotation3d(nearest_rotation(camera)), camera.w2c[:3, 3])
        model.add_image_with_trivial_frame(image, pose)
    colours = np.rint(np.clip(points[:, 3:], 0, 1) * 255).astype(np.uint8)
    for position, colour in zip(points[:, :3], colours):
        model.add_point3D(position, pycolmap.Track(), colour)
    directory.mkdir(parents=True)
    model.write_binary(str(directory))
    for newer in ("rigs.bin", "frames.bin"):  # which older readers do not know, and newer ones do without
        (directory / newer).unlink(missing_ok=True)


def nearest_rotation(camera: Camera) -> NDArray[np.float64]:
    """The rotation [3, 3] next to that of `camera`, which is one to rounding only; COLMAP keeps quaternions."""
    u, _, vt = np.linalg.svd(camera.w2c[:3, :3])
    return u @ vt

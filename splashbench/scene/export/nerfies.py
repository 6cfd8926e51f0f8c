"""The layout of Nerfies datasets, also read by Deformable-3DGS (github.com/google/nerfies, README, "Datasets").

camera/<id>.json, rgb/1x/<id>.png, metadata.json, dataset.json, scene.json, points.npy; an id is CAMERA_TIMESTEP. Test
views without images are in camera-paths/test/<id>.json. Readers move by `center`, then multiply by `scale`.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from splashbench.errors import SplashbenchError
from splashbench.files import atomic_path, write_json
from splashbench.scene.camera import Camera
from splashbench.scene.export.content import Export, ExportView

# The middle of the depths is where the scene is; single stray points must not set the planes.
_DEPTH_PERCENTILES = (0.1, 99.9)
_BOX_PERCENTILES = (1.0, 99.0)
_NEAR_MARGIN, _FAR_MARGIN = 0.8, 1.2
MICROSECONDS = 1e6


def write_nerfies(export: Export) -> None:
    """Write the dataset."""
    directory = export.directory
    export.write_images("rgb/1x", "mask/1x")
    train, test = export.train_views, export.test_views
    held_out = [view for view in test if export.has_image(view)]
    for view in train + held_out:
        write_json(directory / "camera" / f"{view.id}.json", camera_json(view.camera))
    for view in test:
        write_json(directory / "camera-paths" / "test" / f"{view.id}.json", camera_json(view.camera))
    write_json(directory / "metadata.json", {view.id: _metadata(export, view) for view in train + test})
    train_ids, val_ids = [view.id for view in train], [view.id for view in held_out]
    ids = {"ids": train_ids + val_ids, "train_ids": train_ids, "val_ids": val_ids}
    write_json(directory / "dataset.json", {"count": len(ids["ids"]), "num_exemplars": len(train), **ids})
    cloud = export.points.cloud()[:, :3]
    write_json(directory / "scene.json", _scene_json(list(export.scene.cameras.values()), cloud))
    with atomic_path(directory / "points.npy") as temporary, temporary.open("wb") as stream:
        np.save(stream, cloud, allow_pickle=False)


def camera_json(camera: Camera) -> dict[str, Any]:
    """`camera` as Nerfies has it: u = f x + skew y + cx, v = f aspect y + cy, orientation world to camera.

    Pixel centres lie at +0.5 there too.
    """
    fx, skew, fy = float(camera.K[0, 0]), float(camera.K[0, 1]), float(camera.K[1, 1])
    if camera.K[1, 0] != 0 or camera.K[2].tolist() != [0, 0, 1]:
        raise SplashbenchError(
            f"camera {camera.name}: K is no upper triangle with a last row of 0 0 1; write the calibration again"
        )
    rotation, translation = camera.w2c[:3, :3], camera.w2c[:3, 3]
    straight = [0.0, 0.0]
    return {
        "orientation": rotation.tolist(),
        # Solved for, not -R^T t: calibrations are rotations to rounding only, and pixels shall stay where they are.
        "position": np.linalg.solve(rotation, -translation).tolist(),
        "focal_length": fx,
        "principal_point": [float(camera.K[0, 2]), float(camera.K[1, 2])],
        "skew": skew,
        "pixel_aspect_ratio": fy / fx,
        "radial_distortion": [*straight, 0.0],
        # Nerfies has the first name, HyperNeRF the second.
        "tangential": straight,
        "tangential_distortion": straight,
        "image_size": [camera.width, camera.height],
    }


def _metadata(export: Export, view: ExportView) -> dict[str, int]:
    """Numbers of embeddings. time_id, of which Deformable-3DGS takes the share of the largest, has the true time."""
    return {
        "warp_id": view.t,
        "appearance_id": view.t,
        "camera_id": list(export.scene.cameras).index(view.camera.name),
        "time_id": round((view.seconds - export.clock.origin) * MICROSECONDS),
    }


def _scene_json(cameras: list[Camera], cloud: NDArray[np.float64]) -> dict[str, Any]:
    """scale, center (unscaled), near and far (scaled), so that cameras and points fit into a box of diagonal 1."""
    eyes = np.stack([camera.center for camera in cameras])
    corners = np.concatenate([eyes, np.percentile(cloud, _BOX_PERCENTILES, axis=0)])
    low, high = corners.min(axis=0), corners.max(axis=0)
    scale = 1.0 / float(np.linalg.norm(high - low))
    depths = np.concatenate([camera.project(cloud)[1] for camera in cameras])
    near, far = np.percentile(depths[depths > 0], _DEPTH_PERCENTILES) if (depths > 0).any() else (0.1, 1.0)
    return {
        "scale": scale,
        "center": ((low + high) / 2).tolist(),
        "near": float(near) * scale * _NEAR_MARGIN,
        "far": float(far) * scale * _FAR_MARGIN,
    }

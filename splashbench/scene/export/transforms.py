"""The transforms.json family: Blender (D-NeRF, 4D-Scaffold-GS) and nerfstudio (docs.nerf.studio, "Data conventions").

Camera to world in OpenGL axes (x right, y up, z backward); per frame fl_x, fl_y, cx, cy, w, h and `time` in [0, 1].
Blender has a file per split, and paths without the ending .png; nerfstudio has one file, and lists of the split.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import numpy as np

from splashbench.files import write_json
from splashbench.files.ply import write_colored_points
from splashbench.scene.export.content import Export, ExportView, pinhole

_OPENCV_TO_OPENGL = np.diag([1.0, -1.0, -1.0, 1.0])
_POINTS = "points3d.ply"


def write_blender(export: Export) -> None:
    """Write transforms_train.json, transforms_test.json, images/ and points3d.ply."""
    export.write_images("images", "masks")
    for split, views in (("train", export.train_views), ("test", export.test_views)):
        write_json(export.directory / f"transforms_{split}.json", _clocked(export, views, ending="", blender=True))
    write_colored_points(export.directory / _POINTS, export.points.cloud())


def write_nerfstudio(export: Export) -> None:
    """Write transforms.json, images/ and points3d.ply; transforms_test.json has the poses of test views without images.

    Where test views have no images, the views shown while training (`val`) are the training views themselves: without
    lists, nerfstudio would hold a tenth of them out.
    """
    export.write_images("images", "masks")
    train, test = export.train_views, export.test_views
    with_images = [view for view in test if export.has_image(view)]
    shown = with_images or train
    content = _clocked(export, train + with_images, ending=".png")
    content |= {
        "camera_model": "OPENCV",
        "ply_file_path": _POINTS,
        "train_filenames": [_path(view, ".png") for view in train],
        "val_filenames": [_path(view, ".png") for view in shown],
        "test_filenames": [_path(view, ".png") for view in with_images],
    }
    write_json(export.directory / "transforms.json", content)
    if not with_images:
        write_json(export.directory / "transforms_test.json", _clocked(export, test, ending=".png"))
    write_colored_points(export.directory / _POINTS, export.points.cloud())


def _path(view: ExportView, ending: str) -> str:
    return f"images/{view.id}{ending}"


def _clocked(export: Export, views: Sequence[ExportView], ending: str, blender: bool = False) -> dict[str, Any]:
    """The content of a transforms file: the clock, and a frame per view."""
    content: dict[str, Any] = {
        "time_origin_seconds": export.clock.origin,
        "time_span_seconds": export.clock.span,
    }
    if blender and views:  # one angle for all: only for codes that know nothing else
        camera = views[0].camera
        content["camera_angle_x"] = 2 * math.atan(camera.width / (2 * pinhole(camera)[0]))
    return content | {"frames": [_frame(export, view, ending) for view in views]}


def _frame(export: Export, view: ExportView, ending: str) -> dict[str, Any]:
    camera = view.camera
    fx, fy, cx, cy = pinhole(camera)
    frame = {
        "file_path": _path(view, ending),
        "time": view.time,
        "time_seconds": view.seconds,
        "camera": camera.name,
        "frame": view.t,
        "fl_x": fx,
        "fl_y": fy,
        "cx": cx,
        "cy": cy,
        "w": camera.width,
        "h": camera.height,
        "transform_matrix": (np.linalg.inv(camera.w2c) @ _OPENCV_TO_OPENGL).tolist(),
    }
    # Not "mask_path": readers take that for the pixels to train on.
    return frame | ({"liquid_mask_path": f"masks/{view.id}.png"} if export.has_mask(view) else {})

"""Scenes written as other people's codes read them: nerfies, nerfstudio, Blender (D-NeRF), COLMAP per timestep."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np

from splashbench.errors import SplashbenchError
from splashbench.files import atomic_directory, write_model
from splashbench.scene.export.colmap import nearest_rotation, write_colmap
from splashbench.scene.export.content import Clock, Export, InitialPoints, TestImages, max_static
from splashbench.scene.export.nerfies import write_nerfies
from splashbench.scene.export.records import FACTS, TEST_VIEWS, ExportFacts, WantedViews, export_facts
from splashbench.scene.export.transforms import write_blender, write_nerfstudio
from splashbench.scene.scene import Scene

__all__ = ["FACTS", "FORMATS", "TEST_VIEWS", "ExportFacts", "InitialPoints", "WantedViews", "export_scene", "remarks"]

FORMATS: dict[str, Callable[[Export], None]] = {
    "nerfies": write_nerfies,
    "nerfstudio": write_nerfstudio,
    "blender": write_blender,
    "colmap": write_colmap,
}
# Largest deviation of a step from the mean, as a share of it, without a remark for layouts that count frames.
_UNEVEN = 0.02
_PIXEL = 0.01
_OFF_CENTRE = 1.0
# What readers of a format make of principal points.
_ON_PRINCIPAL_POINTS = {
    "nerfies": "Deformable-3DGS ignores them, and renders as if they were in the middle",
    "blender": "4D-Scaffold-GS reads them; Deformable-3DGS renders as if they were in the middle",
    "colmap": "SpacetimeGaussians keeps them with its loader technicolor, its loader colmap puts them in the middle",
}


def export_scene(
    scene: Scene,
    out: Path,
    format_name: str,
    points: InitialPoints,
    *,
    test_images: TestImages = "none",
    masks: bool = False,
    replace: bool = False,
) -> ExportFacts:
    """Write `scene` into the folder `out` as the code of `format_name` (of FORMATS) reads it.

    Args:
        points: what reconstructions start from; observe.initial_points finds it.
        test_images: whether test views have no images, black ones, or their own, which are the ground truth.
        masks: whether the liquid masks of all views that have true images are written too.

    Raises SplashbenchError for a camera that the format cannot express, and where there are no points.
    """
    if not len(points.cloud()):
        raise SplashbenchError(
            f"{scene.directory}: there are no points to start from, neither in init_pt_cld.npz nor from the masks; "
            "ask for points of the hull (--points)"
        )
    with atomic_directory(out, replace=replace, holds=FACTS, inputs=[scene.directory]) as staging:
        export = Export(scene, staging, points, Clock.of(scene), test_images, masks)
        FORMATS[format_name](export)
        write_model(staging / TEST_VIEWS, WantedViews.of(export, scene.name))
        written = export_facts(export, scene, format_name)
        write_model(staging / FACTS, written)
    return written


def remarks(scene: Scene, format_name: str, out: Path) -> list[str]:
    """What an export loses: where the scene holds more than the format, or than the codes that read it use."""
    lines = []
    if scene.times_source == "nominal":
        lines.append("the scene has no timestamps; times are an order, not seconds")
    static, limit = scene.initial_points(), max_static(format_name)
    if static is not None and len(static) > limit:
        each = " in each timestep" if format_name == "colmap" else ""
        lines.append(f"{limit} of the {len(static)} static points are written{each}, evenly chosen")
    if format_name == "colmap":
        steps = np.diff(np.stack([scene.camera_times[name] for name in scene.cameras]), axis=1)
        uneven = float(np.abs(steps / steps.mean() - 1).max()) if steps.size else 0.0
        delay = max(float(np.abs(times - scene.times).max()) for times in scene.camera_times.values())
        if uneven > _UNEVEN:
            lines.append(f"COLMAP's layout counts frames: steps that are uneven by up to {uneven:.0%} become even")
        if steps.size and delay > _UNEVEN * steps.mean():
            lines.append(
                f"COLMAP's layout has one time per frame: cameras that expose up to {1000 * delay:.1f} ms apart from "
                "the scene's times become simultaneous"
            )
        moved = max(
            float(np.abs(camera.w2c[:3, :3] - nearest_rotation(camera)).max() * camera.K[0, 0])
            for camera in scene.cameras.values()
        )
        if moved > _PIXEL:
            lines.append(f"w2c is a rotation to rounding only; COLMAP's quaternions move pixels by up to {moved:.2f}")
    off = max(
        float(np.hypot(camera.K[0, 2] - camera.width / 2, camera.K[1, 2] - camera.height / 2))
        for camera in scene.cameras.values()
    )
    if off > _OFF_CENTRE and format_name in _ON_PRINCIPAL_POINTS:
        lines.append(f"principal points lie up to {off:.1f} pixels off the middle; {_ON_PRINCIPAL_POINTS[format_name]}")
    if format_name == "nerfies" and not Path(out).resolve().parent.name.startswith("NeRF"):
        lines.append("Deformable-3DGS reads this layout only from a folder whose parent's name begins with NeRF")
    return lines

"""Inspection of a scene: all its faults for `splashbench scene check`, its facts for `splashbench scene info`."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from splashbench.errors import SplashbenchError
from splashbench.progress import track
from splashbench.scene.plausibility import calibration_faults
from splashbench.scene.scene import Scene


def check_scene(directory: Path) -> list[str]:
    """All faults of the scene in `directory`, a line each; an empty list means that everything reads."""
    try:
        scene = Scene.open(directory)
    except SplashbenchError as error:
        return [str(error)]
    faults = calibration_faults(scene)
    empty, full = dict.fromkeys(scene.cameras, 0), dict.fromkeys(scene.cameras, 0)
    pairs = [(camera, t) for camera in scene.cameras for t in range(scene.n_frames)]
    for camera, t in track(pairs, "checking the scene"):
        for read in (scene.image, scene.mask):
            if read == scene.mask and camera in scene.unmasked:
                continue
            try:
                array = read(camera, t)
            except SplashbenchError as error:
                faults.append(str(error))
                continue
            empty[camera] += int(read == scene.mask and not array.any())
            full[camera] += int(read == scene.mask and array.all())
    unmasked = all(camera in scene.unmasked or empty[camera] == scene.n_frames for camera in scene.train)
    remedy = ", which `splashbench scene self-calibrate` finds in the photographs" if unmasked else ""
    folder, without = scene.directory / "seg", ", ".join(name for name in scene.test if name in scene.unmasked)
    if scene.unmasked.issuperset(scene.train):
        faults.append(f"{folder}: there are no masks of the training cameras, so that they show no liquid{remedy}")
    if without:
        faults.append(f"{folder}: there are no masks of test cameras ({without}), within which they would be scored")
    for camera in (name for name in scene.cameras if name not in scene.unmasked):
        folder = scene.mask_path(camera, 0).parent
        if empty[camera] == scene.n_frames:
            faults.append(f"{folder}: every mask is empty; the camera shows no liquid{remedy}")
        if full[camera] == scene.n_frames:
            faults.append(f"{folder}: every mask is full; the camera shows no outline of the liquid")
    for optional in (scene.initial_points, scene.container_mesh, scene.truth_particles):
        try:
            optional()
        except SplashbenchError as error:
            faults.append(str(error))
    for camera in scene.cameras:
        try:
            scene.container_mask(camera)
        except SplashbenchError as error:
            faults.append(str(error))
    # Where image and mask are one file, its fault is one too.
    return list(dict.fromkeys(faults + scene.faults()))


def describe_scene(scene: Scene) -> dict:
    """The facts of `splashbench scene info`: sizes, split, times, and None for what is unknown."""
    coverage = {
        camera: float(np.mean([scene.mask(camera, t).mean() for t in range(0, scene.n_frames, 5)]))
        for camera in scene.cameras
        if camera not in scene.unmasked
    }
    points = scene.initial_points()
    return {
        "name": scene.name,
        "layout": scene.layout,
        "frames": scene.n_frames,
        "interval_seconds": float(scene.times[-1] - scene.times[0]),
        "times_source": scene.times_source,
        "train": list(scene.train),
        "test": list(scene.test),
        "sizes": {name: [camera.width, camera.height] for name, camera in scene.cameras.items()},
        "mask_coverage": {camera: round(value, 5) for camera, value in coverage.items()},
        "gravity": scene.gravity.tolist() if scene.gravity is not None else None,
        "metres_per_unit": scene.metres_per_unit,
        "initial_points": 0 if points is None else len(points),
        "truth_particles": scene.has_truth,
        "released": scene.is_released,
        "digest": scene.digest,
    }

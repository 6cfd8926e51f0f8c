"""A scene written as its own footage says that it was recorded, so that any method can be run on it."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from splashbench.scene import Scene, SceneMeta, write_scene
from splashbench.scene.container import copy_mesh
from splashbench.scene.layout import plain_name

from .scene import SelfCalibration


def write_calibrated(scene: Scene, found: SelfCalibration, directory: Path) -> None:
    """Write `scene` into `directory` with what was `found` undone in the training views; test views stay as they are.

    Wrap it in `files.atomic_directory` for all or nothing.
    """
    right = found.scene(scene.training())
    names = [*scene.train, *scene.test]

    def frames() -> Iterator[tuple[str, int, NDArray[np.uint8], NDArray[np.bool_] | None]]:
        for name in names:
            views = right if name in right.cameras else scene
            for t in range(scene.n_frames):
                without = name in scene.unmasked and name in scene.test
                yield name, t, views.image(name, t), None if without else views.mask(name, t)

    masks = {name: (right if name in right.cameras else scene).container_mask(name) for name in names}
    # Without scene.json the folder's name decides what a scene is; times that nobody stated stay unstated.
    meta = scene.meta or SceneMeta(name=plain_name(scene.name))
    clocks = {**(meta.camera_times or {}), **{name: right.camera_times[name].tolist() for name in found.offsets}}
    write_scene(
        directory,
        cameras={**right.cameras, **right.test_cameras},
        train=scene.train,
        test=scene.test,
        n_frames=scene.n_frames,
        frames=frames(),
        meta=meta.model_copy(update={"camera_times": clocks or None}),
        initial_points=scene.initial_points(),
        container_masks={name: mask for name, mask in masks.items() if mask is not None},
    )
    if meta.container_mesh is not None:
        copy_mesh(scene.directory, directory, meta.container_mesh)
    particles = scene.truth_particles()
    if particles is not None:
        particles.save(directory / "truth" / "particles.npz")

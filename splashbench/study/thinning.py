"""Scenes of fewer timesteps that remember what was recorded between them: for harm that takes milliseconds."""

from __future__ import annotations

import hashlib
import json
from pathlib import Path

import numpy as np
from filelock import FileLock
from pydantic import BaseModel, ConfigDict, Field

from splashbench.errors import SplashbenchError
from splashbench.files import atomic_directory, read_model, write_model
from splashbench.scene import Scene, SceneMeta, write_scene
from splashbench.scene.container import copy_mesh
from splashbench.scene.layout import plain_name

_FILE = "between.json"
_LEAST_TIMESTEPS = 2


class Between(BaseModel):
    """between.json: the scene that a thinned one was made of, each `every`-th timestep of it."""

    model_config = ConfigDict(extra="forbid")
    schema_version: int = 1
    scene: str
    every: int = Field(ge=2)


def recorded(scene: Scene) -> tuple[Scene, int]:
    """The scene that has what was recorded between the timesteps of `scene`, and each how many of its timesteps these
    are: `scene` itself and 1 where nothing is known.

    Raises SplashbenchError where that other scene is gone, or is none that `scene` could be made of.
    """
    path = scene.directory / _FILE
    if not path.is_file():
        return scene, 1
    said = read_model(path, Between)
    whole = Scene.open(Path(said.scene))
    same_times = np.array_equal(whole.times[:: said.every], scene.times)
    same_cameras = whole.cameras.keys() >= set(scene.cameras) and all(
        (camera.width, camera.height) == (whole.cameras[name].width, whole.cameras[name].height)
        and np.array_equal(camera.projection, whole.cameras[name].projection)
        for name, camera in scene.cameras.items()
    )
    if not (same_times and same_cameras):
        raise SplashbenchError(f"{path} names {said.scene}, which has other times or cameras; delete the file")
    return whole, said.every


def thinned(scene: Scene, every: int, folder: Path) -> Scene:
    """Each `every`-th timestep of `scene`, as a scene of its own below `folder`; made where it is not there yet.

    True particles are left behind. Raises SplashbenchError where too few timesteps would be left.
    """
    kept = range(0, scene.n_frames, every)
    if len(kept) < _LEAST_TIMESTEPS:
        raise SplashbenchError(f"{scene.directory}: each {every}th of {scene.n_frames} timesteps leaves {len(kept)}")
    text = json.dumps([scene.digest, every, str(scene.directory.resolve())])
    # The folder keeps its name: without scene.json it decides what a scene is (Table S1).
    place = folder / hashlib.sha256(text.encode()).hexdigest()[:16] / scene.directory.resolve().name
    place.parent.parent.mkdir(parents=True, exist_ok=True)
    with FileLock(place.parent.with_suffix(".lock")):
        if not place.exists():
            with atomic_directory(place) as staging:
                _write(scene, every, kept, staging)
    return Scene.open(place)


def _write(scene: Scene, every: int, kept: range, directory: Path) -> None:
    names = [*scene.train, *scene.test]
    meta = scene.meta or SceneMeta(name=plain_name(scene.name))
    clocks = meta.camera_times
    write_scene(
        directory,
        cameras={name: scene.cameras[name] for name in names},
        train=scene.train,
        test=scene.test,
        n_frames=len(kept),
        frames=((name, k, scene.image(name, t), scene.mask(name, t)) for name in names for k, t in enumerate(kept)),
        meta=meta.model_copy(
            update={
                "times": scene.times[:: kept.step].tolist(),
                "camera_times": clocks and {name: times[:: kept.step] for name, times in clocks.items()},
            }
        ),
        initial_points=scene.initial_points(),
        container_masks={name: mask for name in names if (mask := scene.container_mask(name)) is not None},
    )
    if meta.container_mesh is not None:
        copy_mesh(scene.directory, directory, meta.container_mesh)
    write_model(directory / _FILE, Between(scene=str(scene.directory.resolve()), every=every))

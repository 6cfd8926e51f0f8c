"""The copy of a scene that a method's process is given: no test image, no test mask and no true particle is in it.

It is in the released layout, whatever the scene's own. Files of that layout are linked; NeuroFluid's are written anew,
since there one file holds colours and mask. Poses, sizes and times of test views are there, since a method renders
them. Where timesteps are withheld, to see how a method interpolates, the copy is of the others alone.
"""

from __future__ import annotations

import shutil
from collections.abc import Sequence
from pathlib import Path

from splashbench.files import read_json, write_json, write_model, write_png
from splashbench.scene import Scene, SceneMeta, write_scene
from splashbench.scene.container import mesh_path
from splashbench.scene.layout import plain_name
from splashbench.scene.source import RELEASED_FILES, ReleasedSource
from splashbench.scene.writer import to_gray


def make_training_copy(scene: Scene, directory: Path, kept: Sequence[int] | None = None) -> Path:
    """Write the training copy of `scene` into `directory` (made here) and return it.

    kept: the timesteps that it has, in order; all of them by default.
    """
    directory = Path(directory)
    directory.mkdir(parents=True)
    kept = range(scene.n_frames) if kept is None else kept
    meta = _shown_meta(scene, kept)
    if scene.layout == ReleasedSource.layout:
        for name in RELEASED_FILES:
            if len(kept) == scene.n_frames:
                shutil.copyfile(scene.directory / name, directory / name)
            else:
                split = read_json(scene.directory / name)
                write_json(directory / name, split | {key: [split[key][t] for t in kept] for key in ("k", "w2c", "fn")})
        for camera in scene.train:
            for t in kept:
                image, mask = scene.image_path(camera, t), scene.mask_path(camera, t)
                _link(image, directory / image.relative_to(scene.directory))
                if camera in scene.unmasked:
                    # Who reads the folder without splashbench finds masks where they belong.
                    write_png(directory / mask.relative_to(scene.directory), to_gray(scene.mask(camera, t)))
                else:
                    _link(mask, directory / mask.relative_to(scene.directory))
        write_model(directory / "scene.json", meta)
    else:
        pairs = ((camera, i, t) for camera in scene.train for i, t in enumerate(kept))
        write_scene(
            directory,
            cameras=scene.cameras,
            train=scene.train,
            test=scene.test,
            n_frames=len(kept),
            frames=((camera, i, scene.image(camera, t), scene.mask(camera, t)) for camera, i, t in pairs),
            meta=meta,
            shown=scene.train,
        )
    _link_extras(scene, directory)
    return directory


def _shown_meta(scene: Scene, kept: Sequence[int]) -> SceneMeta:
    """scene.json for a method, on the timesteps `kept`: nothing of where the scene came from."""
    meta = scene.meta or SceneMeta(name=plain_name(scene.name))
    if meta.container_mesh is not None:
        # Under a name of its own: synthetic scenes keep it beside the truth, which a method is not shown.
        suffix = mesh_path(scene.directory, meta.container_mesh).suffix.lower()
        meta = meta.model_copy(update={"container_mesh": f"container{suffix}"})
    sizes = {name: (camera.width, camera.height) for name, camera in scene.cameras.items()}
    complete = len(kept) == scene.n_frames
    times = scene.times[list(kept)].tolist() if scene.times_source != "nominal" or not complete else None
    camera_times = meta.camera_times and {name: [values[t] for t in kept] for name, values in meta.camera_times.items()}
    return meta.model_copy(update={"sizes": sizes, "times": times, "camera_times": camera_times, "provenance": {}})


def _link_extras(scene: Scene, directory: Path) -> None:
    """Link what a scene may have besides images and masks of the training views."""
    points = scene.directory / "init_pt_cld.npz"
    if points.is_file():
        _link(points, directory / points.name)
    for camera in scene.train:
        container = scene.directory / "container_mask" / f"{camera}.png"
        if container.is_file():
            _link(container, directory / container.relative_to(scene.directory))
    if scene.meta is not None and scene.meta.container_mesh is not None:
        mesh = mesh_path(scene.directory, scene.meta.container_mesh)
        if mesh.is_file():
            _link(mesh, directory / f"container{mesh.suffix.lower()}")


def _link(source: Path, target: Path) -> None:
    target.parent.mkdir(parents=True, exist_ok=True)
    target.symlink_to(source.resolve())

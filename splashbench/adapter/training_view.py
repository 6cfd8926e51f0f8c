"""The copy of a scene that a method's process is given: no test image, no test mask and no true particle is in it.

It is in the released layout, whatever the scene's own. Files of that layout are linked; NeuroFluid's are written
anew, since there one file holds colours and mask. Poses, sizes and times of test views are there, since a method
renders them.
"""

from __future__ import annotations

import shutil
from pathlib import Path

from splashbench.files import write_model
from splashbench.scene import Scene, SceneMeta, write_scene
from splashbench.scene.container import mesh_path
from splashbench.scene.layout import plain_name
from splashbench.scene.source import RELEASED_FILES, ReleasedSource


def make_training_view(scene: Scene, directory: Path) -> Path:
    """Write the training view of `scene` into `directory` (made here) and return it."""
    directory = Path(directory)
    directory.mkdir(parents=True)
    meta = _shown_meta(scene)
    if scene.layout == ReleasedSource.layout:
        for name in RELEASED_FILES:
            shutil.copyfile(scene.directory / name, directory / name)
        for camera in scene.train:
            for t in range(scene.n_frames):
                for path in (scene.image_path(camera, t), scene.mask_path(camera, t)):
                    _link(path, directory / path.relative_to(scene.directory))
        write_model(directory / "scene.json", meta)
    else:
        pairs = ((camera, t) for camera in scene.train for t in range(scene.n_frames))
        write_scene(
            directory,
            cameras=scene.cameras,
            train=scene.train,
            test=scene.test,
            n_frames=scene.n_frames,
            frames=((camera, t, scene.image(camera, t), scene.mask(camera, t)) for camera, t in pairs),
            meta=meta,
            shown=scene.train,
        )
    _link_extras(scene, directory)
    return directory


def _shown_meta(scene: Scene) -> SceneMeta:
    """What a method is told of `scene`: nothing of where it came from."""
    meta = scene.meta or SceneMeta(name=plain_name(scene.name))
    if meta.container_mesh is not None:
        # Under a name of its own: made-up scenes keep it beside the truth, which a method is not shown.
        suffix = mesh_path(scene.directory, meta.container_mesh).suffix.lower()
        meta = meta.model_copy(update={"container_mesh": f"container{suffix}"})
    sizes = {name: (camera.width, camera.height) for name, camera in scene.cameras.items()}
    times = scene.times.tolist() if scene.times_source != "nominal" else None
    return meta.model_copy(update={"sizes": sizes, "times": times, "provenance": {}})


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

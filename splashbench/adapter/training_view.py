"""The copy of a scene that a method's process is given: no test image and no test mask is in it.

Files are linked, not copied. Poses, sizes and times of test views are there, since a method renders them.
"""

from __future__ import annotations

import shutil
from pathlib import Path

from splashbench.files import write_model
from splashbench.scene import Scene, SceneMeta
from splashbench.scene.container import mesh_path


def make_training_view(scene: Scene, directory: Path) -> Path:
    """Write the training view of `scene` into `directory` (made here) and return it."""
    directory = Path(directory)
    directory.mkdir(parents=True)
    for name in ("train_meta.json", "test_meta.json"):
        shutil.copyfile(scene.directory / name, directory / name)
    points = scene.directory / "init_pt_cld.npz"
    if points.is_file():
        _link(points, directory / points.name)
    for camera in scene.train:
        for t in range(scene.n_frames):
            for path in (scene.image_path(camera, t), scene.mask_path(camera, t)):
                _link(path, directory / path.relative_to(scene.directory))
        container = scene.directory / "container_mask" / f"{camera}.png"
        if container.is_file():
            _link(container, directory / container.relative_to(scene.directory))
    meta = scene.meta or SceneMeta(name=scene.name, times=None)
    if meta.container_mesh is not None:
        mesh = mesh_path(scene.directory, meta.container_mesh)
        # Under a name of its own: made-up scenes keep it beside the truth, which a method is not shown.
        meta = meta.model_copy(update={"container_mesh": f"container{mesh.suffix.lower()}"})
        if mesh.is_file():
            _link(mesh, directory / f"container{mesh.suffix.lower()}")
    sizes = {name: (camera.width, camera.height) for name, camera in scene.cameras.items()}
    times = scene.times.tolist() if scene.times_source != "nominal" else None
    write_model(directory / "scene.json", meta.model_copy(update={"sizes": sizes, "times": times, "provenance": {}}))
    return directory


def _link(source: Path, target: Path) -> None:
    target.parent.mkdir(parents=True, exist_ok=True)
    target.symlink_to(source.resolve())

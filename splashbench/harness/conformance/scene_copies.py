"""The scenes of a conformance test: a copy that the method may spoil, and copies with something taken away."""

from __future__ import annotations

import os
import shutil
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from splashbench.files import read_json, sha256_file, write_json, write_model, write_png
from splashbench.harness.training_copy import make_training_copy
from splashbench.scene import Scene

#: In place of every file that a method is not shown: an opening of it is noticed.
_BAIT = b"This is a test view, which no method may read.\n"
_METAS = ("train_meta.json", "test_meta.json", "scene.json")


@dataclass(frozen=True)
class SceneCopy:
    """A scene, its training copy, and the files of the scene that were made unreadable; all resolved."""

    scene: Path
    training: Path
    baits: tuple[Path, ...] = ()

    def contents(self) -> dict[str, str]:
        """Path -> SHA-256 of every file of the scene, and of what lies in the training copy."""
        digests = {}
        for folder in (self.scene, self.training):
            for root, folders, names in os.walk(folder):
                folders.sort()
                for name in sorted(names):
                    path = Path(root, name)
                    key = f"{folder.name}/{path.relative_to(folder).as_posix()}"
                    digests[key] = sha256_file(path) if path.is_file() else "no file"
        return digests


def copy_scene(source: Path, parent: Path) -> Path:
    """A copy of the scene `source` in the folder `parent`."""
    # The folder keeps its name: without scene.json it decides what a scene is (Table S1).
    return Path(shutil.copytree(source, parent / source.resolve().name))


def ordinary(scene: Path, parent: Path) -> SceneCopy:
    """`scene` as it is, its training copy in `parent`."""
    return SceneCopy(scene.resolve(), make_training_copy(Scene.open(scene), parent / "training").resolve())


def hidden(scene: Path, parent: Path) -> SceneCopy:
    """`scene` with every file that its training copy does not lead to made unreadable: test images, masks, truth."""
    copy = ordinary(scene, parent)
    shown = {os.path.realpath(path) for path in _files(copy.training)} | {str(copy.scene / name) for name in _METAS}
    baits = [path for path in _files(copy.scene) if os.path.realpath(path) not in shown]
    for path in baits:
        path.unlink()  # first, as it may be a link
        path.write_bytes(_BAIT)
    return SceneCopy(copy.scene, copy.training, tuple(baits))


def _files(folder: Path) -> list[Path]:
    return sorted(Path(root, name) for root, _, names in os.walk(folder) for name in names)


def keep_first_frame(scene: Path) -> None:
    """Leave `scene` one timestep, the first."""
    meta = Scene.open(scene).meta
    for name in ("train_meta.json", "test_meta.json"):
        split = read_json(scene / name)
        write_json(scene / name, split | {key: split[key][:1] for key in ("k", "w2c", "fn")})
    if meta is not None:
        times = meta.times[:1] if meta.times else None
        camera_times = meta.camera_times and {name: times[:1] for name, times in meta.camera_times.items()}
        write_model(
            scene / "scene.json", meta.model_copy(update={"times": times, "camera_times": camera_times or None})
        )


def empty_masks(scene: Path) -> None:
    """Take the liquid out of every mask of `scene`."""
    opened = Scene.open(scene)
    for name, camera in opened.cameras.items():
        for t in range(opened.n_frames):
            write_png(opened.mask_path(name, t), np.zeros((camera.height, camera.width), np.uint8))

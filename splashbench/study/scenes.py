"""The scene of a run: the scene itself, or a copy with worse training views or fewer of them.

A copy shares all unchanged files with its scene, by hard links where the disk allows them. Test views never change.
"""

from __future__ import annotations

import hashlib
import json
import os
import shutil
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from filelock import FileLock
from numpy.typing import NDArray

from splashbench.errors import SplashbenchError
from splashbench.files import atomic_directory, read_json, write_json, write_model, write_png
from splashbench.scene import Camera, Scene, SceneMeta, write_scene
from splashbench.scene.container import mesh_path
from splashbench.scene.layout import plain_name
from splashbench.scene.source import ReleasedSource
from splashbench.study.perturbations import Dice, Recording, perturbed
from splashbench.study.spec import StudyVariant
from splashbench.study.thinning import recorded
from splashbench.study.view_subsets import nested_views

#: Raised when a change alters the copies that the same description gives.
_VERSION = 1


def changes(scene: Scene, variant: StudyVariant, seed: int) -> dict[str, Any] | None:
    """How the scene of a run of `variant` differs from `scene`, as JSON; None where it does not.

    Raises SplashbenchError where the scene cannot be changed so.
    """
    changed: dict[str, Any] = {}
    if variant.train_views is not None:
        views = variant.train_views
        train = nested_views(scene, views) if isinstance(views, int) else _named_views(scene, views)
        if train != scene.train:
            changed["train_views"] = list(train)
    if variant.harm:
        changed |= {"masks": [step.model_dump() for step in variant.harm], "seed": seed}
    return changed | {"version": _VERSION} if changed else None


def _named_views(scene: Scene, names: tuple[str, ...]) -> tuple[str, ...]:
    for name in names:
        if name not in scene.train:
            raise SplashbenchError(f"{scene.directory} has no training view {name!r}; it has {', '.join(scene.train)}")
    if len(set(names)) < 2:
        raise SplashbenchError(f"{scene.directory}: train_views keeps {len(set(names))} view; keep two or more")
    return tuple(name for name in scene.train if name in names)


def changed_scene(scene: Scene, variant: StudyVariant, seed: int, cache: Path) -> Scene:
    """`scene`, or the copy of it that `variant` asks for, made in the folder `cache` where it does not exist yet."""
    changed = changes(scene, variant, seed)
    if changed is None:
        return scene
    # What is stated besides may come later, and the digest says nothing of it.
    text = json.dumps([scene.digest, changed, scene.stated], sort_keys=True)
    # The folder keeps its name: without scene.json it decides what a scene is (Table S1).
    place = cache / hashlib.sha256(text.encode()).hexdigest()[:16] / scene.directory.resolve().name
    place.parent.parent.mkdir(parents=True, exist_ok=True)
    with FileLock(place.parent.with_suffix(".lock")):
        if not place.exists():
            with atomic_directory(place) as staging:
                train = changed.get("train_views", list(scene.train))
                if not variant.harm:
                    _copy(scene, train, staging)
                else:
                    recording = recording_of(scene, train)
                    worse = perturbed(recording, variant.harm, Dice(seed, scene.name))
                    _copy(scene, list(worse.views), staging)
                    _perturb(Scene.open(staging), scene, recording, worse)
    return Scene.open(place)


def _copy(scene: Scene, train: list[str], directory: Path) -> None:
    """A copy of `scene` with the training views `train` only, in the released layout."""
    cameras = [*train, *scene.test]
    if scene.layout != ReleasedSource.layout:
        _convert(scene, train, cameras, directory)
        return
    left_out = set(scene.cameras) - set(cameras)
    for root, folders, names in os.walk(scene.directory):
        folders.sort()
        for name in names:
            path = Path(root, name).relative_to(scene.directory)
            if path.parts[0] in ("ims", "seg", "container_mask") and Path(path.parts[1]).stem in left_out:
                continue
            _link(scene.directory / path, directory / path)
    columns = [scene.train.index(name) for name in train]
    meta = read_json(scene.directory / "train_meta.json")
    for key in ("k", "w2c", "fn"):
        meta[key] = [[row[column] for column in columns] for row in meta[key]]
    # Written as new files: writing through a link would change the original scene.
    write_json(directory / "train_meta.json", meta)
    if scene.meta is not None:
        write_model(directory / "scene.json", _meta_of(scene.meta, cameras))


def _meta_of(meta: SceneMeta, names: list[str]) -> SceneMeta:
    """`meta` with the entries of the cameras `names` alone."""
    subsets = {
        key: {name: value for name, value in entries.items() if name in names}
        for key in ("sizes", "camera_times")
        if (entries := getattr(meta, key)) is not None
    }
    return meta.model_copy(update=subsets)


def _convert(scene: Scene, train: list[str], names: list[str], directory: Path) -> None:
    """Write what `_copy` links, of a scene in another layout."""
    pairs = ((name, t) for name in names for t in range(scene.n_frames))
    write_scene(
        directory,
        cameras={name: scene.cameras[name] for name in names},
        train=train,
        test=scene.test,
        n_frames=scene.n_frames,
        frames=((name, t, scene.image(name, t), scene.mask(name, t)) for name, t in pairs),
        meta=_meta_of(scene.meta or SceneMeta(name=plain_name(scene.name)), names),
        initial_points=scene.initial_points(),
    )
    if scene.meta is not None and scene.meta.container_mesh is not None:
        _link(mesh_path(scene.directory, scene.meta.container_mesh), directory / scene.meta.container_mesh)
    true = scene.truth_particles()
    if true is not None:
        true.save(directory / "truth" / "particles.npz")


def _link(source: Path, target: Path) -> None:
    target.parent.mkdir(parents=True, exist_ok=True)
    try:
        os.link(source.resolve(), target)
    except OSError:  # another disk, or one without links
        shutil.copyfile(source, target)


def _perturb(copy: Scene, scene: Scene, recording: Recording, worse: Recording) -> None:
    """Replace what the training views of `copy`, those of `worse`, are told and shown by what `worse` has.

    recording: shows `scene` as it is; what `worse` shares with it stays.
    """
    if worse.cameras is not recording.cameras:
        _write_cameras(copy, worse.cameras)
    _write_setup(copy, recording, worse)
    paths: dict[tuple[str, int], str] = {}
    for name in copy.train:
        for t in range(scene.n_frames):
            # Nothing is decoded that no step changes.
            if worse.mask is not recording.mask:
                mask = worse.mask(name, t)
                if name in scene.unmasked or not np.array_equal(mask, scene.mask(name, t)):
                    write_png(copy.mask_path(name, t), np.where(mask, 255, 0).astype(np.uint8))
            if worse.image is recording.image:
                continue
            image = worse.image(name, t)
            if not np.array_equal(image, scene.image(name, t)):
                # Losslessly, whatever the original was.
                path = copy.image_path(name, t)
                path.unlink()
                write_png(path.with_suffix(".png"), image)
                paths[name, t] = f"{name}/{path.with_suffix('.png').name}"
        container, as_it_was = worse.container_mask(name), scene.container_mask(name)
        if container is not None and as_it_was is not None and not np.array_equal(container, as_it_was):
            path = copy.directory / "container_mask" / f"{name}.png"
            path.unlink()
            write_png(path, np.where(container, 255, 0).astype(np.uint8))
    if paths:
        _rename(copy, paths)


def recording_of(scene: Scene, views: Sequence[str] | None = None) -> Recording:
    """The `views` of `scene` (all training views by default), with what was recorded between its timesteps."""
    whole, every = recorded(scene)

    def frame(t: float) -> int:
        return min(round(t * every), whole.n_frames - 1)

    return Recording(
        {name: scene.cameras[name] for name in (scene.train if views is None else views)},
        scene.n_frames,
        float(np.median(np.diff(scene.times))) if scene.n_frames > 1 else 1.0,
        image=lambda name, t: whole.image(name, frame(t)),
        mask=lambda name, t: whole.mask(name, frame(t)),
        finest=1 / every,
        metres_per_unit=None if scene.meta is None else scene.meta.metres_per_unit,
        container_mask=scene.container_mask,
        gravity=scene.gravity,
        container_pose=_container_pose(scene),
    )


def _container_pose(scene: Scene) -> NDArray[np.float64] | None:
    """Mesh to scene, 4x4; None where there is no mesh."""
    if scene.meta is None or scene.meta.container_mesh is None:
        return None
    pose = scene.meta.container_pose
    return np.eye(4) if pose is None else np.array(pose, dtype=np.float64)


def _write_setup(copy: Scene, recording: Recording, worse: Recording) -> None:
    """What scene.json states of gravity and the container's place."""
    stated = {
        key: getattr(worse, key).tolist()
        for key in ("gravity", "container_pose")
        if getattr(worse, key) is not getattr(recording, key)
    }
    if stated and copy.meta is not None:
        path = copy.directory / "scene.json"
        path.unlink()  # it may be a link to the scene's own
        write_model(path, SceneMeta.model_validate(copy.meta.model_dump() | stated))


def _write_cameras(copy: Scene, cameras: Mapping[str, Camera]) -> None:
    meta = read_json(copy.directory / "train_meta.json")
    for key, of in (("k", "K"), ("w2c", "w2c")):
        meta[key] = [[getattr(cameras[name], of).tolist() for name in copy.train]] * copy.n_frames
    write_json(copy.directory / "train_meta.json", meta)


def _rename(copy: Scene, paths: Mapping[tuple[str, int], str]) -> None:
    meta = read_json(copy.directory / "train_meta.json")
    for (name, t), path in paths.items():
        meta["fn"][t][copy.train.index(name)] = path
    write_json(copy.directory / "train_meta.json", meta)

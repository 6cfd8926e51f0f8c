"""NeuroFluid's synthetic scenes (Guan et al., ICML 2022) as downloaded: WaterSphere, WaterCube, HoneyCone.

A folder per view with Blender's cameras and RGBA frames, and the simulation's particles beside them
(docs/scene_format.md, "NeuroFluid"). Alpha is the liquid's silhouette; the colours are those over white. The file
that `bounding_box` names is a pickle, and is never opened.
"""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from splashbench.errors import SplashbenchError
from splashbench.files import MAX_NPZ_BYTES, image_size, read_npz, read_rgba
from splashbench.progress import track
from splashbench.scene.layout import LARGEST, SceneMeta, plain_name
from splashbench.scene.particles import Particles
from splashbench.scene.source import META_FILE, RELEASED_FILES, SceneSource
from splashbench.scene.transforms import (
    Transforms,
    TransformsFrame,
    intrinsics,
    read_transforms,
    shared_frames,
    world_to_camera,
)

#: The simulation was written out 50 times a second, the interval of NeuroFluid's own transition model as well.
STEP_SECONDS = 1 / 50
#: z points up, and free fall is 9.81 units per second squared: the unit is a metre.
GRAVITY = (0.0, 0.0, -1.0)
METRES_PER_UNIT = 1.0
PARTICLE_RADIUS = 0.025  # scene units

_VIEW = re.compile(r"view_(\d{1,6})", re.ASCII)
# Two files of one state of the simulation agree to this, scene units.
_SAME_STATE = 1e-3
# How far the motion that the velocities tell may be from that between two frames: they change over a step.
_MOTION_TOLERANCE = 0.1


def is_neurofluid(directory: Path) -> bool:
    """Whether the folder `directory` has NeuroFluid's layout, as opposed to the released one."""
    if any((directory / name).exists() for name in RELEASED_FILES):
        return False
    return any(any((directory / view).glob("transforms_*.json")) for view in _view_folders(directory))


def _view_folders(directory: Path) -> list[str]:
    """Names of the folders view_1, view_2, ... in order of their numbers."""
    folders = [(int(match[1]), path.name) for path in directory.iterdir() if (match := _VIEW.fullmatch(path.name))]
    return [name for _, name in sorted(folders) if (directory / name).is_dir()]


@dataclass
class ViewSplit:
    """The training or the test views, a `source.Split`; all paths are relative to the scene's folder.

    particles: view -> path of the true particles of each frame; empty where the file names none. sizes: view -> (width,
    height).
    """

    names: tuple[str, ...]
    K: NDArray[np.float64]
    w2c: NDArray[np.float64]
    paths: dict[str, list[str]]
    n_frames: int
    particles: dict[str, list[str]]
    sizes: dict[str, tuple[int, int]]

    @classmethod
    def of(
        cls, directory: Path, split: str, views: dict[str, Transforms], frames: dict[str, list[TransformsFrame]]
    ) -> ViewSplit:
        """The `views` of `split` ("train" or "test"), with the frames chosen for each."""
        paths = {name: [f"{name}/{frame.file_path}.png" for frame in frames[name]] for name in views}
        sizes = {name: image_size(directory / paths[name][0]) for name in views}
        file = {name: directory / name / f"transforms_{split}.json" for name in views}
        return cls(
            names=tuple(views),
            K=np.stack([intrinsics(file[name], view.camera_angle_x, sizes[name]) for name, view in views.items()]),
            w2c=np.stack([world_to_camera(file[name], frames[name]) for name in views]),
            paths=paths,
            n_frames=len(next(iter(paths.values()))),
            particles={name: _particle_paths(f"{name}/{split}", frames[name]) for name in views},
            sizes=sizes,
        )


def _particle_paths(folder: str, frames: list[TransformsFrame]) -> list[str]:
    paths = [f"{folder}/{frame.particle_path}" for frame in frames if frame.particle_path is not None]
    return paths if len(paths) == len(frames) else []


class NeuroFluidSource(SceneSource):
    """A scene of NeuroFluid: the last view is the test view, every other one trains.

    Its timesteps are the frames that all views have.
    """

    layout = "neurofluid"
    meta: SceneMeta
    train: ViewSplit
    test: ViewSplit

    def __init__(self, directory: Path) -> None:
        self.directory = directory
        *train, test = _view_folders(directory)
        if not train:
            raise SplashbenchError(f"{directory} has the view {test} alone; a scene has view_1 to view_5")
        self._files = [directory / name / "transforms_train.json" for name in train]
        self._files.append(directory / test / "transforms_test.json")
        views = {path.parent.name: read_transforms(path) for path in self._files}
        self._numbers, frames = shared_frames(views)
        if not self._numbers:
            raise SplashbenchError(f"{directory}: no frame is in all of {', '.join(views)}; restore the files")
        self.train = ViewSplit.of(directory, "train", {name: views[name] for name in train}, frames)
        self.test = ViewSplit.of(directory, "test", {test: views[test]}, frames)
        self._paths = self.train.paths | self.test.paths
        self._particles = self.test.particles | self.train.particles
        self.meta = self._described()
        self.name = self.meta.name

    def _described(self) -> SceneMeta:
        """What is known of these scenes; a scene.json in the folder goes before it, field by field."""
        defaults = SceneMeta(
            name=plain_name(self.directory.resolve().name),
            times=[(number - self._numbers[0]) * STEP_SECONDS for number in self._numbers],
            sizes=self.train.sizes | self.test.sizes,
            metres_per_unit=METRES_PER_UNIT,
            gravity=GRAVITY,
            provenance={"dataset": "NeuroFluid", "particle_radius": PARTICLE_RADIUS},
        )
        stated = self._read_meta()
        changes = {field: getattr(stated, field) for field in stated.model_fields_set} if stated else {}
        if "times" not in changes:
            self.times_source = self.layout
        changes["provenance"] = defaults.provenance | changes.get("provenance", {})
        return defaults.model_copy(update=changes)

    def image_path(self, camera: str, t: int) -> Path:
        return self.directory / self._paths[camera][t]

    def mask_path(self, camera: str, t: int) -> Path:
        return self.image_path(camera, t)

    def image(self, camera: str, t: int) -> NDArray[np.uint8]:
        rgba = read_rgba(self.image_path(camera, t)).astype(np.uint32)
        colour, alpha = rgba[..., :3], rgba[..., 3:]
        over_white = (colour * alpha + 255 * (255 - alpha) + 127) // 255
        return over_white.astype(np.uint8)

    def mask(self, camera: str, t: int) -> NDArray[np.bool_]:
        return read_rgba(self.image_path(camera, t))[..., 3] > 127

    def calibration_files(self) -> list[Path]:
        meta = self.directory / META_FILE
        return [*self._files, *([meta] if meta.is_file() else [])]

    def truth_files(self) -> list[Path]:
        """Those of the test view, else of the first view that has some: the simulation is the same."""
        for view in self._particles:
            files = self._particle_files(view)
            if files and files[0].is_file():
                return files
        return []

    def _particle_files(self, view: str) -> list[Path]:
        return [self.directory / path for path in self._particles[view]]

    def truth_particles(self) -> Particles:
        files = self.truth_files()
        states = [self._state(path) for path in files]
        for path, (positions, _) in zip(files, states):
            if len(positions) != len(states[0][0]):
                raise SplashbenchError(
                    f"{path} has {len(positions)} particles, {files[0].name} {len(states[0][0])}; restore the file"
                )
        velocities = [velocity for _, velocity in states if velocity is not None]
        positions = np.stack([positions for positions, _ in states])
        moving = np.stack(velocities) if len(velocities) == len(states) else None
        return Particles(positions, np.ones(positions.shape[:2], dtype=bool), moving)

    def _state(self, path: Path) -> tuple[NDArray[np.float32], NDArray[np.float32] | None]:
        """Positions [N, 3], and velocities [N, 3] or None where the file has none."""
        limit = MAX_NPZ_BYTES // len(self._numbers)
        arrays = read_npz(path, {"pos": 2}, optional={"vel": 2}, max_bytes=limit)
        for name, array in arrays.items():
            if array.shape != (len(arrays["pos"]), 3):
                raise SplashbenchError(f"{path}: {name} is {array.shape}, not [N, 3] as pos; restore the file")
            if np.abs(array).max(initial=0.0) > LARGEST:
                raise SplashbenchError(f"{path}: {name} has entries beyond {LARGEST:g}; restore the file")
        velocities = arrays.get("vel")
        return arrays["pos"].astype(np.float32), None if velocities is None else velocities.astype(np.float32)

    def faults(self) -> list[str]:
        """Faults: views of different instants, by their particles, and times that contradict the velocities."""
        try:
            true = self.truth_particles() if self.truth_files() else None
        except SplashbenchError:
            true = None  # a fault of its own
        if true is None:
            return []
        views = track(list(self._particles), "comparing the views")
        return [fault for view in views if (fault := self._other_instants(view, true))] + self._other_times(true)

    def _other_instants(self, view: str, true: Particles) -> str | None:
        files = self._particle_files(view)
        if not files or not files[0].is_file() or files == self.truth_files():
            return None
        for t, path in enumerate(files):
            try:
                positions, _ = self._state(path)
            except SplashbenchError as error:
                return str(error)
            of = true.positions[t]
            if positions.shape != of.shape or np.abs(positions - of).max(initial=0.0) > _SAME_STATE:
                return (
                    f"{path} and {self.truth_files()[t]} hold other particles, so their views show different instants; "
                    "restore the files"
                )
        return None

    def _other_times(self, true: Particles) -> list[str]:
        times = self.meta.times  # null where scene.json says so
        if times is None or len(times) < 2 or true.velocities is None or not true.count:
            return []
        steps = np.diff(times)
        moved = np.diff(true.positions.astype(np.float64), axis=0)
        expected = (true.velocities[1:] + true.velocities[:-1]).astype(np.float64) / 2 * steps[:, None, None]
        if np.square(expected).sum(axis=-1).mean() < (PARTICLE_RADIUS / 10) ** 2:
            return []  # at rest, which tells nothing
        share = float((moved * expected).sum() / np.square(expected).sum())
        if abs(share - 1) <= _MOTION_TOLERANCE:
            return []
        return [
            f"{self.directory}: between frames the true particles move {share:.3g} times as far as their velocities "
            f"tell; state the true times in {META_FILE}"
        ]

"""A scene: synchronised images and liquid masks of calibrated, fixed cameras, with a training and a test split.

`Scene.open` reads the released layout, with or without scene.json, and NeuroFluid's (docs/scene_format.md). Images are
read when asked for, never all at once. `TrainingScene` is what a method sees: training views, of test views the poses.
"""

from __future__ import annotations

import hashlib
import json
from functools import cached_property
from pathlib import Path
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from splashbench.errors import SplashbenchError
from splashbench.files import image_size, read_gray, read_npz, sha256_file
from splashbench.scene.camera import Camera
from splashbench.scene.container import ContainerMesh, mesh_path, read_mesh
from splashbench.scene.kept_pictures import KeptPictures
from splashbench.scene.layout import LARGEST
from splashbench.scene.neurofluid import NeuroFluidSource, is_neurofluid
from splashbench.scene.particles import Particles
from splashbench.scene.source import ReleasedSource, SceneSource

Pixels = TypeVar("Pixels", NDArray[np.uint8], NDArray[np.bool_])

# Without timestamps a scene still has an order; metrics that need seconds look at `times_source`.
NOMINAL_STEP_SECONDS = 1 / 30
# Of the static points, unpacked: 19 million in double precision.
_MAX_POINTS_BYTES = 1 << 30
# Of points' colours, which are in [0, 1] but for what a fit of them overshoots.
_MOST_COLOUR = 2.0
# Cameras' own times lie within a recording's duration of the timesteps', and within this of those of a short one.
_LEAST_REACH_SECONDS = 1.0


class Scene:
    """A scene on disk. Use `Scene.open`.

    Attributes:
        directory, name: folder and name. layout: "released" or "neurofluid", that of its files.
        cameras: name -> Camera, training cameras first.
        train, test: camera names of the split.
        frames: file stems of the timesteps, such as "000000".
        times: [T] seconds; times_source says whether they come from "scene.json", the "manifest" (Table S1), follow
            from "neurofluid"'s fixed interval, or are "nominal".
        camera_times: camera name -> [T] seconds, each camera's own where known, else `times`.
        gravity: unit vector [3] along which things fall, or None. metres_per_unit: metric scale, or None.
        unmasked: cameras that have no masks at all. Those of training cameras count as empty, those of test cameras
            are an error once they are asked for.
        container_transparent: whether the liquid is seen through the container's walls, or None where unknown.
        is_released: whether this is one of the 20 released scenes, in the release's units.
    """

    def __init__(self, source: SceneSource) -> None:
        self._source = source
        self.directory, self.layout = source.directory, source.layout
        self.name, self.meta = source.name, source.meta
        self.unmasked = source.unmasked
        train, test = source.train, source.test
        self.train, self.test = train.names, test.names
        self.frames = tuple(Path(path).stem for path in train.paths[train.names[0]])
        self.n_frames = len(self.frames)
        self.cameras: dict[str, Camera] = {}
        for split in (train, test):
            for c, name in enumerate(split.names):
                width, height = self._size(name)
                try:
                    self.cameras[name] = Camera(name, width, height, split.K[c], split.w2c[c])
                except ValueError as error:
                    raise SplashbenchError(f"{self.directory}: {error}; fix the calibration") from None
        self._set_times()
        meta = self.meta
        self.gravity = np.array(meta.gravity) if meta and meta.gravity else None
        self.metres_per_unit = meta.metres_per_unit if meta else None
        self.container_transparent = meta.container_transparent if meta else None

    @classmethod
    def open(cls, directory: Path) -> Scene:
        """Read the scene in `directory`. Raises SplashbenchError naming the first file at fault."""
        directory = Path(directory)
        if not directory.is_dir():
            raise SplashbenchError(f"{directory} is not a folder; give the folder of a scene")
        return cls(NeuroFluidSource(directory) if is_neurofluid(directory) else ReleasedSource(directory))

    def __repr__(self) -> str:
        first = self.cameras[self.train[0]]
        seconds = f"{self.times[-1] - self.times[0]:.3g} s ({self.times_source})"
        cameras = f"{len(self.train)} training and {len(self.test)} test cameras of {first.width}x{first.height}"
        return f"<Scene {self.name}: {self.n_frames} timesteps in {seconds}, {cameras}>"

    def _size(self, camera: str) -> tuple[int, int]:
        if self.meta and self.meta.sizes and camera in self.meta.sizes:
            return self.meta.sizes[camera]
        return image_size(self.image_path(camera, 0))

    def _set_times(self) -> None:
        from splashbench.manifest import load_scenes

        facts = load_scenes().get(self.name)
        # A scene.json that only adds what the release lacks (gravity, say) changes no units; a made one has a maker.
        self.is_released = facts is not None and not (self.meta and self.meta.provenance)
        if self.meta and self.meta.times is not None:
            self.times: NDArray[np.float64] = self._checked_times("times", self.meta.times)
            self.times_source = self._source.times_source
        elif facts is not None:
            self.times = np.asarray(facts.times(self.n_frames), dtype=np.float64)
            self.times_source = "manifest"
        else:
            self.times = np.arange(self.n_frames, dtype=np.float64) * NOMINAL_STEP_SECONDS
            self.times_source = "nominal"
        camera_times = (self.meta.camera_times if self.meta else None) or {}
        for key, entries in (("camera_times", camera_times), ("sizes", (self.meta.sizes if self.meta else None) or {})):
            unknown = sorted(set(entries) - set(self.cameras))
            if unknown:
                raise SplashbenchError(
                    f"{self.directory / 'scene.json'}: {key} names camera {unknown[0]}, which the scene does not have; "
                    "fix the entry"
                )
        reach = max(float(self.times[-1] - self.times[0]), _LEAST_REACH_SECONDS)
        for name, times in camera_times.items():
            if times and (times[0] < self.times[0] - reach or times[-1] > self.times[-1] + reach):
                raise SplashbenchError(
                    f"{self.directory / 'scene.json'}: camera_times of {name} are {times[0]:g} to {times[-1]:g}, and "
                    f"times {self.times[0]:g} to {self.times[-1]:g}; give both in seconds of one clock"
                )
        self.camera_times = {
            name: self._checked_times(f"camera_times of {name}", camera_times[name])
            if name in camera_times
            else self.times
            for name in self.cameras
        }

    def _checked_times(self, what: str, values: list[float]) -> NDArray[np.float64]:
        if len(values) != self.n_frames:
            raise SplashbenchError(
                f"{self.directory / 'scene.json'}: {what} has {len(values)} entries for {self.n_frames} frames; "
                "give one time per frame"
            )
        return np.asarray(values, dtype=np.float64)

    def image_path(self, camera: str, t: int) -> Path:
        """The image file of `camera` at timestep `t`."""
        return self._source.image_path(camera, t)

    def mask_path(self, camera: str, t: int) -> Path:
        """The file with the liquid mask of `camera` at timestep `t`; in NeuroFluid's layout it is the image's."""
        return self._source.mask_path(camera, t)

    def image(self, camera: str, t: int) -> NDArray[np.uint8]:
        """sRGB uint8 [H, W, 3] of `camera` at timestep `t`."""
        return self._sized(camera, self.image_path(camera, t), self._source.image(camera, t))

    def mask(self, camera: str, t: int) -> NDArray[np.bool_]:
        """Liquid mask [H, W] of `camera` at timestep `t`."""
        if camera in self.unmasked and camera in self.test:
            raise SplashbenchError(
                f"{self.mask_path(camera, t).parent} is missing; test views are scored within masks of the "
                "liquid, so put them there"
            )
        if camera in self.unmasked:
            view = self.cameras[camera]
            return np.zeros((view.height, view.width), dtype=bool)
        return self._sized(camera, self.mask_path(camera, t), self._source.mask(camera, t))

    def container_mask(self, camera: str) -> NDArray[np.bool_] | None:
        """Container mask [H, W] of `camera`, or None where the scene has none."""
        path = self.directory / "container_mask" / f"{camera}.png"
        return self._sized(camera, path, read_gray(path) > 127) if path.exists() else None

    def container_mesh(self) -> ContainerMesh | None:
        """The container as a mesh in scene units, or None where the scene has none.

        Raises SplashbenchError when the file is missing, no mesh, or outside the scene's folder, or the pose absurd.
        """
        if self.meta is None or self.meta.container_mesh is None:
            return None
        mesh = read_mesh(mesh_path(self.directory, self.meta.container_mesh))
        pose = self.meta.container_pose
        try:
            return mesh if pose is None else mesh.placed(pose)
        except ValueError as error:
            raise SplashbenchError(
                f"{self.directory / 'scene.json'}: container_pose leaves {error}; place the container again"
            ) from None

    def _sized(self, camera: str, path: Path, array: Pixels) -> Pixels:
        view = self.cameras[camera]
        if array.shape[:2] != (view.height, view.width):
            raise SplashbenchError(
                f"{path} is {array.shape[1]}x{array.shape[0]}, but camera {camera}'s images are "
                f"{view.width}x{view.height}; bring the file to that size"
            )
        return array

    def initial_points(self) -> NDArray[np.float32] | None:
        """Static points [N, 7] as x, y, z (scene units), r, g, b in [0, 1], segment; None where there are none."""
        path = self.directory / "init_pt_cld.npz"
        if not path.exists():
            return None
        data = read_npz(path, {"data": 2}, max_bytes=_MAX_POINTS_BYTES)["data"]
        if data.shape[1] < 6:
            raise SplashbenchError(f"{path}: data has {data.shape[1]} columns, not x y z r g b seg; write it again")
        segment = data[:, 6:7] if data.shape[1] > 6 else np.zeros((len(data), 1))
        with np.errstate(over="ignore"):
            points = np.concatenate([data[:, :6], segment], axis=1).astype(np.float32)
        if not np.abs(points[:, :3]).max(initial=0.0) <= LARGEST:
            raise SplashbenchError(f"{path}: points lie beyond {LARGEST:g} scene units; write it again")
        if not np.abs(points[:, 3:6]).max(initial=0.0) <= _MOST_COLOUR:
            raise SplashbenchError(f"{path}: r, g, b are not in [0, 1]; divide them by 255 where they are 0 to 255")
        return points

    @property
    def stated(self) -> tuple[str, ...]:
        """What the scene tells a method besides images, masks of the liquid and cameras; in a fixed order."""
        masks = [self.directory / "container_mask" / f"{name}.png" for name in self.train]
        has = {
            "times": self.times_source != "nominal",
            "gravity": self.gravity is not None,
            "metric scale": self.metres_per_unit is not None,
            "container mesh": self.meta is not None and self.meta.container_mesh is not None,
            "container masks": any(path.is_file() for path in masks),
            "transparency": self.container_transparent is not None,
            "sparse points": (self.directory / "init_pt_cld.npz").is_file(),
        }
        return tuple(name for name, known in has.items() if known)

    @property
    def has_truth(self) -> bool:
        """Whether it is a synthetic scene whose true particles are known."""
        return bool(self._source.truth_files())

    def truth_particles(self) -> Particles | None:
        """The true particles of a synthetic scene, on the scene's timesteps, or None."""
        return self._source.truth_particles() if self.has_truth else None

    @property
    def truth_digest(self) -> str | None:
        """SHA-256 of the files of the true particles, or None where there are none."""
        return self._source.truth_digest()

    def faults(self) -> list[str]:
        """Contradictions between files that are valid one by one, a line each."""
        return self._source.faults()

    @cached_property
    def digest(self) -> str:
        """SHA-256 over calibration, times and every image and mask: two scenes with one digest score alike.

        Ground-truth particles are left out, so that attaching them does not orphan earlier submissions.
        """
        digest = hashlib.sha256()
        files = self._source.calibration_files()
        for camera in sorted(self.cameras):
            for t in range(self.n_frames):
                files.append(self.image_path(camera, t))
                files += [] if camera in self.unmasked else [self.mask_path(camera, t)]
        for path in dict.fromkeys(files):
            if not path.is_file():
                raise SplashbenchError(f"{path} is missing; restore it, or leave its frame out of the JSON files")
            entry = [path.relative_to(self.directory).as_posix(), sha256_file(path)]
            digest.update(json.dumps(entry).encode())
        # Without scene.json the folder's name decides both of these (Table S1), and both move the metrics.
        digest.update(json.dumps([self.times.tolist(), self.is_released]).encode())
        return digest.hexdigest()

    def training(self) -> TrainingScene:
        """This scene as a method may see it."""
        return TrainingScene(self)


class TrainingScene:
    """A scene as a method sees it: images and masks of training views; of test views only pose, size and times.

    Attributes are those of `Scene`; `cameras` holds the training cameras, `test_cameras` the test ones.
    """

    def __init__(self, scene: Scene) -> None:
        self._scene = scene
        self.name, self.directory = scene.name, scene.directory
        self.train, self.test = scene.train, scene.test
        self.cameras = {name: scene.cameras[name] for name in scene.train}
        self.test_cameras = {name: scene.cameras[name] for name in scene.test}
        self.frames, self.n_frames = scene.frames, scene.n_frames
        self.times, self.times_source, self.camera_times = scene.times, scene.times_source, scene.camera_times
        self.gravity, self.metres_per_unit, self.is_released = (
            scene.gravity,
            scene.metres_per_unit,
            scene.is_released,
        )
        self.container_transparent = scene.container_transparent
        pixels = sum(camera.width * camera.height for camera in self.cameras.values())
        self._pictures = KeptPictures(4 * pixels * self.n_frames)
        #: how it differs from the scene in its folder; empty where it does not
        self.variation = ""

    def __repr__(self) -> str:
        return f"<TrainingScene {self.name}: {self.n_frames} timesteps, training cameras {', '.join(self.train)}>"

    def _training_only(self, camera: str) -> None:
        if camera not in self.cameras:
            raise SplashbenchError(f"camera {camera} of {self.name} is no training view; methods may not read it")

    def image(self, camera: str, t: int) -> NDArray[np.uint8]:
        """sRGB uint8 [H, W, 3] of a training camera at timestep `t`."""
        self._training_only(camera)
        return self._pictures.get("image", camera, t, self._scene.image)

    def mask(self, camera: str, t: int) -> NDArray[np.bool_]:
        """Liquid mask [H, W] of a training camera at timestep `t`."""
        self._training_only(camera)
        return self._pictures.mask(camera, t, self._scene.mask)

    def container_mask(self, camera: str) -> NDArray[np.bool_] | None:
        """Container mask [H, W] of a training camera, or None."""
        self._training_only(camera)
        return self._scene.container_mask(camera)

    def container_mesh(self) -> ContainerMesh | None:
        """The container as a mesh in scene units, or None; see `Scene.container_mesh`."""
        return self._scene.container_mesh()

    def initial_points(self) -> NDArray[np.float32] | None:
        """Static points [N, 7], see `Scene.initial_points`."""
        return self._scene.initial_points()

"""Where a scene's files lie and how their pixels are read: a source per layout on disk, behind one `Scene`.

The released layout is here; NeuroFluid's is in neurofluid.py.
"""

from __future__ import annotations

import hashlib
import json
import os
from abc import ABC, abstractmethod
from functools import cached_property
from pathlib import Path
from typing import ClassVar, Protocol

import numpy as np
from numpy.typing import NDArray

from splashbench.errors import SplashbenchError
from splashbench.files import read_gray, read_image, read_model, sha256_file
from splashbench.scene.layout import SceneMeta, SplitFile
from splashbench.scene.particles import Particles

META_FILE = "scene.json"
RELEASED_FILES = ("train_meta.json", "test_meta.json")


class Split(Protocol):
    """The training or the test cameras: names in order, K [C, 3, 3], w2c [C, 4, 4], and a path per camera and frame."""

    names: tuple[str, ...]
    K: NDArray[np.float64]
    w2c: NDArray[np.float64]
    paths: dict[str, list[str]]
    n_frames: int


class SceneSource(ABC):
    """The files of one scene, its calibration read and checked; both splits cover the same timesteps.

    Attributes:
        directory, name: folder and name.
        meta: what is known beyond the calibration, or None.
        train, test: the split.
        times_source: where `meta.times` come from, where they are known.
    """

    #: Name of the layout on disk.
    layout: ClassVar[str]
    directory: Path
    name: str
    meta: SceneMeta | None
    train: Split
    test: Split
    times_source: str = META_FILE

    @property
    def unmasked(self) -> frozenset[str]:
        """The cameras that have no masks at all."""
        return frozenset()

    @abstractmethod
    def image_path(self, camera: str, t: int) -> Path:
        """The file that holds the colours of `camera` at timestep `t`."""

    @abstractmethod
    def mask_path(self, camera: str, t: int) -> Path:
        """The file that holds the liquid mask of `camera` at timestep `t`."""

    @abstractmethod
    def image(self, camera: str, t: int) -> NDArray[np.uint8]:
        """sRGB uint8 [H, W, 3], of the size the file has."""

    @abstractmethod
    def mask(self, camera: str, t: int) -> NDArray[np.bool_]:
        """Liquid mask [H, W], of the size the file has."""

    @abstractmethod
    def calibration_files(self) -> list[Path]:
        """The files that say what the cameras and the frames are, scene.json included where it is there."""

    @abstractmethod
    def truth_files(self) -> list[Path]:
        """The files of the true particles; empty where there are none."""

    @abstractmethod
    def truth_particles(self) -> Particles:
        """The true particles on the scene's timesteps; asked only where there are files of them."""

    def truth_digest(self) -> str | None:
        """SHA-256 of the true particles' files, or None where there are none."""
        files = self.truth_files()
        if len(files) == 1:
            return sha256_file(files[0])
        entries = [[path.relative_to(self.directory).as_posix(), sha256_file(path)] for path in files]
        return hashlib.sha256(json.dumps(entries).encode()).hexdigest() if entries else None

    def faults(self) -> list[str]:
        """Contradictions between files that are valid one by one, a line each."""
        return []

    def _read_meta(self) -> SceneMeta | None:
        path = self.directory / META_FILE
        return read_model(path, SceneMeta) if path.exists() or path.is_symlink() else None


class ReleasedSource(SceneSource):
    """The layout of the released SplashSplat dataset, with or without scene.json (docs/scene_format.md)."""

    layout = "released"

    def __init__(self, directory: Path) -> None:
        self.directory = directory
        files = [directory / name for name in RELEASED_FILES]
        for path in files:
            if not path.is_file():
                raise SplashbenchError(f"{path} is missing; a scene has train_meta.json and test_meta.json")
        self.meta = self._read_meta()
        self.name = self.meta.name if self.meta else directory.resolve().name
        train, test = (SplitFile(path) for path in files)
        if train.n_frames != test.n_frames:
            raise SplashbenchError(
                f"{directory}: train_meta.json has {train.n_frames} frames and test_meta.json {test.n_frames}; "
                "both splits must cover the same timesteps"
            )
        shared = set(train.names) & set(test.names)
        if shared:
            raise SplashbenchError(
                f"{directory}: camera {min(shared)} is in train_meta.json and test_meta.json; keep it in one"
            )
        self.train, self.test = train, test
        self._paths = train.paths | test.paths

    @cached_property
    def unmasked(self) -> frozenset[str]:
        """Test cameras that have no folder in seg/, and all training cameras where none has one. They are none where
        seg/ is something else, a link to nowhere for one, or has a folder that is of no camera: that is a mistake, and
        masks are missing."""
        folders = {name: self.mask_path(name, 0).parent for name in (*self.train.names, *self.test.names)}
        seg = self.directory / "seg"
        try:
            inside = list(seg.iterdir()) if os.path.lexists(seg) else []
        except OSError:
            return frozenset()
        if any(path.is_dir() and path not in folders.values() for path in inside):
            return frozenset()
        without = {name for name, folder in folders.items() if not os.path.lexists(folder)}
        return frozenset(without if without.issuperset(self.train.names) else without.intersection(self.test.names))

    def image_path(self, camera: str, t: int) -> Path:
        return self.directory / "ims" / self._paths[camera][t]

    def mask_path(self, camera: str, t: int) -> Path:
        return self.directory / "seg" / Path(self._paths[camera][t]).with_suffix(".png")

    def image(self, camera: str, t: int) -> NDArray[np.uint8]:
        return read_image(self.image_path(camera, t))

    def mask(self, camera: str, t: int) -> NDArray[np.bool_]:
        return read_gray(self.mask_path(camera, t)) > 127

    def calibration_files(self) -> list[Path]:
        files = [self.directory / name for name in (*RELEASED_FILES, META_FILE)]
        return [path for path in files if path.is_file()]

    def truth_files(self) -> list[Path]:
        path = self.directory / "truth" / "particles.npz"
        return [path] if path.is_file() else []

    def truth_particles(self) -> Particles:
        (path,) = self.truth_files()
        particles = Particles.load(path)
        if particles.n_frames != self.train.n_frames:
            raise SplashbenchError(
                f"{path} has {particles.n_frames} instants, the scene {self.train.n_frames}; attach it again"
            )
        return particles

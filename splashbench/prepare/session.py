"""The raw session on disk: which camera recorded what, as its owner wrote it down in session.toml.

A session is one sitting with fixed cameras (paper Sec. 3, "Capture and calibration"). Each camera has a clip of the
calibration board, a recording of the textured static scene and one of the pour. A handheld sweep is optional; so is a
recording of the board carried about where several cameras see it at once, which then places the cameras. Cameras
split long recordings into chapters, which are listed in order. All but the pour may be photographs instead of video: a
folder of them stands for a chapter.
"""

from __future__ import annotations

import os
import re
from collections.abc import Sequence
from pathlib import Path
from typing import Literal, get_args

from pydantic import Field, PrivateAttr, field_validator, model_validator

from splashbench import toml
from splashbench.errors import SplashbenchError
from splashbench.files import validate_model
from splashbench.prepare.session_tables import (
    Board,
    Distance,
    Marker,
    Masks,
    Recordings,
    ScannedContainer,
    SessionTable,
    Sound,
    Sweep,
)

DESCRIPTION = "session.toml"
Kind = Literal["pour", "static", "intrinsics", "extrinsics"]
_CAMERA_NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9_-]{0,63}")


class Session(SessionTable):
    """The contents of session.toml, checked against the folder it lies in. Made by `Session.open`."""

    schema_version: Literal[1]
    name: str = Field(pattern=r"^[A-Za-z0-9][A-Za-z0-9_-]{0,99}$")
    cameras: list[str] = Field(min_length=2, max_length=100)
    train: list[str] = Field(min_length=1)
    test: list[str] = Field(min_length=1)
    timesteps: int = Field(default=50, ge=2, le=10_000)
    motion_interval: tuple[float, float] | None = None
    board: Board | None = None
    marker: Marker | None = None
    distance: Distance | None = None
    recordings: Recordings
    sweep: Sweep | None = None
    sound: Sound | None = None
    masks: Masks = Field(default_factory=Masks)
    container: ScannedContainer | None = None

    _directory: Path = PrivateAttr(default=Path())

    @field_validator("cameras")
    @classmethod
    def _names_are_usable(cls, cameras: list[str]) -> list[str]:
        # Camera names become file names.
        for name in cameras:
            if not _CAMERA_NAME.fullmatch(name):
                raise ValueError(f"camera name {name!r} must consist of letters, digits, - and _")
        if len(set(cameras)) != len(cameras):
            raise ValueError("a camera is named twice")
        return cameras

    @field_validator("motion_interval")
    @classmethod
    def _interval_runs_forwards(cls, interval: tuple[float, float] | None) -> tuple[float, float] | None:
        if interval is not None and not -1e6 < interval[0] < interval[1] < 1e6:
            raise ValueError("motion_interval must be [start, end] in seconds with start before end")
        return interval

    @model_validator(mode="after")
    def _cameras_are_complete(self) -> Session:
        clicked = [camera for camera in self.masks.points if camera not in self.cameras]
        if clicked:
            raise ValueError(f"[masks.points] names camera {clicked[0]}, which `cameras` does not list")
        if sorted(self.train + self.test) != sorted(self.cameras):
            raise ValueError("train and test must name every one of `cameras` exactly once between them")
        for kind in get_args(Kind):
            listed: dict[str, list[str]] = getattr(self.recordings, kind)
            if not listed and kind != "pour":
                continue
            missing = [camera for camera in self.cameras if camera not in listed]
            if missing:
                raise ValueError(f"camera {missing[0]} has no entry in [recordings.{kind}]; add its files there")
            unknown = [camera for camera in listed if camera not in self.cameras]
            if unknown:
                raise ValueError(f"[recordings.{kind}] names camera {unknown[0]}, which `cameras` does not list")
        if self.distance is not None:
            unknown = [camera for camera in self.distance.cameras if camera not in self.cameras]
            if unknown:
                raise ValueError(f"[distance] names camera {unknown[0]}, which `cameras` does not list")
            if len(set(self.distance.cameras)) < 2:
                raise ValueError("[distance] must name two different cameras")
        if self.recordings.extrinsics and self.sweep is not None:
            raise ValueError("[recordings.extrinsics] places the cameras by the board; leave out that or [sweep]")
        if self.recordings.intrinsics and self.board is None:
            raise ValueError("[recordings.intrinsics] needs the [board] that was filmed; describe it")
        return self

    @model_validator(mode="after")
    def _container_can_be_placed(self) -> Session:
        if self.container is None:
            return self
        masks, points = self.container.masks, self.container.points
        if masks is not None and self.masks.container_folder not in (None, masks):
            raise ValueError("[container] masks and [masks] container_folder name different folders; keep the first")
        if masks is None and self.masks.container_folder is None and not points:
            raise ValueError("[container] needs what places its mesh; give masks (a folder of <camera>.png) or points")
        if points and len(points) < 3:
            raise ValueError(f"[container] has {len(points)} points, three are needed; click more or leave them out")
        unknown = [camera for point in points for camera in point.pixels if camera not in self.cameras]
        if unknown:
            raise ValueError(f"[container] points name camera {unknown[0]}, which `cameras` does not list")
        return self

    @classmethod
    def open(cls, directory: Path) -> Session:
        """Read and check DIRECTORY/session.toml. Raises SplashbenchError naming whatever is missing or wrong."""
        directory = Path(directory)
        if not directory.is_dir():
            raise SplashbenchError(f"{directory} is not a folder; give the session's folder")
        path = directory / DESCRIPTION
        if not path.exists():
            raise SplashbenchError(
                f"{path} does not exist; `splashbench prepare {directory} --init` writes it by looking at the"
                " recordings"
            )
        session = validate_model(path, cls, toml.load(path))
        session._directory = directory
        for kind in get_args(Kind):
            listed = getattr(session.recordings, kind)
            for camera, chapters in listed.items():
                for chapter in chapters:
                    session._check(chapter, f"the {kind} recording of camera {camera}", photographs=kind != "pour")
            session._require_once(
                f"recordings.{kind}", [chapter for chapters in listed.values() for chapter in chapters]
            )
        for chapter in session.sweep.files if session.sweep else ():
            session._check(chapter, "the sweep", photographs=True)
        session._require_once("sweep", session.sweep.files if session.sweep else ())
        if session.masks.folder is not None:
            session._check(session.masks.folder, "the mask folder", folder=True)
        if session.masks.container_folder is not None:
            session._check(session.masks.container_folder, "the folder of container masks", folder=True)
        if session.container is not None:
            session._check(session.container.mesh, "the container's mesh")
            if session.container.masks is not None:
                session._check(session.container.masks, "the folder of container masks", folder=True)
        return session

    def _check(self, relative: str, what: str, folder: bool = False, photographs: bool = False) -> None:
        """`relative` must be a file within the session: or a folder instead (`folder`), or either (`photographs`)."""
        root = self._directory.resolve()
        if "\0" in relative:
            raise SplashbenchError(f"{self._directory / DESCRIPTION}: {what} has an unusable name; rename the file")
        path = Path(os.path.realpath(root / relative))  # Path.resolve raises for links that lead in a circle
        if not path.is_relative_to(root):
            raise SplashbenchError(
                f"{self._directory / DESCRIPTION}: {relative} ({what}) lies outside the session; "
                "copy the file into the session's folder"
            )
        if path.is_dir() and not folder and not photographs:
            raise SplashbenchError(
                f"{self._directory / relative} ({what}) is a folder; only video shows the pour: list its files in"
                f" {DESCRIPTION}"
            )
        if not (path.is_dir() if folder else path.is_file() or (photographs and path.is_dir())):
            raise SplashbenchError(
                f"{self._directory / relative} ({what}) does not exist; restore it or correct {DESCRIPTION}"
            )

    def _require_once(self, table: str, listed: Sequence[str]) -> None:
        """No file may stand twice in a table, however it is written."""
        seen: set[Path] = set()
        for chapter in listed:
            path = (self._directory / chapter).resolve()
            if path in seen:
                raise SplashbenchError(
                    f"{self._directory / DESCRIPTION}: {chapter} is listed twice in [{table}]; list every file once"
                )
            seen.add(path)

    @property
    def directory(self) -> Path:
        """The session's folder."""
        return self._directory

    @property
    def reference(self) -> str:
        """The camera whose local clock is the common one: the first listed."""
        return self.cameras[0]

    def paths(self, kind: Kind, camera: str) -> tuple[Path, ...]:
        """The chapters of one recording. Raises SplashbenchError when session.toml does not list it."""
        listed: dict[str, list[str]] = getattr(self.recordings, kind)
        if camera not in listed:
            raise SplashbenchError(
                f"{self._directory / DESCRIPTION}: camera {camera} has no {kind} recording; "
                f"list its files under [recordings.{kind}]"
            )
        return tuple(self._directory / chapter for chapter in listed[camera])

    @property
    def sweep_paths(self) -> tuple[Path, ...]:
        """The chapters of the handheld sweep; empty where there is none."""
        return tuple(self._directory / chapter for chapter in self.sweep.files) if self.sweep else ()

    @property
    def mask_folder(self) -> Path | None:
        """The folder of ready-made masks, where `masks.provider` says so."""
        return None if self.masks.folder is None else self._directory / self.masks.folder

    @property
    def container_folder(self) -> Path | None:
        """The folder of container masks, where [container] or [masks] names one."""
        folder = (self.container.masks if self.container else None) or self.masks.container_folder
        return None if folder is None else self._directory / folder

    @property
    def container_mesh(self) -> Path | None:
        """The container's mesh as it was scanned, where [container] names one."""
        return None if self.container is None else self._directory / self.container.mesh

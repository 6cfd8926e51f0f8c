"""The raw session on disk: which camera recorded what, as its owner wrote it down in session.toml.

A session is one sitting with fixed cameras (paper Sec. 3, "Capture and calibration"): per camera a clip of
the ChArUco board, a recording of the textured static scene and one of the pour, and optionally a handheld
sweep. Long recordings are split by the camera into chapters, which are listed in order.
"""

from __future__ import annotations

import re
from pathlib import Path
from typing import Annotated, Literal

from pydantic import BaseModel, ConfigDict, Field, PrivateAttr, field_validator, model_validator

from splashbench import toml
from splashbench.errors import SplashbenchError
from splashbench.files import validate_model

DESCRIPTION = "session.toml"
Kind = Literal["pour", "static", "intrinsics"]
_CAMERA_NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9_-]{0,63}")

Chapters = Annotated[list[str], Field(min_length=1, max_length=1000)]


class _Strict(BaseModel):
    model_config = ConfigDict(extra="forbid")


class Board(_Strict):
    """The ChArUco board: squares along x and y, side lengths in metres, and how its pattern is laid out."""

    squares_x: int = Field(ge=2, le=100)
    squares_y: int = Field(ge=2, le=100)
    square_metres: float = Field(gt=0, lt=10)
    marker_metres: float = Field(gt=0, lt=10)
    dictionary: str = Field(pattern=r"^DICT_[A-Z0-9_]+$")
    legacy: bool = False
    inverted: bool = False

    @model_validator(mode="after")
    def _marker_fits(self) -> Board:
        if self.marker_metres >= self.square_metres:
            raise ValueError("marker_metres must be smaller than square_metres: a marker lies inside its square")
        return self


class Recordings(_Strict):
    """Per kind of recording: camera name -> its chapters in order, relative to the session's folder."""

    pour: dict[str, Chapters]
    static: dict[str, Chapters] = Field(default_factory=dict)
    intrinsics: dict[str, Chapters] = Field(default_factory=dict)


class Sweep(_Strict):
    """A handheld sweep of the static scene by one more camera, in chapters."""

    files: Chapters


class Marker(_Strict):
    """An ArUco marker that lies flat and face up in the static scene: its number, and the length of its black side.

    It gives gravity and the origin, and metres too, for a session whose board does not lie flat there.
    """

    dictionary: str = Field(pattern=r"^DICT_[A-Z0-9_]+$")
    id: int = Field(ge=0, le=100_000)
    metres: float = Field(gt=0, lt=10)


class Distance(_Strict):
    """The measured distance between two cameras, in metres from the centre of one lens to that of the other."""

    cameras: list[str] = Field(min_length=2, max_length=2)
    metres: float = Field(gt=0, lt=1000)


class Masks(_Strict):
    """Where liquid masks come from: `background` subtraction, or a `folder` of <camera>/<source frame:06d>.png.

    container_folder: folder of <camera>.png, masks of the container; optional.
    """

    provider: Literal["background", "folder"] = "background"
    folder: str | None = None
    container_folder: str | None = None

    @model_validator(mode="after")
    def _folder_goes_with_its_provider(self) -> Masks:
        if (self.provider == "folder") != (self.folder is not None):
            raise ValueError('folder must be given with provider = "folder", and only then')
        return self


class Session(_Strict):
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
    masks: Masks = Field(default_factory=Masks)

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
        if sorted(self.train + self.test) != sorted(self.cameras):
            raise ValueError("train and test must name every one of `cameras` exactly once between them")
        for kind in ("pour", "static", "intrinsics"):
            listed: dict[str, list[str]] = getattr(self.recordings, kind)
            if not listed and kind != "pour":
                continue
            missing = [camera for camera in self.cameras if camera not in listed]
            if missing:
                raise ValueError(f"camera {missing[0]} has no entry in [recordings.{kind}]; add its files there")
            unknown = [camera for camera in listed if camera not in self.cameras]
            if unknown:
                raise ValueError(f"[recordings.{kind}] names camera {unknown[0]}, which `cameras` does not list")
        if self.marker is not None and self.board is not None and self.marker.dictionary == self.board.dictionary:
            on_board = self.board.squares_x * self.board.squares_y // 2
            if self.marker.id < on_board:
                raise ValueError(
                    f"marker {self.marker.id} is also on the board, whose are 0 to {on_board - 1}; print another"
                )
        if self.distance is not None:
            unknown = [camera for camera in self.distance.cameras if camera not in self.cameras]
            if unknown:
                raise ValueError(f"[distance] names camera {unknown[0]}, which `cameras` does not list")
            if len(set(self.distance.cameras)) < 2:
                raise ValueError("[distance] must name two different cameras")
        if self.recordings.intrinsics and self.board is None:
            raise ValueError("[recordings.intrinsics] needs the [board] that was filmed; describe it")
        return self

    @classmethod
    def open(cls, directory: Path) -> Session:
        """Read and check DIRECTORY/session.toml. Raises SplashbenchError naming whatever is missing or wrong."""
        directory = Path(directory)
        if not directory.is_dir():
            raise SplashbenchError(f"{directory} is not a folder; give the session's folder")
        path = directory / DESCRIPTION
        session = validate_model(path, cls, toml.load(path))
        session._directory = directory
        for kind in ("pour", "static", "intrinsics"):
            known: dict[Path, str] = {}
            for camera, chapters in getattr(session.recordings, kind).items():
                for chapter in chapters:
                    session._check(chapter, f"the {kind} recording of camera {camera}")
                    other = known.setdefault((directory / chapter).resolve(), camera)
                    if other != camera or chapters.count(chapter) > 1:
                        raise SplashbenchError(
                            f"{path}: {chapter} is listed twice in [recordings.{kind}]; list every file once"
                        )
        for chapter in session.sweep.files if session.sweep else ():
            session._check(chapter, "the sweep")
        if session.masks.folder is not None:
            session._check(session.masks.folder, "the mask folder", folder=True)
        if session.masks.container_folder is not None:
            session._check(session.masks.container_folder, "the folder of container masks", folder=True)
        return session

    def _check(self, relative: str, what: str, folder: bool = False) -> None:
        root = self._directory.resolve()
        if "\0" in relative:
            raise SplashbenchError(f"{self._directory / DESCRIPTION}: {what} has an unusable name; mend it")
        path = (root / relative).resolve()
        if not path.is_relative_to(root):
            raise SplashbenchError(
                f"{self._directory / DESCRIPTION}: {relative} ({what}) lies outside the session; "
                "copy the file into the session's folder"
            )
        if not (path.is_dir() if folder else path.is_file()):
            raise SplashbenchError(
                f"{self._directory / relative} ({what}) does not exist; restore it or mend {DESCRIPTION}"
            )

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
        """The folder of container masks, where `masks.container_folder` names one."""
        return None if self.masks.container_folder is None else self._directory / self.masks.container_folder

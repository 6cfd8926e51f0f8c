"""The raw session on disk: which camera recorded what, as its owner wrote it down in session.toml.

A session is one sitting with fixed cameras (paper Sec. 3, "Capture and calibration"): per camera a clip of
the calibration board, a recording of the textured static scene and one of the pour, and optionally a handheld
sweep. Long recordings are split by the camera into chapters, which are listed in order. All but the pour may be
photographs instead of video: a folder of them stands for a chapter.
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

Finite = Annotated[float, Field(ge=-1e9, le=1e9, allow_inf_nan=False)]
Chapters = Annotated[list[str], Field(min_length=1, max_length=1000)]


class _Strict(BaseModel):
    model_config = ConfigDict(extra="forbid")


class Board(_Strict):
    """The calibration board: squares along x and y, side lengths in metres, and how its pattern is laid out.

    A checkerboard has no markers, and needs four squares each way: its pattern is recognised by its inner corners.
    """

    kind: Literal["charuco", "checkerboard"] = "charuco"
    squares_x: int = Field(ge=2, le=100)
    squares_y: int = Field(ge=2, le=100)
    square_metres: float = Field(gt=0, lt=10)
    marker_metres: float | None = Field(default=None, gt=0, lt=10)
    dictionary: str | None = Field(default=None, pattern=r"^DICT_[A-Z0-9_]+$")
    legacy: bool = False
    inverted: bool = False

    @model_validator(mode="after")
    def _fits_its_kind(self) -> Board:
        if self.kind == "checkerboard":
            if self.marker_metres is not None or self.dictionary is not None or self.legacy:
                raise ValueError("a checkerboard has no marker_metres, dictionary or legacy; leave them out")
            if min(self.squares_x, self.squares_y) < 4:
                raise ValueError("a checkerboard needs at least 4 squares each way; count squares, not inner corners")
        elif self.marker_metres is None or self.dictionary is None:
            raise ValueError(
                'a ChArUco board needs marker_metres and dictionary; give both, or kind = "checkerboard" for a board'
                " without markers"
            )
        elif self.marker_metres >= self.square_metres:
            raise ValueError("marker_metres must be smaller than square_metres: a marker lies inside its square")
        return self


class Recordings(_Strict):
    """Per kind of recording: camera name -> its chapters in order, relative to the session's folder.

    A chapter of `static` or `intrinsics` may be a folder of photographs.
    """

    pour: dict[str, Chapters]
    static: dict[str, Chapters] = Field(default_factory=dict)
    intrinsics: dict[str, Chapters] = Field(default_factory=dict)


class Sweep(_Strict):
    """A handheld sweep of the static scene by one more camera, in chapters or folders of photographs."""

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


class Sound(_Strict):
    """Where the sound came from by which clocks are found: `source` [3], metres in the scene's frame (its origin is the
    board's centre, +y up, +x along the print). Given, the sound's travel (2.9 ms per metre) is taken out of the clocks.
    """

    source: tuple[float, float, float]

    @field_validator("source")
    @classmethod
    def _is_within_earshot(cls, source: tuple[float, float, float]) -> tuple[float, float, float]:
        if not all(abs(value) < 100 for value in source):
            raise ValueError("source must be [x, y, z] in metres, below 100 m each")
        return source


class Click(_Strict):
    """A point that somebody marked on a raw frame of the pour: on liquid, or on what is none.

    frame: source frame, from 0 over all chapters; x, y: pixels from the left and from the top.
    """

    frame: int = Field(ge=0, lt=10_000_000)
    x: float = Field(ge=0, lt=100_000)
    y: float = Field(ge=0, lt=100_000)
    liquid: bool = True


class Masks(_Strict):
    """Where liquid masks come from: `background` subtraction, a `folder` of <camera>/<source frame:06d>.png, or `sam3`.

    checkpoint: folder of a SAM3 checkpoint, from the session's folder; being large and shared, it may lie outside.
    text, points: what SAM3 is asked for, in words and by clicks per camera; text = "" leaves the words out.
    confidence: the least score of what the words find.
    container_folder: folder of <camera>.png, masks of the container; optional.
    """

    provider: Literal["background", "folder", "sam3"] = "background"
    folder: str | None = Field(default=None, min_length=1)
    checkpoint: str | None = Field(default=None, min_length=1, max_length=4096)
    text: str = Field(default="liquid", max_length=200)
    points: dict[str, Annotated[list[Click], Field(min_length=1, max_length=1000)]] = Field(default_factory=dict)
    confidence: float = Field(default=0.5, ge=0, lt=1)
    container_folder: str | None = Field(default=None, min_length=1)

    @model_validator(mode="after")
    def _folder_goes_with_its_provider(self) -> Masks:
        if (self.provider == "folder") != (self.folder is not None):
            raise ValueError('folder must be given with provider = "folder", and only then')
        return self

    @model_validator(mode="after")
    def _prompts_go_with_sam3(self) -> Masks:
        if (self.provider == "sam3") != (self.checkpoint is not None):
            raise ValueError('checkpoint must be given with provider = "sam3", and only then')
        given = self.model_fields_set & {"text", "points", "confidence"}
        if self.provider != "sam3" and given:
            raise ValueError(f'{min(given)} is for provider = "sam3" only')
        if self.provider == "sam3" and not self.text.strip() and not self.points:
            raise ValueError("text is empty and there are no points; say what to look for")
        if self.checkpoint is not None and "\0" in self.checkpoint:
            raise ValueError("checkpoint has an unusable name")
        return self

    @field_validator("points")
    @classmethod
    def _every_frame_clicked_has_liquid(cls, points: dict[str, list[Click]]) -> dict[str, list[Click]]:
        for camera, clicks in points.items():
            wet = {click.frame for click in clicks if click.liquid}
            dry = {click.frame for click in clicks} - wet
            if dry:
                raise ValueError(f"camera {camera} has no click on liquid in frame {min(dry)}; add one, or drop it")
        return points


class ContainerPoint(_Strict):
    """A point of the container's mesh, in its own coordinates, and where cameras see it: pixels of the raw frame."""

    point: tuple[Finite, Finite, Finite]
    pixels: dict[str, tuple[Finite, Finite]] = Field(min_length=1, max_length=100)


class Container(_Strict):
    """The scanned container: its `mesh` (PLY, GLB or OBJ) and what places it in the scene.

    masks: folder of <camera>.png; `masks.container_folder` where it is not given. points: clicked by hand; where both
    are there, the points are where the masks' fit begins. metres_per_unit: of the mesh's coordinates. up: the mesh's
    direction that points up; found where it is not given.
    """

    mesh: str
    masks: str | None = Field(default=None, min_length=1)
    points: list[ContainerPoint] = Field(default_factory=list, max_length=1000)
    metres_per_unit: Annotated[float, Field(gt=0, le=1e6, allow_inf_nan=False)] | Literal["unknown"] = 1.0
    up: Literal["x", "-x", "y", "-y", "z", "-z"] | None = None
    transparent: bool = False

    @field_validator("mesh")
    @classmethod
    def _is_a_mesh(cls, mesh: str) -> str:
        from splashbench.scene.container import FORMATS

        if Path(mesh).suffix.lower() not in FORMATS:
            raise ValueError(f"{mesh!r} is not a mesh that is read; convert it to one of {', '.join(FORMATS)}")
        return mesh

    @property
    def scale(self) -> float | None:
        """Metres per unit of the mesh; None where it is to be found."""
        return None if self.metres_per_unit == "unknown" else self.metres_per_unit


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
    sound: Sound | None = None
    masks: Masks = Field(default_factory=Masks)
    container: Container | None = None

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
        if self.distance is not None:
            unknown = [camera for camera in self.distance.cameras if camera not in self.cameras]
            if unknown:
                raise ValueError(f"[distance] names camera {unknown[0]}, which `cameras` does not list")
            if len(set(self.distance.cameras)) < 2:
                raise ValueError("[distance] must name two different cameras")
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
        session = validate_model(path, cls, toml.load(path))
        session._directory = directory
        for kind in ("pour", "static", "intrinsics"):
            known: dict[Path, str] = {}
            for camera, chapters in getattr(session.recordings, kind).items():
                for chapter in chapters:
                    session._check(chapter, f"the {kind} recording of camera {camera}", photographs=kind != "pour")
                    other = known.setdefault((directory / chapter).resolve(), camera)
                    if other != camera or chapters.count(chapter) > 1:
                        raise SplashbenchError(
                            f"{path}: {chapter} is listed twice in [recordings.{kind}]; list every file once"
                        )
        for chapter in session.sweep.files if session.sweep else ():
            session._check(chapter, "the sweep", photographs=True)
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
            raise SplashbenchError(f"{self._directory / DESCRIPTION}: {what} has an unusable name; mend it")
        path = (root / relative).resolve()
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
        """The folder of container masks, where [container] or [masks] names one."""
        named = (self.container.masks if self.container else None) or self.masks.container_folder
        return None if named is None else self._directory / named

    @property
    def container_mesh(self) -> Path | None:
        """The container's mesh as it was scanned, where [container] names one."""
        return None if self.container is None else self._directory / self.container.mesh

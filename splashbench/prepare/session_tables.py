"""The tables of session.toml: board, recordings, marker, masks, container and the rest, each checked by itself."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal

from pydantic import BaseModel, ConfigDict, Field, field_validator, model_validator

Finite = Annotated[float, Field(ge=-1e9, le=1e9, allow_inf_nan=False)]
Chapters = Annotated[list[str], Field(min_length=1, max_length=1000)]


class SessionTable(BaseModel):
    """A table that refuses keys it does not know."""

    model_config = ConfigDict(extra="forbid")


class Board(SessionTable):
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


class Recordings(SessionTable):
    """Per kind of recording: camera name -> its chapters in order, relative to the session's folder.

    A chapter of `static`, `intrinsics` or `extrinsics` may be a folder of photographs. With `extrinsics` the cameras
    are placed by the board, which several of them see at once; without, by structure from motion of the static scene.
    """

    pour: dict[str, Chapters]
    static: dict[str, Chapters] = Field(default_factory=dict)
    intrinsics: dict[str, Chapters] = Field(default_factory=dict)
    extrinsics: dict[str, Chapters] = Field(default_factory=dict)


class Sweep(SessionTable):
    """A handheld sweep of the static scene by one more camera, in chapters or folders of photographs."""

    files: Chapters


class Marker(SessionTable):
    """An ArUco marker that lies flat and face up in the static scene: its number, and the length of its black side.

    It gives gravity and the origin, and metres too, for a session whose board does not lie flat there.
    """

    dictionary: str = Field(pattern=r"^DICT_[A-Z0-9_]+$")
    id: int = Field(ge=0, le=100_000)
    metres: float = Field(gt=0, lt=10)


class Distance(SessionTable):
    """The measured distance between two cameras, in metres from the centre of one lens to that of the other."""

    cameras: list[str] = Field(min_length=2, max_length=2)
    metres: float = Field(gt=0, lt=1000)


class Sound(SessionTable):
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


class MaskClick(SessionTable):
    """A point that somebody marked on a raw frame of the pour: on liquid, or on what is none.

    frame: source frame, from 0 over all chapters; x, y: pixels from the left and from the top.
    """

    frame: int = Field(ge=0, lt=10_000_000)
    x: float = Field(ge=0, lt=100_000)
    y: float = Field(ge=0, lt=100_000)
    liquid: bool = True


class Masks(SessionTable):
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
    points: dict[str, Annotated[list[MaskClick], Field(min_length=1, max_length=1000)]] = Field(default_factory=dict)
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
    def _every_frame_clicked_has_liquid(cls, points: dict[str, list[MaskClick]]) -> dict[str, list[MaskClick]]:
        for camera, clicks in points.items():
            wet = {click.frame for click in clicks if click.liquid}
            dry = {click.frame for click in clicks} - wet
            if dry:
                raise ValueError(f"camera {camera} has no click on liquid in frame {min(dry)}; add one, or drop it")
        return points


class ContainerPoint(SessionTable):
    """A point of the container's mesh, in its own coordinates, and where cameras see it: pixels of the raw frame."""

    point: tuple[Finite, Finite, Finite]
    pixels: dict[str, tuple[Finite, Finite]] = Field(min_length=1, max_length=100)


class ScannedContainer(SessionTable):
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

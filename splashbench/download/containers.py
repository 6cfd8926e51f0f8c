"""The containers of downloaded scenes: a scan is placed where there is one, else the footage gives a surface; and their
masks, which crops take from the whole images.

The release has scans beside its scenes, and container masks beside its whole images alone. What places and reconstructs
is handed in (`ContainerMaker`): this module knows folders, what is there already, and notes.
"""

from __future__ import annotations

import shlex
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Protocol

from splashbench.download.archive import ArchiveSource
from splashbench.download.fetch import alone
from splashbench.download.scenes import SceneReport, note_container, stated_container
from splashbench.download.unpacking import VARIANTS
from splashbench.errors import DiskFullError, SplashbenchError
from splashbench.files import as_asked, atomic_directory, write_png
from splashbench.manifest import load_scenes
from splashbench.scene import Scene
from splashbench.scene.container_masks import cut_container_masks
from splashbench.scene.writer import to_gray

#: A scene's folder of container masks, <camera>.png.
MASKS = "container_mask"


class ContainerMaker(Protocol):
    """What finds a container and writes it into a scene, whole or not at all.

    masks: the folder of the scene before it was cropped, which has the container masks; None where `scene` has them.
    Both return what is doubtful, a line each, and raise SplashbenchError where there is no container to be had.
    """

    def place(self, scene: Path, scan: Path, masks: Path | None) -> list[str]:
        """Place the mesh `scan`."""

    def reconstruct(self, scene: Path, masks: Path | None) -> list[str]:
        """Reconstruct an opaque container from the footage."""


@dataclass(frozen=True)
class ContainerReport:
    """What became of a scene's container.

    Attributes:
        scene: such as "real_scene_crop/bowl_001".
        file: the container's mesh in the scene's folder; None where it has none.
        made: whether it was put there now.
        scan: the scan that there is for it.
        reason, by_hand: why it has none, and the command to try by hand; empty where it has one.
        doubts: of one that was made now, a line each.
    """

    scene: str
    file: str | None
    made: bool
    scan: Path | None
    reason: str = ""
    by_hand: str = ""
    doubts: list[str] = field(default_factory=list)


@dataclass(frozen=True)
class MaskReport:
    """What became of a scene's container masks.

    Attributes:
        scene: such as "real_scene_crop/bowl_001".
        count: how many it has.
        made: whether they were cut now.
        reason: why it has none; empty where it has some.
    """

    scene: str
    count: int
    made: bool
    reason: str = ""


def add_container_masks(
    out: Path, reports: Sequence[SceneReport], *, tell: Callable[[str], None], source: ArchiveSource | None = None
) -> list[MaskReport]:
    """Give each cropped scene of `reports`, as `download_scenes` returned them, the whole one's container masks.

    A scene that has masks keeps them. Where there are none to be had the report says why, and the rest goes on. Raises
    DiskFullError.
    """
    source = source or ArchiveSource.official()
    with alone(out / source.name, tell):
        return [_with_masks(out, report) for report in reports]


def _with_masks(out: Path, report: SceneReport) -> MaskReport:
    key, place = f"{VARIANTS[report.variant]}/{report.name}", report.folder / MASKS
    try:
        made = not any(place.glob("*.png"))
        if made and report.variant == "full":
            return MaskReport(key, 0, False, f"{place} has none; the archive has none for it")
        if made:
            masks = cut_container_masks(Scene.open(report.folder), Scene.open(_require_whole(out, report.name)))
            with atomic_directory(place) as staging:
                for name, mask in masks.items():
                    write_png(staging / f"{name}.png", to_gray(mask))
            note_container(out, key)
        return MaskReport(key, len(list(place.glob("*.png"))), made)
    except (SplashbenchError, OSError) as error:
        return MaskReport(key, 0, False, _why_not(error, report.folder))


def _why_not(error: SplashbenchError | OSError, folder: Path) -> str:
    """What is said of `error` about the scene in `folder`; raises it where the disk is full, which ends all."""
    if isinstance(error, DiskFullError):
        raise error
    if isinstance(error, OSError):  # such as a folder that may not be written
        return f"{as_asked(error.filename or folder)}: {error.strerror or error}"
    return str(error)


def _require_whole(out: Path, name: str) -> Path:
    """The folder of the scene before it was cropped. Raises SplashbenchError where it is not unpacked."""
    whole = _whole(out, name)
    if not whole.is_dir():
        raise SplashbenchError(
            f"it has no container masks; {whole}, which has them, is not unpacked: add --variant full crop"
        )
    return whole


def _whole(out: Path, name: str) -> Path:
    return out / VARIANTS["full"] / name


def add_containers(
    out: Path,
    reports: Sequence[SceneReport],
    maker: ContainerMaker,
    *,
    tell: Callable[[str], None],
    source: ArchiveSource | None = None,
) -> list[ContainerReport]:
    """Give each scene of `reports`, as `download_scenes` returned them, its container; one that has one keeps it.

    Where that is refused the report says why, and the rest goes on. Raises DiskFullError.
    """
    source = source or ArchiveSource.official()
    found = []
    with alone(out / source.name, tell):  # as the download: it removes what is half-made
        for number, report in enumerate(reports, 1):
            each = _Container(out, report)
            found.append(each.added(maker, lambda what, n=number: tell(f"{what} ({n} of {len(reports)})")))  # type: ignore[misc]
    return found


class _Container:
    """The container of one scene in the folder `out`."""

    def __init__(self, out: Path, report: SceneReport) -> None:
        self._out, self._name, self._folder, self._scan = out, report.name, report.folder, report.mesh
        self._cropped = report.variant != "full"
        self._key = f"{VARIANTS[report.variant]}/{report.name}"

    def added(self, maker: ContainerMaker, tell: Callable[[str], None]) -> ContainerReport:
        try:
            return self._added(maker, tell)
        except (SplashbenchError, OSError) as error:
            reason = _why_not(error, self._folder)
        return ContainerReport(self._key, None, False, self._scan, reason, self._by_hand())

    def _added(self, maker: ContainerMaker, tell: Callable[[str], None]) -> ContainerReport:
        scene, doubts = Scene.open(self._folder), []
        made = scene.meta is None or scene.meta.container_mesh is None
        if made and self._scan is not None:
            masks = self._masks()
            tell(f"placing {self._scan.name} in {self._key}")
            doubts = maker.place(self._folder, self._scan, masks)
        elif made:
            self._require_opaque(scene)
            masks = self._masks()
            tell(f"reconstructing the container of {self._key}")
            doubts = maker.reconstruct(self._folder, masks)
        note_container(self._out, self._key)
        return ContainerReport(self._key, stated_container(self._folder), made, self._scan, doubts=doubts)

    def _masks(self) -> Path | None:
        """The folder of the scene whose container masks count, None for the scene's own.

        Raises SplashbenchError where there are none.
        """
        if (self._folder / MASKS).is_dir():
            return None
        whole = _require_whole(self._out, self._name) if self._cropped else self._folder
        if not (whole / MASKS).is_dir():
            raise SplashbenchError(f"{whole / MASKS} is not there; draw <camera>.png, two at least")
        return whole

    def _require_opaque(self, scene: Scene) -> None:
        """Raise SplashbenchError for a tank that nobody called opaque: a surface of it would count as opaque."""
        if load_scenes()[self._name].container == "tank" and scene.container_transparent is None:
            raise SplashbenchError(
                "there is no scan of it, and the release does not say whether the tank is transparent, whose depth"
                " cannot be seen"
            )

    def _by_hand(self) -> str:
        words: list[object] = ["splashbench", "scene"]
        if self._scan is None:
            words += ["reconstruct-container", self._folder]
        else:
            words += ["place-container", self._folder, self._scan]
        if self._cropped and not (self._folder / MASKS).is_dir():
            words += ["--masks", _whole(self._out, self._name)]
        if stated_container(self._folder) is not None:  # of a mesh that cannot be read
            words += ["--replace"]
        return shlex.join([*map(str, words), "--picture", f"{self._name}.png"])

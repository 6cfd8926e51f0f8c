"""The released scenes in a folder: fetched, unpacked, checked and given their times, and no step twice.

The folder has the release's layout: real_scene/ and real_scene_crop/ with a folder for each scene, and meshes/. Times
come from Table S1 by the name of a scene's folder (`splashbench.manifest`). scenes.json notes which were checked.
"""

from __future__ import annotations

import difflib
from collections.abc import Callable, Sequence
from contextlib import closing
from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal

from pydantic import BaseModel, ConfigDict, Field

from splashbench.cache import cache_folder
from splashbench.download.archive import ArchiveSource, note_path, obtain_archive
from splashbench.download.fetch import PATIENT, Patience, alone, require_room
from splashbench.download.meter import Meter
from splashbench.download.neurofluid_files import scene_named
from splashbench.download.unpacking import (
    MESHES,
    VARIANTS,
    SceneArchive,
    open_archive,
    remove_leftovers,
)
from splashbench.errors import SplashbenchError
from splashbench.files import list_files, read_model, read_plain, require_folder_place, write_model, write_text
from splashbench.manifest import load_archive, load_scenes
from splashbench.scene import Scene
from splashbench.scene.container import read_mesh
from splashbench.scene.inspection import check_scene

#: In the folder of the scenes: what was checked.
STATE_FILE = "scenes.json"
_ATTRIBUTION = "ATTRIBUTION.txt"
# In the cache folder: where the scenes were put last.
_REMEMBERED = "scenes_folder.txt"
_MAX_PATH_BYTES = 4096


class CheckedScene(BaseModel):
    """A scene that `scene check` has read whole.

    Attributes:
        files, bytes: what it consisted of then, or once it had been given a container.
        faults: what was found.
        container: file of the container's mesh that its scene.json names.
    """

    model_config = ConfigDict(extra="forbid")
    files: int = Field(ge=0)
    bytes: int = Field(ge=0)
    faults: list[str] = Field(default_factory=list)
    container: str | None = None


class _State(BaseModel):
    model_config = ConfigDict(extra="forbid")
    schema_version: Literal[1] = 1
    scenes: dict[str, CheckedScene] = Field(default_factory=dict)


@dataclass
class SceneReport:
    """A scene after the download. made: whether it was unpacked now; mesh: its container's scan, where there is one."""

    name: str
    variant: str
    folder: Path
    made: bool
    frames: int
    times_source: str
    seconds: float
    mesh: Path | None
    faults: list[str] = field(default_factory=list)


def require_names(names: Sequence[str]) -> list[str]:
    """The scenes called `names`, in the order of Table S1; all 20 for none.

    Raises SplashbenchError for a name that the release does not have.
    """
    known = load_scenes()
    for name in names:
        if name in known:
            continue
        if name.lower() == "neurofluid" or scene_named(name):
            raise SplashbenchError(
                "NeuroFluid's scenes are in another place; `splashbench download neurofluid` has them"
            )
        near = difflib.get_close_matches(name, known, n=1)
        hint = f", did you mean {near[0]!r}?" if near else "; there are bowl_001 to bowl_017 and tank_001 to tank_003"
        raise SplashbenchError(f"the release has no scene {name!r}{hint}")
    return [name for name in known if not names or name in names]


def download_scenes(
    out: Path,
    names: Sequence[str] = (),
    variants: Sequence[str] = ("crop",),
    by_hand: Path | None = None,
    *,
    tell: Callable[[str], None],
    source: ArchiveSource | None = None,
    patience: Patience = PATIENT,
    check_again: bool = False,
) -> list[SceneReport]:
    """Fetch the archive and unpack the scenes `names` (all 20 for none) into `out`; what is there stays.

    Args:
        variants: "full", "crop" or both.
        by_hand: the archive as somebody fetched it; nothing is fetched then.
        check_again: read scenes again that were checked before.

    Raises SplashbenchError where the archive cannot be had, is damaged or lacks a scene. Faults of scenes are reported.
    """
    out, source = Path(out), source or ArchiveSource.official()
    chosen = require_names(names)
    require_folder_place(out)
    wanted = [(VARIANTS[variant], name) for variant in VARIANTS if variant in variants for name in chosen]
    with alone(out / source.name, tell):
        places = [out / folder / name for folder, name in wanted]
        notes = (out / _ATTRIBUTION, note_path(out, source))
        remove_leftovers([*places, *(out / MESHES / f"{name}.glb" for name in chosen), *notes])
        for place in places:
            if place.exists() and not place.is_dir():
                raise SplashbenchError(f"{place} is a file, where a scene belongs; move it away")
        missing = [pair for pair, place in zip(wanted, places) if not place.is_dir()]
        if missing:
            archive_path = obtain_archive(out, by_hand, source, tell=tell, patience=patience)
            with open_archive(archive_path) as archive:
                _unpack(archive, missing, chosen, out, tell)
        _write_attribution(out)
        reports = _checked(out, wanted, set(missing), check_again, tell)
    _remember(out)
    return reports


def _unpack(
    archive: SceneArchive,
    missing: Sequence[tuple[str, str]],
    chosen: Sequence[str],
    out: Path,
    tell: Callable[[str], None],
) -> None:
    contents = archive.contents
    lacking = [f"{folder}/{name}" for folder, name in missing if (folder, name) not in contents.scenes]
    if lacking:
        more = f" and {len(lacking) - 3} more" if len(lacking) > 3 else ""
        raise SplashbenchError(
            f"{archive.path} holds no {', '.join(lacking[:3])}{more}; name the scenes that it holds, or fetch it again"
        )
    if contents.others:
        first = contents.others[0][:80]
        tell(f"left out: {len(contents.others)} files that are no part of the layout, such as {first!r}")
    meshes = [name for name in chosen if name in contents.meshes and not (out / MESHES / f"{name}.glb").is_file()]
    total = sum(contents.bytes_of(*pair) for pair in missing) + sum(contents.meshes[name].file_size for name in meshes)
    remedy = "free some space, or name fewer scenes, or one --variant"
    require_room(out, total, "the scenes take", remedy)
    tell(f"unpacking {len(missing)} scenes{f' and {len(meshes)} scans of containers' if meshes else ''} into {out}")
    with closing(Meter("unpacking", max(1, total), 0)) as meter:
        for name in meshes:
            archive.unpack_mesh(name, out, meter.add)
        for folder, name in missing:
            archive.unpack_scene(folder, name, out, meter.add)


def _checked(
    out: Path, wanted: Sequence[tuple[str, str]], made: set[tuple[str, str]], again: bool, tell: Callable[[str], None]
) -> list[SceneReport]:
    variant_of = {folder: variant for variant, folder in VARIANTS.items()}
    reports = []
    for number, (folder, name) in enumerate(wanted, 1):
        mesh = out / MESHES / f"{name}.glb"
        report = check_downloaded(
            out,
            f"{folder}/{name}",
            made=(folder, name) in made,
            again=again,
            tell=lambda key, number=number: tell(f"checking {key} ({number} of {len(wanted)})"),  # type: ignore[misc]
        )
        report.variant, report.mesh = variant_of[folder], mesh if mesh.is_file() else None
        if report.mesh is not None:
            try:
                read_mesh(report.mesh)
            except SplashbenchError as error:
                report.faults.append(str(error))
        reports.append(report)
    return reports


def check_downloaded(out: Path, key: str, *, made: bool, again: bool, tell: Callable[[str], None]) -> SceneReport:
    """Check the scene at `out`/`key`, unless it was checked and has as many files and bytes as then.

    made: whether it was unpacked now; again: check it in any case; tell: is given `key` where it is checked.
    """
    path, place = out / STATE_FILE, out / key
    listing = list_files(place)
    known = _noted(path).scenes.get(key)
    size = (len(listing.names), listing.bytes)
    if known is None or again or made or (known.files, known.bytes) != size:
        tell(key)
        faults = [*listing.faults, *check_scene(place)]
        known = CheckedScene(files=size[0], bytes=size[1], faults=faults, container=stated_container(place))
        _note(path, key, known)
    report = SceneReport(
        name=place.name,
        variant="",
        folder=place,
        made=made,
        frames=0,
        times_source="",
        seconds=0.0,
        mesh=None,
        faults=list(known.faults),
    )
    try:
        scene = Scene.open(place)
    except SplashbenchError as error:
        report.faults = report.faults or [str(error)]
    else:
        report.frames, report.times_source = scene.n_frames, scene.times_source
        report.seconds = float(scene.times[-1] - scene.times[0])
    return report


def stated_container(place: Path) -> str | None:
    """The file of the container's mesh that scene.json in `place` names; None where it names none or cannot be read."""
    try:
        meta = Scene.open(place).meta
    except SplashbenchError:
        return None
    return None if meta is None else meta.container_mesh


def note_container(out: Path, key: str) -> None:
    """Note that the scene at `out`/`key`, which had been checked, has a container now; all else was read then.

    Raises SplashbenchError where the container's mesh cannot be read.
    """
    path, place = out / STATE_FILE, out / key
    listing, before = list_files(place), _noted(path).scenes.get(key)
    faults = [] if before is None else before.faults
    now = CheckedScene(files=len(listing.names), bytes=listing.bytes, faults=faults, container=stated_container(place))
    if now != before:
        Scene.open(place).container_mesh()
        _note(path, key, now)


def _note(path: Path, key: str, checked: CheckedScene) -> None:
    # Another command may note scenes of its own in the same folder meanwhile, such as NeuroFluid's.
    with alone(path, lambda _: None):
        remove_leftovers([path])
        state = _noted(path)
        state.scenes[key] = checked
        write_model(path, state)


def _noted(path: Path) -> _State:
    try:
        return read_model(path, _State) if path.is_file() else _State()
    except SplashbenchError as error:
        raise SplashbenchError(f"{error}, or remove it: the scenes are then checked again") from None


def _write_attribution(out: Path) -> None:
    archive = load_archive()
    text = f"{archive.attribution}\nLicence: {archive.license}\nFrom: {archive.url}\n{archive.repository}\n"
    path = out / _ATTRIBUTION
    if not path.is_file():
        write_text(path, text)


def _remember(out: Path) -> None:
    """Note where the scenes are, for `splashbench benchmark run --scenes all`."""
    try:
        write_text(cache_folder() / _REMEMBERED, f"{out.resolve()}\n")
    except (OSError, SplashbenchError):
        return  # a convenience: without a cache folder the user names the scenes' folder


def remembered_folder() -> Path | None:
    """The folder that `download_scenes` filled last on this machine, as far as it is still there."""
    try:
        text = read_plain(cache_folder() / _REMEMBERED, _MAX_PATH_BYTES).decode("utf-8")
    except (OSError, SplashbenchError, UnicodeDecodeError):
        return None
    folder = Path(text.strip())
    return folder if text.strip() and folder.is_dir() else None

"""The scenes of a benchmark: folders of scenes, a folder that holds some, or all 20 of the release."""

from __future__ import annotations

import os
from collections.abc import Sequence
from pathlib import Path

from splashbench.download.scenes import remembered_folder
from splashbench.errors import SplashbenchError
from splashbench.manifest import load_evaluation, load_scenes
from splashbench.scene.neurofluid import is_neurofluid
from splashbench.scene.source import RELEASED_FILES

#: In place of folders: the 20 released scenes, where `splashbench download scenes` put them last.
ALL = "all"
_MAX_SCENES = 1000


def find_scenes(places: Sequence[str]) -> list[Path]:
    """The folders of the scenes that `places` mean, in the order of names within each place.

    A place is the folder of a scene, a folder that holds scenes, one that `splashbench download scenes` filled (its
    scored variant, the crops, is taken where it is there), or "all". Raises SplashbenchError where one holds none.
    """
    found: list[Path] = []
    for place in places:
        found += _all_released() if place == ALL else _in_place(Path(place))
    # One folder may be named in two ways; a link is a scene of its own.
    unique = list({os.path.normpath(path.absolute()): path for path in found}.values())
    if len(unique) > _MAX_SCENES:
        raise SplashbenchError(f"{len(unique)} scenes are more than {_MAX_SCENES}; name fewer folders with --scenes")
    return unique


def _in_place(place: Path) -> list[Path]:
    if not place.is_dir():
        raise SplashbenchError(f"{place} is not a folder; give one with scenes, or `all` for the 20 released ones")
    if _is_scene(place):
        return [place]
    scored = place / load_evaluation().scored_variant
    for folder in (scored, place, place / "real_scene"):
        if folder.is_dir():
            scenes = sorted(path for path in folder.iterdir() if not path.name.startswith(".") and _is_scene(path))
            if scenes:
                return scenes
    raise SplashbenchError(
        f"{place} holds no scene (a folder with {' and '.join(RELEASED_FILES)}); give another folder, or fill it with "
        f"`splashbench download scenes {place}`"
    )


def _is_scene(path: Path) -> bool:
    if not path.is_dir():
        return False
    return all((path / name).is_file() for name in RELEASED_FILES) or is_neurofluid(path)


def _all_released() -> list[Path]:
    folder = remembered_folder()
    if folder is None:
        raise SplashbenchError(
            "the released scenes are not on this machine; fetch them with `splashbench download scenes DIR`, and give "
            "that folder, or `all`"
        )
    scenes = _in_place(folder)
    missing = [name for name in load_scenes() if name not in {path.name for path in scenes}]
    if missing:
        raise SplashbenchError(
            f"{folder} lacks {len(missing)} of the 20 released scenes, such as {missing[0]}; fetch them with "
            f"`splashbench download scenes {folder}`, or give {folder} in place of `all` for those that are there"
        )
    return scenes

"""scene_files.json of a finished submission: the small files of its scene by digest, to say later what has changed.

A submission names its scene's bytes by one digest, which tells that something is other and not what.
"""

from __future__ import annotations

from contextlib import suppress
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import BaseModel, ConfigDict, Field

from splashbench.errors import SplashbenchError
from splashbench.files import read_model, sha256_file, write_model
from splashbench.scene import Scene

SCENE_FILES = "scene_files.json"
_MAX_FILES = 100
_Digest = Annotated[str, Field(pattern=r"^[0-9a-f]{64}$")]


class SceneFiles(BaseModel):
    """scene_files.json. files: name in the scene's folder -> SHA-256, of the JSON files there."""

    model_config = ConfigDict(extra="forbid")
    schema_version: Literal[1] = 1
    files: dict[Annotated[str, Field(max_length=255)], _Digest] = Field(max_length=_MAX_FILES)


def write_scene_files(directory: Path, scene: Scene) -> None:
    """Write scene_files.json of `scene` into the submission's folder."""
    write_model(Path(directory, SCENE_FILES), SceneFiles(files=_files(scene)))


def _files(scene: Scene) -> dict[str, str]:
    found = [path for path in scene.directory.glob("*.json") if path.is_file() and path.name.isprintable()]
    paths = sorted(found)[:_MAX_FILES]
    return {path.name: sha256_file(path) for path in paths}


def mismatch(scene: Scene, submission: Any, what: str = "submission") -> str:
    """Why `submission`, made for other bytes than those of `scene`, cannot be used with it, and what to do."""
    identity, directory = submission.identity, getattr(submission, "directory", None)
    place = "" if directory is None else f"{directory} "
    if identity.scene != scene.name:
        return (
            f"the {what} {place}of {identity.method} is of scene {identity.scene}, and {scene.directory} is scene "
            f"{scene.name}; give the folder of {identity.scene}, or another {what}"
        )
    return (
        f"the {what} {place}of {identity.method} was made for another version of scene {identity.scene}, not for "
        f"{scene.directory} as it is now: {_changes(scene, directory)}; run the method again, or give the "
        "scene as it was"
    )


def _changes(scene: Scene, submission: Path | None) -> str:
    before = None
    if submission is not None and Path(submission, SCENE_FILES).is_file():
        with suppress(SplashbenchError):
            before = read_model(Path(submission, SCENE_FILES), SceneFiles).files
    if before is None:
        return "its images, masks, cameras, times or scene.json have changed"
    now = _files(scene)
    changed = [f"{name} was changed" for name in sorted(before.keys() & now.keys()) if before[name] != now[name]]
    changed += [f"{name} was added" for name in sorted(now.keys() - before.keys())]
    changed += [f"{name} was removed" for name in sorted(before.keys() - now.keys())]
    if any(line.startswith("scene.json ") for line in changed):
        changed.append("as `splashbench scene place-container` does, which comes before `run`")
    return ", ".join(changed) or "its images or masks were changed"

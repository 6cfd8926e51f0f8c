"""Which files of a folder belong to one recording, of which camera, and of what: told from their names.

Cameras write GX010003.MP4, GX020003.MP4, ...: chapters 1, 2, ... of recording 3 (GH, GL, GP and GOPR likewise, GoPro's
"Camera File Chaptering Information"). A camera is known by the folder its files lie in, or by what stands before the
camera's own name (cam1_GX010003.MP4); what was filmed, from words such as "pour" or "static" in either. What the names
leave open stays open here: `inspection` looks at the frames. A folder that holds photographs and no videos is one
recording.

Not every folder is a camera's. Exports, backups and films of the people at work lie beside them (`strays`).
"""

from __future__ import annotations

import os
import re
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal

from splashbench.errors import SplashbenchError
from splashbench.prepare.video.chapters import split_name

Subject = Literal["intrinsics", "static", "extrinsics", "pour", "sweep"]

_VIDEOS = (".mp4", ".mov", ".m4v", ".mkv", ".avi", ".360")
_LEFT_OUT = ("truth", "prepare", "masks")  # folders that hold no recordings of the session
_PHOTOGRAPHS = (".jpg", ".jpeg", ".png")
_MAX_FILES = 10_000
_WORDS: dict[Subject, tuple[str, ...]] = {
    "intrinsics": ("intrinsics", "intrinsic", "calibration", "calib", "board", "charuco", "checkerboard", "lens"),
    "static": ("static", "background", "empty", "poses"),
    "extrinsics": ("extrinsics", "extrinsic", "placement"),
    "pour": ("pour", "pouring", "liquid", "splash", "fluid", "recording"),
    "sweep": ("sweep", "handheld", "scan", "walk"),
}
# Folders that a camera's card or a tidy person makes, which name no camera.
_PLAIN = re.compile(r"^(cameras?|videos?|raw|dcim|\d{3}gopro|films?|footage|takes?_?\d*)$", re.IGNORECASE)


@dataclass(frozen=True)
class FoundRecording:
    """One recording below a folder.

    Attributes:
        files: its chapters in order, relative to the folder.
        camera: "" where the name tells none.
        subject: what was filmed; None where the name does not say.
    """

    files: tuple[str, ...]
    camera: str
    subject: Subject | None


def find_recordings(folder: Path) -> list[FoundRecording]:
    """All recordings below `folder`, sorted by camera and name. Raises SplashbenchError where there is none."""
    chapters: dict[tuple[str, str, str], list[tuple[int, str]]] = {}
    for path in _video_files(folder):
        relative = path.relative_to(folder)
        before, number, chapter = split_name(path.stem)
        chapters.setdefault((relative.parent.as_posix(), before, number), []).append((chapter, relative.as_posix()))
    if not chapters:
        raise SplashbenchError(
            f"{folder}: no video in it or below it; copy the cameras' files there ({', '.join(_VIDEOS)})"
        )
    recordings = []
    for photographs in _photograph_folders(folder):
        name = photographs.relative_to(folder).as_posix()
        camera, subject = _camera_and_subject(name.split("/"))
        if subject != "pour":
            recordings.append(FoundRecording((name,), camera, subject))
    for (parent, before, number), files in chapters.items():
        # A name that is not a camera's own may itself say what was filmed.
        words = [*([] if parent == "." else parent.split("/")), before if number else files[0][1].split("/")[-1][:-4]]
        camera, subject = _camera_and_subject(words)
        recordings.append(FoundRecording(tuple(name for _, name in sorted(files)), camera, subject))
    return sorted(recordings, key=lambda recording: (natural(recording.camera), recording.files))


def _video_files(folder: Path) -> list[Path]:
    files: list[Path] = []
    for root, folders, names in os.walk(folder):
        folders[:] = sorted(
            name
            for name in folders
            if not name.startswith(".") and not (Path(root) == Path(folder) and name.lower() in _LEFT_OUT)
        )
        files += [Path(root, name) for name in sorted(names) if name.lower().endswith(_VIDEOS) and name[0] != "."]
        if len(files) > _MAX_FILES:
            raise SplashbenchError(f"{folder} holds over {_MAX_FILES} videos; give one session's folder")
    return files


def _photograph_folders(folder: Path) -> list[Path]:
    """Folders that hold photographs and no videos."""
    found: list[Path] = []
    for root, folders, names in os.walk(folder):
        top = Path(root) == Path(folder)
        folders[:] = sorted(
            name
            for name in folders
            if not name.startswith(".") and not (top and any(word in name.lower() for word in _LEFT_OUT))
        )
        visible = [name.lower() for name in names if not name.startswith(".")]
        if not top and not any(name.endswith(_VIDEOS) for name in visible):
            found += [Path(root)] if any(name.endswith(_PHOTOGRAPHS) for name in visible) else []
    return found


def strays(recordings: Sequence[FoundRecording]) -> dict[str, str]:
    """Names that were taken for cameras and are none, with the reason.

    A camera of a session has most of board, static scene and pour. Where others have two of them, one that has a single
    one is no camera; nor is a folder within a camera's folder, or what lies in no folder at all.
    """
    subjects: dict[str, set[Subject]] = {}
    for recording in recordings:
        if recording.subject != "sweep" or recording.camera:
            subjects.setdefault(recording.camera, set()).update({recording.subject} if recording.subject else set())
    complete = [camera for camera, seen in subjects.items() if len(seen) >= 2]
    found: dict[str, str] = {}
    if len(complete) < 2:
        return found
    for camera, seen in subjects.items():
        parent = next((other for other in complete if other != camera and camera.startswith(f"{other}-")), None)
        if not camera:
            found[camera] = "it lies in no camera's folder"
        elif parent is not None:
            found[camera] = f"it lies within the folder of camera {parent}"
        elif len(seen) < 2 and seen != {"sweep"}:
            only = f"only {' '.join(seen)}" if seen else "nothing that is known"
            found[camera] = f"it shows {only}, other cameras have {max(map(len, subjects.values()))} recordings"
    return found


def _camera_and_subject(words: Sequence[str]) -> tuple[str, Subject | None]:
    """What the parts of a path say: the camera's name made of those that name no subject, and the subject."""
    subject: Subject | None = None
    names = []
    for word in words:
        parts = [part for part in re.split(r"[ _.-]+", word) if part]
        rest = []
        for part in parts:
            named = next((name for name, words in _WORDS.items() if part.lower() in words), None)
            if named is None:
                rest.append(part)
            else:
                subject = named
        if len(rest) < len(parts) and all(part.isdigit() for part in rest):
            continue  # "pour 2" is the second pour, not camera 2
        if rest and not _PLAIN.match("_".join(rest)):
            names.append("_".join(rest))
    camera = re.sub(r"[^A-Za-z0-9_-]", "", "-".join(names)).strip("_-")[:64]
    return ("" if subject == "sweep" else camera), subject


def natural(name: str) -> list[tuple[int, int, str]]:
    """Sorts cam2 before cam10."""
    return [(0, int(part), "") if part.isdigit() else (1, 0, part) for part in re.findall(r"\d+|\D+", name)]


def with_subject(recording: FoundRecording, subject: Subject) -> FoundRecording:
    """The recording, known to show `subject`."""
    return replace(recording, subject=subject)


def cameras_of(recordings: Iterable[FoundRecording]) -> list[str]:
    """The names of the cameras, in natural order."""
    return sorted({recording.camera for recording in recordings if recording.subject != "sweep"}, key=natural)

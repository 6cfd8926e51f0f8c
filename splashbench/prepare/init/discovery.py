"""Which files of a folder belong to one recording, of which camera, and of what: told from their names.

Cameras write GX010003.MP4, GX020003.MP4, ...: chapters 1, 2, ... of recording 3 (GH, GL, GP and GOPR likewise, GoPro's
"Camera File Chaptering Information"). A camera is known by the folder its files lie in, or by what stands before the
camera's own name (cam1_GX010003.MP4); what was filmed, from words such as "pour" or "static" in either. What the names
leave open stays open here: `inspection` looks at the frames.
"""

from __future__ import annotations

import os
import re
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal

from splashbench.errors import SplashbenchError

Subject = Literal["intrinsics", "static", "pour", "sweep"]

_VIDEOS = (".mp4", ".mov", ".m4v", ".mkv", ".avi", ".360")
_LEFT_OUT = ("truth", "prepare", "masks")  # folders that hold no recordings of the session
_MAX_FILES = 10_000
_CHAPTER = re.compile(r"^(?P<before>.*?)[ _.-]*(?:G[HXLS](?P<chapter>\d{2})(?P<number>\d{4}))$", re.IGNORECASE)
_FIRST_CHAPTER = re.compile(r"^(?P<before>.*?)[ _.-]*GOPR(?P<number>\d{4})$", re.IGNORECASE)
_LATER_CHAPTER = re.compile(r"^(?P<before>.*?)[ _.-]*GP(?P<chapter>\d{2})(?P<number>\d{4})$", re.IGNORECASE)
_WORDS: dict[Subject, tuple[str, ...]] = {
    "intrinsics": ("intrinsics", "intrinsic", "calibration", "calib", "board", "charuco", "checkerboard", "lens"),
    "static": ("static", "background", "empty", "extrinsics", "extrinsic", "poses"),
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
        before, number, chapter = _split(path.stem)
        chapters.setdefault((relative.parent.as_posix(), before, number), []).append((chapter, relative.as_posix()))
    if not chapters:
        raise SplashbenchError(
            f"{folder}: no video in it or below it; copy the cameras' files there ({', '.join(_VIDEOS)})"
        )
    recordings = []
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


def _split(stem: str) -> tuple[str, str, int]:
    """What stands before a camera's own name, the recording's number in it ("" without one) and the chapter."""
    for pattern in (_CHAPTER, _FIRST_CHAPTER, _LATER_CHAPTER):
        match = pattern.match(stem)
        if match:
            groups = match.groupdict()
            return groups["before"], groups["number"], int(groups.get("chapter") or 0)
    return stem, "", 0


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

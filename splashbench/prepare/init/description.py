"""The first session.toml of a folder of recordings, written by looking at them; a person then checks it.

What cannot be seen is left to be filled in, with a comment that says what: the size of a printed square, above all.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from dataclasses import replace as replace_
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from splashbench import toml
from splashbench.errors import SplashbenchError
from splashbench.files import write_text
from splashbench.prepare.calibration.checkerboard import like_turns
from splashbench.prepare.init.board_guess import BoardGuess, guess_board
from splashbench.prepare.init.discovery import FoundRecording, Subject, cameras_of, find_recordings, strays
from splashbench.prepare.init.inspection import Inspection, MarkerFinder, assign, few_frames, inspect_recording
from splashbench.prepare.session import DESCRIPTION
from splashbench.prepare.session_tables import Board
from splashbench.prepare.video.stills import open_recording
from splashbench.progress import track

_HELD_OUT_SHARE = 2 / 7  # the paper holds out two of seven cameras
_BOARD_FRAMES = 12
_SUBJECTS: tuple[Subject, ...] = ("pour", "static", "intrinsics", "extrinsics")


@dataclass(frozen=True)
class Description:
    """What was described: recordings by subject, the board where one was recognised, what is left to a person."""

    recordings: tuple[FoundRecording, ...]
    cameras: tuple[str, ...]
    board: BoardGuess | None
    to_do: tuple[str, ...]
    path: Path


def describe(folder: Path, square_metres: float | None = None, replace: bool = False) -> Description:
    """Write FOLDER/session.toml by looking at the recordings below FOLDER.

    square_metres: side of one square of the printed board, which no picture tells. Raises SplashbenchError where there
    is a session.toml already (unless `replace`), no video, or a video that cannot be read.
    """
    folder = Path(folder)
    if not folder.is_dir():
        raise SplashbenchError(f"{folder} is not a folder; give the folder with the cameras' files")
    path = folder / DESCRIPTION
    if path.exists() and not replace:
        raise SplashbenchError(f"{path} exists already; edit it, or --replace to write it anew")
    recordings = _with_subjects(folder, find_recordings(folder))
    no_cameras = strays(recordings)
    recordings = [replace_(r, subject=None) if r.camera in no_cameras else r for r in recordings]
    cameras = cameras_of(recording for recording in recordings if recording.subject is not None)
    if len(cameras) < 2:
        raise SplashbenchError(
            f"{folder}: videos of {len(cameras)} cameras were recognised; put every camera's files into a folder of its"
            " name, or its name before theirs (cam1_GX010001.MP4)"
        )
    board = guess_board(_board_images(folder, recordings))
    text, to_do = _text(folder, recordings, cameras, board, square_metres)
    to_do += [
        f"{camera or 'a video'} was not taken for a camera: {reason}; if it is one, add it to session.toml"
        for camera, reason in no_cameras.items()
    ]
    write_text(path, text)
    return Description(tuple(recordings), tuple(cameras), board, tuple(to_do), path)


def _with_subjects(folder: Path, recordings: list[FoundRecording]) -> list[FoundRecording]:
    """Films with what they show; those whose names do not say are looked at."""
    # A clip named for the extrinsics may show a board or the static scene.
    unnamed = [recording for recording in recordings if recording.subject in (None, "extrinsics")]
    inspections: dict[tuple[str, ...], Inspection] = {}
    finder = MarkerFinder()
    board = next((recording for recording in recordings if recording.subject == "intrinsics"), None)
    if unnamed and board is not None:  # sooner here than by trying every kind of marker on recordings without any
        finder.settle(few_frames(open_recording([folder / name for name in board.files])))
    for recording in track(unnamed, "looking at videos"):
        inspections[recording.files] = inspect_recording([folder / name for name in recording.files], finder)
    by_camera: dict[str, list[FoundRecording]] = {}
    for recording in recordings:
        by_camera.setdefault(recording.camera, []).append(recording)
    subjects_told = [recording for group in by_camera.values() for recording in assign(group, inspections)]
    # A second recording of the same subject would be listed as more chapters of the first: the longest stands.
    return _one_of_each(folder, subjects_told)


def _one_of_each(folder: Path, recordings: list[FoundRecording]) -> list[FoundRecording]:
    chosen: dict[tuple[str, Subject], FoundRecording] = {}
    unused: list[FoundRecording] = []
    for recording in recordings:
        if recording.subject is None:
            unused.append(recording)
            continue
        key = (recording.camera, recording.subject)
        if key not in chosen or _bytes(folder, recording) > _bytes(folder, chosen[key]):
            unused += [FoundRecording(chosen[key].files, recording.camera, None)] if key in chosen else []
            chosen[key] = recording
        else:
            unused.append(FoundRecording(recording.files, recording.camera, None))
    return [*chosen.values(), *unused]


def _bytes(folder: Path, recording: FoundRecording) -> int:
    paths = [folder / name for name in recording.files]
    files = [file for path in paths for file in (path.iterdir() if path.is_dir() else [path])]
    return sum(file.stat().st_size for file in files if file.is_file())


def _board_images(folder: Path, recordings: Sequence[FoundRecording]) -> list[NDArray[np.uint8]]:
    """Grey frames of the first camera's board clip."""
    clip = next((recording for recording in recordings if recording.subject == "intrinsics"), None)
    if clip is None:
        return []
    video = open_recording([folder / name for name in clip.files])
    count = len(video.frame_times)
    indices = np.unique(np.linspace(0, count - 1, min(count, _BOARD_FRAMES)).astype(int)).tolist()
    return [cv2.cvtColor(image, cv2.COLOR_RGB2GRAY) for _, image in video.frames(indices)]


def _text(
    folder: Path,
    recordings: Sequence[FoundRecording],
    cameras: Sequence[str],
    board: BoardGuess | None,
    square_metres: float | None,
) -> tuple[str, list[str]]:
    """session.toml, and what a person has to do about it."""
    held_out = max(1, round(_HELD_OUT_SHARE * len(cameras)))
    to_do = []
    name = "".join(letter if letter.isalnum() or letter in "_-" else "_" for letter in folder.resolve().name)
    name = name if name[:1].isalnum() and name.isascii() else "session"
    blocks = [
        "# Written by `splashbench prepare --init` from what it saw; check it, and correct what it got wrong.\n"
        "# The first camera's clock is the scene's. `test` cameras are held out: no reconstruction sees them.\n"
        + toml.dumps(
            {
                "schema_version": 1,
                "name": name[:100],
                "cameras": list(cameras),
                "train": list(cameras[:-held_out]),
                "test": list(cameras[-held_out:]),
                "timesteps": 50,
            }
        )
        + "# motion_interval = [2.1, 3.9]   # seconds on the first camera's clock; found by looking unless given\n"
    ]
    blocks.append(_board_text(board, square_metres))
    if board is None:
        to_do.append("describe the board under [board]: none was recognised, neither ChArUco nor checkerboard")
    elif square_metres is None:
        markers = " and marker_metres" if board.kind == "charuco" else ""
        to_do.append(f"measure one printed square and set square_metres{markers} under [board]")
    if board is not None and board.mirrored:
        to_do.append(
            "the board is seen mirrored: the videos are flipped, or it was printed mirrored; switch flipping off in the"
            " camera, or print the board again, and film once more"
        )
    files_of = {
        subject: {recording.camera: list(recording.files) for recording in recordings if recording.subject == subject}
        for subject in _SUBJECTS
    }
    carried = files_of["extrinsics"]
    lacking = [camera for camera in cameras if camera not in carried]
    is_ambiguous = board is not None and board.kind == "checkerboard" and _looks_alike_turned(board)
    is_placed_by_board = not lacking and not is_ambiguous
    if not is_placed_by_board:
        del files_of["extrinsics"]
        if carried and lacking:
            to_do.append(
                f"the board is carried about for cameras {', '.join(carried)} but not for {', '.join(lacking)}: film it"
                " for all, and add [recordings.extrinsics], or let the static scene place the cameras"
            )
        elif carried:
            to_do.append(
                "the checkerboard looks the same after a half turn, so it cannot place the cameras: film one with an"
                " odd and an even number of squares, or let the static scene place them"
            )
    for subject, listed in files_of.items():
        if listed:
            blocks.append(toml.dumps({"recordings": {subject: {c: listed[c] for c in cameras if c in listed}}}))
        missing = [camera for camera in cameras if camera not in listed]
        if missing:
            to_do.append(
                f"no {subject} recording was recognised for camera {', '.join(missing)}: add [recordings.{subject}]"
            )
    # One that its name calls a sweep before one that merely moves, such as a film of the people at work.
    sweep = sorted((r for r in recordings if r.subject == "sweep"), key=lambda r: (r.camera != "", -_bytes(folder, r)))
    if is_placed_by_board:
        if sweep:
            to_do.append(
                f"the board places the cameras, and the sweep {sweep[0].files[0]} is not used; to have it the other"
                " way, remove [recordings.extrinsics] and add [sweep]"
            )
    elif sweep:
        blocks.append(toml.dumps({"sweep": {"files": list(sweep.pop(0).files)}}))
        if sweep:
            to_do.append(f"{len(sweep) + 1} recordings move like a sweep; check that the right one is listed")
    else:
        to_do.append("no handheld sweep was found; without one the cameras must share enough of the scene")
    blocks.append(toml.dumps({"masks": {"provider": "background"}}))
    listed_not = {None} if is_placed_by_board else {None, "extrinsics"}
    left = [recording for recording in recordings if recording.subject in listed_not]
    unused = [name for recording in [*left, *sweep] for name in recording.files]
    if unused:
        blocks.append("# Not used:\n" + "".join(f"#   {name}\n" for name in unused))
        to_do.append(f"{len(unused)} recordings are not used; they are listed at the end of {DESCRIPTION}")
    return "\n".join(blocks), to_do


def _looks_alike_turned(board: BoardGuess) -> bool:
    layout = Board(kind="checkerboard", squares_x=board.squares_x, squares_y=board.squares_y, square_metres=1.0)
    return len(like_turns(layout)) > 1


def _board_text(board: BoardGuess | None, square_metres: float | None) -> str:
    if board is None:
        return (
            "# [board]                       # the board that was filmed: a ChArUco board\n"
            '# kind = "charuco"              # or "checkerboard", then without marker_metres and dictionary\n'
            "# squares_x = 8\n# squares_y = 5\n# square_metres = 0.03\n# marker_metres = 0.0225\n"
            '# dictionary = "DICT_4X4_50"\n'
        )
    if board.kind == "checkerboard":
        text = toml.dumps({"board": {"kind": board.kind, "squares_x": board.squares_x, "squares_y": board.squares_y}})
        if square_metres is None:
            return text + "# square_metres =               # measure the side of one printed square, in metres\n"
        return text + f"square_metres = {square_metres}\n"
    assert board.marker_share is not None
    text = toml.dumps(
        {
            "board": {
                "squares_x": board.squares_x,
                "squares_y": board.squares_y,
                "dictionary": board.dictionary,
                "legacy": board.legacy,
                "inverted": board.inverted,
            }
        }
    )
    if square_metres is None:
        return text + (
            "# square_metres =               # measure the side of one printed square, in metres\n"
            f"# marker_metres =               # and of one marker: about {board.marker_share} of the square's\n"
        )
    return text + (
        f"square_metres = {square_metres}\n"
        f"marker_metres = {round(square_metres * board.marker_share, 5)}   # seen, to a few percent; measure it\n"
    )

"""A session's description is checked whole before anything is read, and each fault is one line with its remedy."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from splashbench import toml
from splashbench.errors import SplashbenchError
from splashbench.prepare.session import Session


def description() -> dict[str, Any]:
    cameras = ["1", "2", "3"]
    return {
        "schema_version": 1,
        "name": "pour_1",
        "cameras": cameras,
        "train": ["1", "2"],
        "test": ["3"],
        "board": {
            "squares_x": 8,
            "squares_y": 5,
            "square_metres": 0.03,
            "marker_metres": 0.0225,
            "dictionary": "DICT_4X4_50",
        },
        "recordings": {
            kind: {camera: [f"cameras/{camera}/{kind}/GX010003.MP4"] for camera in cameras}
            for kind in ("pour", "static", "intrinsics")
        },
        "sweep": {"files": ["sweep/GX010001.MP4"]},
        "masks": {"provider": "background"},
    }


def write(directory: Path, data: dict[str, Any]) -> Path:
    """A session folder in which every file named inside it exists."""
    names = [name for kind in data["recordings"].values() for chapters in kind.values() for name in chapters]
    for name in names + data.get("sweep", {}).get("files", []):
        path = (directory / name).resolve()
        if path.is_relative_to(directory.resolve()):
            path.parent.mkdir(parents=True, exist_ok=True)
            path.touch()
    (directory / "session.toml").write_text(toml.dumps(data))
    return directory


def test_a_good_session_opens(tmp_path: Path) -> None:
    data = description()
    data["recordings"]["pour"]["2"].append("cameras/2/pour/GX020003.MP4")
    session = Session.open(write(tmp_path, data))
    assert session.directory == tmp_path
    assert session.timesteps == 50
    assert session.reference == "1"
    assert session.board is not None
    assert not session.board.legacy
    assert [path.name for path in session.paths("pour", "2")] == ["GX010003.MP4", "GX020003.MP4"]
    assert session.sweep_paths == (tmp_path / "sweep/GX010001.MP4",)
    assert session.mask_folder is None


def test_sweep_board_and_clips_of_it_are_optional(tmp_path: Path) -> None:
    data = description()
    del data["sweep"], data["board"], data["masks"], data["recordings"]["intrinsics"]
    session = Session.open(write(tmp_path, data))
    assert session.sweep_paths == ()
    with pytest.raises(SplashbenchError, match=r"camera 1 has no intrinsics recording; list its files"):
        session.paths("intrinsics", "1")


def test_a_marker_and_a_measured_distance(tmp_path: Path) -> None:
    data = description()
    data["marker"] = {"dictionary": "DICT_4X4_50", "id": 30, "metres": 0.12}
    data["distance"] = {"cameras": ["1", "3"], "metres": 1.32}
    session = Session.open(write(tmp_path, data))
    assert session.marker is not None
    assert session.marker.id == 30
    assert session.distance is not None
    assert session.distance.cameras == ["1", "3"]


def test_a_folder_of_masks(tmp_path: Path) -> None:
    data = description() | {"masks": {"provider": "folder", "folder": "truth/masks"}}
    write(tmp_path, data)
    with pytest.raises(SplashbenchError, match=r"truth/masks \(the mask folder\) does not exist"):
        Session.open(tmp_path)
    (tmp_path / "truth/masks").mkdir(parents=True)
    assert Session.open(tmp_path).mask_folder == tmp_path / "truth/masks"


def test_a_missing_file_is_named_with_its_camera(tmp_path: Path) -> None:
    write(tmp_path, description())
    (tmp_path / "cameras/2/static/GX010003.MP4").unlink()
    with pytest.raises(
        SplashbenchError, match=r"cameras/2/static/GX010003\.MP4 .*static recording of camera 2.*restore"
    ):
        Session.open(tmp_path)


def edit(*keys: str, value: Any = None) -> Callable[[dict[str, Any]], None]:
    """A change to the description: the entry at `keys` set to `value`, or removed."""

    def change(data: dict[str, Any]) -> None:
        for key in keys[:-1]:
            data = data[key]
        if value is None:
            del data[keys[-1]]
        else:
            data[keys[-1]] = value

    return change


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (edit("recordings", "pour", "2"), r"camera 2 has no entry in \[recordings\.pour\]; add its files"),
        (edit("recordings", "static", "9", value=["x.MP4"]), r"\[recordings\.static\] names camera 9"),
        (edit("train", value=["1"]), "train and test must name every one"),
        (edit("test", value=["2", "3"]), "train and test must name every one"),
        (edit("cameras", value=["1", "1", "3"]), "named twice"),
        (
            edit("recordings", "pour", "2", value=["2.MP4", "./2.MP4"]),
            r"\./2\.MP4 is listed twice in \[recordings\.pour\]",
        ),
        (edit("sweep", value={"files": ["2.MP4", "2.MP4"]}), r"2\.MP4 is listed twice in \[sweep\]"),
        (edit("cameras", value=["1", "../x", "3"]), "must consist of letters"),
        (edit("board"), r"needs the \[board\]"),
        (edit("board", "marker_metres", value=0.03), "smaller than square_metres"),
        (edit("board", "marker_metres"), "ChArUco board needs marker_metres and dictionary; give both, or kind ="),
        (edit("board", "dictionary"), "ChArUco board needs marker_metres and dictionary"),
        (edit("board", "kind", value="chessboard"), r"board\.kind"),
        (edit("board", "kind", value="checkerboard"), "checkerboard has no marker_metres, dictionary or legacy; leave"),
        (
            edit("board", value={"kind": "checkerboard", "squares_x": 8, "squares_y": 3, "square_metres": 0.03}),
            "at least 4 squares each way; count squares, not inner corners",
        ),
        (edit("board", "colour", value="red"), r"board\.colour"),
        (edit("marker", value={"dictionary": "DICT_4X4_50", "id": 30, "metres": 0.0}), r"marker\.metres"),
        (edit("distance", value={"cameras": ["1", "9"], "metres": 1.3}), r"\[distance\] names camera 9"),
        (edit("distance", value={"cameras": ["1", "1"], "metres": 1.3}), "two different cameras"),
        (edit("distance", value={"cameras": ["1"], "metres": 1.3}), r"distance\.cameras"),
        (edit("schema_version", value=2), "schema_version"),
        (edit("timesteps", value=1), "timesteps"),
        (edit("motion_interval", value=[3.0, 2.0]), "start before end"),
        (edit("masks", value={"provider": "folder"}), "folder must be given"),
        (edit("masks", value={"provider": "magic"}), r"masks\.provider"),
        (edit("recordings", "pour", "1", value=[]), r"recordings\.pour\.1"),
        (edit("recordings", "pour", "1", value=["../elsewhere.MP4"]), "lies outside the session; copy the file into"),
        (edit("recordings", "pour", "1", value=["/etc/hostname"]), "lies outside the session"),
        (edit("name", value="a/b"), "name"),
    ],
)
def test_faults_are_one_line_naming_the_file(
    tmp_path: Path, change: Callable[[dict[str, Any]], None], message: str
) -> None:
    data = description()
    change(data)
    write(tmp_path, data)
    with pytest.raises(SplashbenchError, match=message) as caught:
        Session.open(tmp_path)
    assert str(tmp_path / "session.toml") in str(caught.value)
    assert "\n" not in str(caught.value)


def test_a_checkerboard_has_no_markers(tmp_path: Path) -> None:
    data = description()
    data["board"] = {"kind": "checkerboard", "squares_x": 8, "squares_y": 5, "square_metres": 0.06}
    board = Session.open(write(tmp_path, data)).board
    assert board is not None
    assert board.kind == "checkerboard"
    assert board.marker_metres is None


@pytest.mark.parametrize("kind", ["intrinsics", "static", "sweep"])
def test_photographs_may_stand_for_video_but_not_for_the_pour(tmp_path: Path, kind: str) -> None:
    data = description()
    write(tmp_path, data)
    (tmp_path / "photographs").mkdir()
    if kind == "sweep":
        data["sweep"]["files"] = ["photographs"]
    else:
        data["recordings"][kind]["2"] = ["photographs"]
    (tmp_path / "session.toml").write_text(toml.dumps(data))
    session = Session.open(tmp_path)
    paths = session.sweep_paths if kind == "sweep" else session.paths(kind, "2")  # type: ignore[arg-type]
    assert paths == (tmp_path / "photographs",)
    data["recordings"]["pour"]["2"] = ["photographs"]
    (tmp_path / "session.toml").write_text(toml.dumps(data))
    with pytest.raises(
        SplashbenchError, match=r"photographs \(the pour recording of camera 2\) is a folder; only video"
    ):
        Session.open(tmp_path)


def test_a_link_out_of_the_session_is_refused(tmp_path: Path) -> None:
    inside = write(tmp_path / "session", description())
    (tmp_path / "secret.MP4").touch()
    chapter = inside / "cameras/1/pour/GX010003.MP4"
    chapter.unlink()
    chapter.symlink_to(tmp_path / "secret.MP4")
    with pytest.raises(SplashbenchError, match="lies outside the session"):
        Session.open(inside)


def test_no_folder_and_no_description(tmp_path: Path) -> None:
    with pytest.raises(SplashbenchError, match=r"nowhere is not a folder"):
        Session.open(tmp_path / "nowhere")
    with pytest.raises(SplashbenchError, match=r"session\.toml does not exist"):
        Session.open(tmp_path)


def test_container_masks_come_from_a_folder_within_the_session(tmp_path: Path) -> None:
    data = description()
    data["masks"]["container_folder"] = "container"
    with pytest.raises(SplashbenchError, match=r"the folder of container masks"):
        Session.open(write(tmp_path, data))
    (tmp_path / "container").mkdir()
    assert Session.open(tmp_path).container_folder == tmp_path / "container"
    data["masks"]["container_folder"] = "../container"
    with pytest.raises(SplashbenchError, match=r"\.\./container"):
        Session.open(write(tmp_path, data))

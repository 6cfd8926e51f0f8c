"""`prepare --init`: whose recording of what, from names and from looking; the board; what is left to a person."""

from __future__ import annotations

import shutil
from pathlib import Path

import av
import cv2
import numpy as np
import pytest

from splashbench import toml
from splashbench.cli.main import main
from splashbench.errors import SplashbenchError
from splashbench.files import write_png
from splashbench.prepare.init.board_guess import guess_board
from splashbench.prepare.init.description import describe
from splashbench.prepare.init.discovery import FoundRecording, find_recordings
from splashbench.prepare.init.inspection import Inspection, MarkerFinder, assign, inspect_recording

BOARD = cv2.aruco.CharucoBoard((8, 5), 0.03, 0.0225, cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_5X5_50))


def touch(folder: Path, *names: str) -> None:
    for name in names:
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).touch()


def write_clip(path: Path, images: list[np.ndarray]) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    with av.open(str(path), "w", format="mp4") as container:
        stream = container.add_stream("libx264", rate=30, options={"crf": "10", "preset": "ultrafast"})
        stream.height, stream.width = images[0].shape[:2]
        stream.pix_fmt = "yuv420p"
        for image in images:
            for packet in stream.encode(av.VideoFrame.from_ndarray(image, format="rgb24")):
                container.mux(packet)
        for packet in stream.encode(None):
            container.mux(packet)


def scenery(width: int = 320, height: int = 180, seed: int = 0) -> np.ndarray:
    rng = np.random.default_rng(seed)
    coarse = rng.integers(40, 200, (height // 12, width // 12, 3)).astype(np.uint8)
    return cv2.resize(coarse, (width, height), interpolation=cv2.INTER_CUBIC)


def with_board(tilt: float, shift: float, legacy_board: cv2.aruco.CharucoBoard = BOARD) -> np.ndarray:
    """The board in a 640x360 picture, tilted and shifted."""
    print_ = cv2.cvtColor(legacy_board.generateImage((640, 400), marginSize=20), cv2.COLOR_GRAY2RGB)
    corners = np.float32([[0, 0], [640, 0], [640, 400], [0, 400]])
    seen = np.float32([[100, 60], [470, 60 + 60 * tilt], [470, 300 - 60 * tilt], [100, 300]]) + np.float32([shift, 0])
    homography = cv2.getPerspectiveTransform(corners, seen)
    return cv2.warpPerspective(print_, homography, (640, 360), dst=scenery(640, 360), borderMode=cv2.BORDER_TRANSPARENT)


def test_a_folder_per_camera_and_subject(tmp_path: Path) -> None:
    touch(
        tmp_path,
        "cameras/10/pour/GX020003.MP4",
        "cameras/10/pour/GX010003.MP4",
        "cameras/10/intrinsics/GX010001.MP4",
        "cameras/2/static/GX010002.MP4",
        "sweep/GX010001.MP4",
        "cameras/2/pour/GL010003.LRV",
        "truth/pour.mp4",
        ".trash/pour.mp4",
    )
    assert find_recordings(tmp_path) == [
        FoundRecording(("sweep/GX010001.MP4",), "", "sweep"),
        FoundRecording(("cameras/2/static/GX010002.MP4",), "2", "static"),
        FoundRecording(("cameras/10/intrinsics/GX010001.MP4",), "10", "intrinsics"),
        FoundRecording(("cameras/10/pour/GX010003.MP4", "cameras/10/pour/GX020003.MP4"), "10", "pour"),
    ]


@pytest.mark.parametrize(
    ("names", "camera", "subject", "chapters"),
    [
        (("cam1_GX010007.MP4", "cam1_GX020007.MP4"), "cam1", None, 2),
        (("left/DCIM/100GOPRO/GOPR0004.MP4", "left/DCIM/100GOPRO/GP010004.MP4"), "left", None, 2),
        (("pour/cam-3.mov",), "cam_3", "pour", 1),
        (("cam3_pour.mp4",), "cam3", "pour", 1),
        (("3/calibration.MOV",), "3", "intrinsics", 1),
        (("GH010001.MP4",), "", None, 1),
        (("take 2/cam 1/GX010004.MP4",), "cam_1", None, 1),
        (("cam1/pour 2/GX010004.MP4",), "cam1", "pour", 1),
    ],
)
def test_ways_to_name_files(
    tmp_path: Path, names: tuple[str, ...], camera: str, subject: str | None, chapters: int
) -> None:
    touch(tmp_path, *names)
    (recording,) = find_recordings(tmp_path)
    assert (recording.camera, recording.subject, len(recording.files)) == (camera, subject, chapters)
    assert recording.files == names


def test_no_video_is_one_line(tmp_path: Path) -> None:
    touch(tmp_path, "notes.txt")
    with pytest.raises(SplashbenchError, match="no video in it"):
        find_recordings(tmp_path)


def recording(name: str, subject: str | None = None) -> FoundRecording:
    return FoundRecording((name,), "1", subject)


def test_subjects_are_told_from_inspections() -> None:
    inspections = {
        ("a",): Inspection(seconds=20, marker_share=0.9, marker_travel=0.4, change=25, shift=0.01),
        ("b",): Inspection(seconds=5, marker_share=1.0, marker_travel=0.0, change=0.5, shift=0.0),
        ("c",): Inspection(seconds=60, marker_share=0.0, marker_travel=0.0, change=9, shift=0.0),
        ("d",): Inspection(seconds=30, marker_share=0.0, marker_travel=0.0, change=9, shift=0.0),
    }
    shown = {f.files[0]: f.subject for f in assign([recording(name) for name in "dcba"], inspections)}
    assert shown == {"a": "intrinsics", "b": "static", "c": "pour", "d": None}
    # Names outweigh inspections.
    shown = {
        f.files[0]: f.subject for f in assign([recording("c", "static"), recording("d"), recording("a")], inspections)
    }
    assert shown == {"c": "static", "d": "pour", "a": "intrinsics"}
    moving = {("s",): Inspection(seconds=40, marker_share=0.4, marker_travel=0.5, change=30, shift=0.1)}
    assert assign([recording("s")], moving)[0].subject == "sweep"


def test_looks_tell_rest_board_and_travel(tmp_path: Path) -> None:
    still = scenery(320, 180)
    write_clip(tmp_path / "still.mp4", [still] * 12)
    wide = scenery(960, 180)
    write_clip(tmp_path / "sweep.mp4", [np.ascontiguousarray(wide[:, 20 * k : 20 * k + 320]) for k in range(12)])
    write_clip(tmp_path / "board.mp4", [with_board(0.3, 12.0 * k) for k in range(12)])
    rest, travel, board = (
        inspect_recording([tmp_path / f"{name}.mp4"], MarkerFinder()) for name in ("still", "sweep", "board")
    )
    assert (rest.marker_share, rest.change < 2, rest.shift < 0.005) == (0, True, True)
    assert travel.shift > 0.03
    assert board.marker_share == 1
    assert board.marker_travel > 0.1


@pytest.mark.parametrize(("legacy", "inverted"), [(False, False), (False, True), (True, False)])
def test_the_board_is_recognised(legacy: bool, inverted: bool) -> None:
    board = cv2.aruco.CharucoBoard((7, 6), 0.03, 0.02, cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_5X5_50))
    board.setLegacyPattern(legacy)
    images = [cv2.cvtColor(with_board(0.1 * k, 5.0 * k, board), cv2.COLOR_RGB2GRAY) for k in range(5)]
    found = guess_board([255 - image for image in images] if inverted else images)
    assert found is not None
    assert (found.squares_x, found.squares_y, found.dictionary) == (7, 6, "DICT_5X5_50")
    assert (found.legacy, found.inverted) == (legacy, inverted)
    assert found.marker_share == pytest.approx(2 / 3, abs=0.04)


def test_no_board_no_guess() -> None:
    assert guess_board([cv2.cvtColor(scenery(640, 360, seed), cv2.COLOR_RGB2GRAY) for seed in range(4)]) is None


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    session = tmp_path / "monday"
    for camera in ("cam1", "cam2", "cam3"):
        write_clip(session / camera / "intrinsics/GX010001.MP4", [with_board(0.2, 10.0 * k) for k in range(5)])
        write_clip(session / camera / "static/GX010002.MP4", [scenery()] * 5)
        write_clip(session / camera / "GX010003.MP4", [scenery(seed=k) for k in range(6)])
    return session


def test_a_session_is_described(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["prepare", str(folder), "--init", "--square-metres", "0.03"]) == 0
    described = toml.load(folder / "session.toml")
    assert (described["train"], described["test"]) == (["cam1", "cam2"], ["cam3"])
    assert (described["board"]["squares_x"], described["board"]["squares_y"]) == (8, 5)
    assert described["board"]["marker_metres"] == pytest.approx(0.0225, rel=0.06)
    assert described["recordings"]["pour"]["cam2"] == ["cam2/GX010003.MP4"]
    assert "no handheld sweep" in capsys.readouterr().err
    # It is a session: what prepare finds wanting is in the recordings, not in their description.
    assert main(["prepare", str(folder), str(folder.parent / "scene")]) == 1
    assert "has no audio track" in capsys.readouterr().err
    assert main(["prepare", str(folder), "--init"]) == 1
    assert "exists already; edit it" in capsys.readouterr().err


@pytest.fixture
def with_extrinsics(folder: Path) -> Path:
    for camera in ("cam1", "cam2", "cam3"):
        write_clip(folder / camera / "extrinsics/GX010004.MP4", [with_board(0.2, 10.0 * k) for k in range(5)])
    return folder


def test_a_board_that_is_carried_for_all_cameras_places_them(with_extrinsics: Path) -> None:
    from splashbench.prepare.session import Session

    write_clip(with_extrinsics / "sweep/GX010009.MP4", [scenery()] * 4)
    found = describe(with_extrinsics, 0.03)
    recordings = Session.open(with_extrinsics).recordings
    assert recordings.extrinsics == {c: [f"{c}/extrinsics/GX010004.MP4"] for c in found.cameras}
    assert recordings.static["cam2"] == ["cam2/static/GX010002.MP4"]
    (told,) = (line for line in found.to_do if "sweep" in line)
    assert "the board places the cameras, and the sweep sweep/GX010009.MP4 is not used" in told
    assert "#   sweep/GX010009.MP4" in (with_extrinsics / "session.toml").read_text()


def test_a_board_that_is_carried_for_some_cameras_is_told(with_extrinsics: Path) -> None:
    shutil.rmtree(with_extrinsics / "cam3/extrinsics")
    found = describe(with_extrinsics, 0.03)
    assert "extrinsics" not in toml.load(with_extrinsics / "session.toml")["recordings"]
    assert any("carried about for cameras cam1, cam2 but not for cam3" in line for line in found.to_do)
    assert "#   cam2/extrinsics/GX010004.MP4" in (with_extrinsics / "session.toml").read_text()


@pytest.mark.slow
def test_a_checkerboard_that_looks_alike_after_a_half_turn_places_nothing(tmp_path: Path) -> None:
    from splashbench.prepare.session import Session

    session = tmp_path / "monday"
    for camera in ("cam1", "cam2"):
        for k in range(6):
            board = checkerboard(0.1 * k, 12.0 * k, squares=(8, 6))
            for kind in ("intrinsics", "extrinsics"):
                write_png(session / camera / f"{kind}/IMG_{k}.png", board)
            write_png(session / camera / f"static/IMG_{k}.png", scenery(640, 360))
        write_clip(session / camera / "pour/GX010003.MP4", [scenery(640, 360, seed=k) for k in range(6)])
    found = describe(session, 0.03)
    assert Session.open(session).recordings.extrinsics == {}
    assert any("looks the same after a half turn" in line for line in found.to_do)


def test_a_second_clip_of_a_still_scene_that_is_named_for_the_extrinsics_is_not_used() -> None:
    rest = {"seconds": 5.0, "marker_share": 0.0, "marker_travel": 0.0, "change": 0.5, "shift": 0.0}
    shown = assign([recording("a", "static"), recording("b", "extrinsics")], {("b",): Inspection(**rest)})
    assert {f.files[0]: f.subject for f in shown}["a"] == "static"
    assert "extrinsics" not in {f.subject for f in shown}


def test_a_clip_named_for_the_extrinsics_without_a_board_is_the_static_one(folder: Path) -> None:
    for camera in ("cam1", "cam2", "cam3"):
        (folder / camera / "static").rename(folder / camera / "extrinsics")
    describe(folder, 0.03)
    recordings = toml.load(folder / "session.toml")["recordings"]
    assert recordings["static"] == {c: [f"{c}/extrinsics/GX010002.MP4"] for c in ("cam1", "cam2", "cam3")}
    assert "extrinsics" not in recordings


def test_of_two_board_clips_without_a_name_the_closer_one_is_for_the_lens() -> None:
    carried = {"marker_share": 0.9, "marker_travel": 0.3, "change": 20.0, "shift": 0.0}
    inspections = {
        ("far",): Inspection(seconds=90, board_size=0.15, **carried),
        ("near",): Inspection(seconds=20, board_size=0.5, **carried),
        ("pour",): Inspection(seconds=30, marker_share=0.0, marker_travel=0.0, change=9, shift=0.0),
    }
    shown = assign([recording(name) for name in ("far", "near", "pour")], inspections)
    assert {f.files[0]: f.subject for f in shown} == {"near": "intrinsics", "far": "extrinsics", "pour": "pour"}


def test_what_cannot_be_seen_is_left_to_a_person(folder: Path) -> None:
    (folder / "cam3/static/GX010002.MP4").unlink()
    found = describe(folder)
    assert any("measure one printed square" in line for line in found.to_do)
    assert any("no static recording was recognised for camera cam3" in line for line in found.to_do)
    with pytest.raises(SplashbenchError, match=r"session\.toml: board\.square_metres: Field required"):
        from splashbench.prepare.session import Session

        Session.open(folder)


def test_one_camera_is_no_session(tmp_path: Path) -> None:
    write_clip(tmp_path / "GX010003.MP4", [scenery(seed=k) for k in range(6)])
    with pytest.raises(SplashbenchError, match="put every camera's files into a folder of its name"):
        describe(tmp_path)
    assert not (tmp_path / "session.toml").exists()


@pytest.mark.parametrize(
    "arguments",
    [["--init", "scene"], ["--square-metres", "0.03", "scene"], [], ["--init", "--square-metres", "wide"]],
)
def test_wrong_usage(tmp_path: Path, arguments: list[str], capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as stopped:
        main(["prepare", str(tmp_path), *arguments])
    assert stopped.value.code == 2
    assert "prepare" in capsys.readouterr().err


def test_a_folder_that_is_no_cameras_invents_none(folder: Path) -> None:
    """Exports, a camera's old takes and a film of the people at work lie about in most sessions."""
    busy = []
    for k in range(6):
        busy.append(cv2.circle(scenery(), (60 + 30 * k, 90), 12, (250, 20 * k, 20), -1))
    for name in ("exports/preview.mp4", "cam1/old/GX010007.MP4", "people.mp4"):
        write_clip(folder / name, busy)
    found = describe(folder, 0.03)
    assert found.cameras == ("cam1", "cam2", "cam3")
    told = " ".join(found.to_do)
    assert "exports-preview was not taken for a camera: it shows only" in told
    assert "cam1-old was not taken for a camera: it lies within the folder of camera cam1" in told
    assert "# Not used:" in (folder / "session.toml").read_text()
    assert toml.load(folder / "session.toml")["recordings"]["pour"]["cam1"] == ["cam1/GX010003.MP4"]


def test_links_that_lead_nowhere_are_passed_over(folder: Path) -> None:
    write_png(folder / "sweep/IMG_0.png", scenery())
    (folder / "sweep/notes.txt").symlink_to("/nowhere")
    found = describe(folder, 0.03)
    assert found.cameras == ("cam1", "cam2", "cam3")


def checkerboard(tilt: float, shift: float, squares: tuple[int, int] = (8, 5)) -> np.ndarray:
    """A board in a 640x360 picture, tilted and shifted."""
    cells = (np.indices(squares[::-1]).sum(0) % 2 * 255).astype(np.uint8)
    print_ = cv2.copyMakeBorder(cells.repeat(60, 0).repeat(60, 1), 30, 30, 30, 30, cv2.BORDER_CONSTANT, value=255)
    height, width = print_.shape
    corners = np.float32([[0, 0], [width, 0], [width, height], [0, height]])
    seen = np.float32([[100, 60], [470, 60 + 40 * tilt], [470, 300 - 40 * tilt], [100, 300]]) + np.float32([shift, 0])
    homography = cv2.getPerspectiveTransform(corners, seen)
    return cv2.warpPerspective(
        cv2.cvtColor(print_, cv2.COLOR_GRAY2RGB),
        homography,
        (640, 360),
        dst=scenery(640, 360),
        borderMode=cv2.BORDER_TRANSPARENT,
    )


def test_checkerboards_and_photographs_are_described(tmp_path: Path) -> None:
    from splashbench.prepare.session import Session

    session = tmp_path / "monday"
    for camera in ("cam1", "cam2"):
        for k in range(6):
            write_png(session / camera / f"intrinsics/IMG_{k}.png", checkerboard(0.1 * k, 12.0 * k))
            write_png(session / camera / f"static/IMG_{k}.png", scenery(640, 360))
        write_clip(session / camera / "GX010003.MP4", [scenery(640, 360, seed=k) for k in range(6)])
    found = describe(session, 0.03)
    described = toml.load(session / "session.toml")
    assert described["board"] == {"kind": "checkerboard", "squares_x": 8, "squares_y": 5, "square_metres": 0.03}
    assert described["recordings"]["intrinsics"] == {c: [f"{c}/intrinsics"] for c in ("cam1", "cam2")}
    assert described["recordings"]["static"] == {c: [f"{c}/static"] for c in ("cam1", "cam2")}
    assert described["recordings"]["pour"]["cam1"] == ["cam1/GX010003.MP4"]
    assert found.cameras == ("cam1", "cam2")
    Session.open(session)


def test_photographs_without_a_telling_name_are_looked_at(tmp_path: Path) -> None:
    for k in range(6):
        write_png(tmp_path / f"a/{k}.png", checkerboard(0.1 * k, 14.0 * k))
        write_png(tmp_path / f"b/{k}.png", scenery(640, 360))
    board, rest = (inspect_recording([tmp_path / name], MarkerFinder()) for name in "ab")
    shown = assign([recording("a"), recording("b")], {("a",): board, ("b",): rest})
    assert {f.files[0]: f.subject for f in shown} == {"a": "intrinsics", "b": "static"}


def test_a_mirrored_board_is_told() -> None:
    images = [np.ascontiguousarray(cv2.cvtColor(with_board(0.1 * k, 5.0 * k), cv2.COLOR_RGB2GRAY)) for k in range(5)]
    plain, mirrored = guess_board(images), guess_board([np.ascontiguousarray(image[:, ::-1]) for image in images])
    assert plain is not None
    assert mirrored is not None
    assert (plain.mirrored, mirrored.mirrored) == (False, True)
    assert (mirrored.squares_x, mirrored.squares_y) == (8, 5)

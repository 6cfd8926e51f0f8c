"""All of `splashbench prepare`: unusable recordings each give one line and no scene, a synthetic session gives a scene.

The clips here are tiny and show a moving square over a shared noise: enough for the clocks and the motion, not for a
lens.
"""

from __future__ import annotations

import json
import os
import shutil
from fractions import Fraction
from pathlib import Path

import av
import numpy as np
import pytest
import trimesh
from scipy.spatial.transform import Rotation

from splashbench import toml
from splashbench.cli.main import main
from splashbench.errors import SplashbenchError
from splashbench.files import write_png
from splashbench.prepare.pipeline import PrepareOptions, prepare
from splashbench.prepare.video.recording import Recording
from splashbench.scene import look_at
from splashbench.synth.recording.video import SensorNoise, write_recording

WIDTH, HEIGHT, FPS, RATE = 128, 72, 30, 48000
CAMERAS = ("1", "2", "3")


def write_clip(path: Path, seconds: float = 4.0, sound: np.ndarray | None = None, size=(WIDTH, HEIGHT)) -> None:
    """A square that starts to fall after 1.5 s and stops after 3 s; `sound` float mono at 48 kHz, or none."""
    path.parent.mkdir(parents=True, exist_ok=True)
    rng = np.random.default_rng(5)
    width, height = size
    scenery = rng.integers(60, 180, (height // 4, width // 4, 3)).astype(np.uint8).repeat(4, 0).repeat(4, 1)
    with av.open(str(path), "w", format="mp4") as container:
        video = container.add_stream("libx264", rate=FPS, options={"crf": "12", "preset": "ultrafast"})
        video.width, video.height, video.pix_fmt = width, height, "yuv420p"
        track = container.add_stream("aac", rate=RATE, layout="mono") if sound is not None else None
        for k in range(round(seconds * FPS)):
            image = scenery.copy()
            fallen = round(float(np.clip((k / FPS - 1.5) / 1.5, 0, 1)) * (height - 24))
            if k / FPS > 1.5:
                image[fallen : fallen + 20, 40:60] = (20, 40, 220)
            for packet in video.encode(av.VideoFrame.from_ndarray(image, format="rgb24")):
                container.mux(packet)
        if track is not None:
            for start in range(0, len(sound), 1024):
                frame = av.AudioFrame.from_ndarray(sound[None, start : start + 1024], format="fltp", layout="mono")
                frame.sample_rate, frame.pts, frame.time_base = RATE, start, Fraction(1, RATE)
                for packet in track.encode(frame):
                    container.mux(packet)
        for stream in (video, *([track] if track is not None else [])):
            for packet in stream.encode(None):
                container.mux(packet)


@pytest.fixture(scope="module")
def template(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A session that is well-formed, but whose board clips show no board."""
    directory = tmp_path_factory.mktemp("session")
    sound = (0.2 * np.random.default_rng(9).standard_normal(RATE * 5)).astype(np.float32)
    recordings: dict[str, dict[str, list[str]]] = {"pour": {}, "static": {}, "intrinsics": {}}
    for k, camera in enumerate(CAMERAS):
        for kind in recordings:
            name = f"cameras/{camera}/{kind}.MP4"
            shift = 4000 * k
            write_clip(
                directory / name,
                seconds=4.0 if kind == "pour" else 0.5,
                sound=sound[shift : shift + 4 * RATE] if kind == "pour" else None,
            )
            recordings[kind][camera] = [name]
    description = {
        "schema_version": 1,
        "name": "tiny",
        "cameras": list(CAMERAS),
        "train": ["1", "2"],
        "test": ["3"],
        "timesteps": 10,
        "board": {
            "squares_x": 8,
            "squares_y": 5,
            "square_metres": 0.03,
            "marker_metres": 0.0225,
            "dictionary": "DICT_4X4_50",
        },
        "recordings": recordings,
    }
    (directory / "session.toml").write_text(toml.dumps(description))
    return directory


@pytest.fixture
def session(template: Path, tmp_path: Path) -> Path:
    return Path(shutil.copytree(template, tmp_path / "session"))


def edit(session: Path, **changes) -> None:
    description = toml.load(session / "session.toml")
    for key, value in changes.items():
        if value is None:
            del description[key]
        else:
            description[key] = value
    (session / "session.toml").write_text(toml.dumps(description))


def fails(session: Path, pattern: str, options: PrepareOptions | None = None) -> None:
    scene = session.parent / "scene"
    with pytest.raises(SplashbenchError, match=pattern) as caught:
        prepare(session, scene, options)
    assert "\n" not in str(caught.value)
    assert not scene.exists()
    assert [path.name for path in session.parent.iterdir()] == ["session"]


def test_a_clip_without_the_board_is_named(session: Path) -> None:
    # Clocks and motion are found before, so this also shows that the rest of the session is sound.
    fails(session, r"cameras/1/intrinsics\.MP4: the 8x5 ChArUco board is usable in 0 of 15 frames")


def test_a_recording_without_sound_is_named(session: Path) -> None:
    write_clip(session / "cameras/2/pour.MP4")
    fails(session, r"cameras/2/pour\.MP4.*(sound|audio)")


def test_a_silent_recording_is_named(session: Path) -> None:
    write_clip(session / "cameras/2/pour.MP4", sound=np.zeros(4 * RATE, np.float32))
    fails(session, r"cameras/2/pour\.MP4 \(camera 2\) cannot be synchronised: its audio is silent")


def test_unrelated_sound_is_named(session: Path) -> None:
    other = (0.2 * np.random.default_rng(77).standard_normal(4 * RATE)).astype(np.float32)
    write_clip(session / "cameras/3/pour.MP4", sound=other)
    fails(session, r"cameras/3/pour\.MP4 \(camera 3\) cannot be synchronised: its audio does not match")


@pytest.mark.parametrize("kind", ["pour", "intrinsics"])
def test_a_truncated_file_is_named(session: Path, kind: str) -> None:
    path = session / f"cameras/1/{kind}.MP4"
    path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])
    fails(session, rf"cameras/1/{kind}\.MP4")


def test_a_missing_file_is_named(session: Path) -> None:
    (session / "cameras/3/static.MP4").unlink()
    fails(session, r"cameras/3/static\.MP4 .*does not exist")


def test_a_camera_left_out_of_a_table_is_named(session: Path) -> None:
    recordings = toml.load(session / "session.toml")["recordings"]
    del recordings["pour"]["2"]
    edit(session, recordings=recordings)
    fails(session, r"session\.toml.*camera 2 has no entry in \[recordings\.pour\]")


def test_recordings_that_calibration_needs_are_asked_for(session: Path) -> None:
    recordings = toml.load(session / "session.toml")["recordings"]
    edit(session, recordings={"pour": recordings["pour"], "intrinsics": recordings["intrinsics"]})
    fails(session, r"session\.toml: camera 1 has no static recording")
    edit(session, recordings={"pour": recordings["pour"]}, board=None)
    fails(session, r"session\.toml: no \[board\]")


def test_only_the_own_unfinished_scene_is_removed(session: Path) -> None:
    """The note in the work folder may come from a stranger."""
    victim = session.parent / "elsewhere" / ".tmp-01234567-scene"
    victim.mkdir(parents=True)
    left = session.parent / ".tmp-89abcdef-scene"
    left.mkdir()
    with pytest.raises(SplashbenchError):
        prepare(session, session.parent / "scene")  # makes the work folder
    for note in (str(victim).encode(), b"\xff\xfe", str(left).encode()):
        (session / "prepare/unfinished_scene.txt").write_bytes(note)
        with pytest.raises(SplashbenchError):
            prepare(session, session.parent / "scene")
    assert victim.is_dir()
    assert not left.exists()


@pytest.mark.parametrize("what", ["note", "stage folder", "camera", "pipe"])
def test_nothing_is_written_or_deleted_through_links_in_the_work_folder(session: Path, what: str) -> None:
    """It comes with the session, which may be a stranger's."""
    with pytest.raises(SplashbenchError):
        prepare(session, session.parent / "scene")  # makes the work folder
    mine = session.parent / "mine"
    (mine / "1").mkdir(parents=True)
    (mine / "letter.txt").write_text("dear")
    (mine / "1" / "letter.txt").write_text("dear")
    work = session / "prepare"
    shutil.rmtree(work / "intrinsics", ignore_errors=True)
    if what == "note":
        (work / "unfinished_scene.txt").unlink(missing_ok=True)
        (work / "unfinished_scene.txt").symlink_to(mine / "letter.txt")
    elif what == "stage folder":
        (work / "intrinsics").symlink_to(mine, target_is_directory=True)
    elif what == "camera":
        (work / "intrinsics").mkdir()
        (work / "intrinsics" / "1.json").symlink_to(mine / "letter.txt")
    else:
        (work / "sync.json").unlink(missing_ok=True)
        os.mkfifo(work / "sync.json")
    with pytest.raises(SplashbenchError, match="is a link, pipe or device, which no stored result is; remove it"):
        prepare(session, session.parent / "scene")
    assert [path.read_text() for path in sorted(mine.rglob("letter.txt"))] == ["dear", "dear"]


def test_a_scene_may_have_a_name_that_is_no_text(session: Path) -> None:
    place = session.parent / os.fsdecode(b"caf\xe9")
    place.mkdir()
    with pytest.raises(SplashbenchError, match="ChArUco"):
        prepare(session, place / "scene")
    assert list(place.iterdir()) == []


def test_links_in_a_circle_are_a_file_that_does_not_exist(session: Path) -> None:
    path = session / "cameras/1/pour.MP4"
    path.unlink()
    path.symlink_to(path.name)
    fails(session, r"cameras/1/pour\.MP4 .*does not exist")


def test_chapters_of_a_board_clip_are_of_one_size(session: Path) -> None:
    write_clip(session / "cameras/1/other.MP4", seconds=1.0, size=(2 * WIDTH, 2 * HEIGHT))
    recordings = toml.load(session / "session.toml")["recordings"]
    recordings["intrinsics"]["1"] = ["cameras/1/intrinsics.MP4", "cameras/1/other.MP4"]
    edit(session, recordings=recordings)
    fails(session, r"cameras/1/other\.MP4 differs in size or codec from .*intrinsics\.MP4")


def test_options_of_a_scene_are_refused_where_none_is_made(session: Path, capsys: pytest.CaptureFixture[str]) -> None:
    for words in (["--timesteps", "9"], ["--masks", "background"], ["--no-crop"], ["--work", "elsewhere"]):
        with pytest.raises(SystemExit) as caught:
            main(["prepare", str(session), "--init", *words])
        assert caught.value.code == 2
        assert f"{words[0]} would do nothing" in capsys.readouterr().err


def test_faults_of_later_stages_are_told_first(session: Path, tmp_path: Path) -> None:
    def fault(pattern: str, **changes) -> None:
        edit(session, **changes)
        with pytest.raises(SplashbenchError, match=pattern):
            prepare(session, tmp_path / "scene")
        assert not (session / "prepare/sync.json").exists()

    (session / "bowl.ply").write_text("no mesh")
    (session / "bowls").mkdir()
    fault(r"bowl\.ply is not a readable mesh", container={"mesh": "bowl.ply", "masks": "bowls"})
    trimesh.creation.box().export(session / "bowl.ply")
    fault("0 training cameras have a container mask")
    write_png(session / "bowls/1.png", np.zeros((4, 4), np.uint8))
    fault(r"bowls/1\.png is 4x4, the recording is 128x72")
    for name, content in (("1", np.full((72, 128), 255, np.uint8)), ("2", np.zeros((72, 128), np.uint8))):
        write_png(session / f"bowls/{name}.png", content)
    fault(r"1 training camera has a container mask .* that is not empty, two are needed")
    clicks = [{"point": [k, 0, k * k], "pixels": {"1": [10 + k, 900 * (k == 2)]}} for k in range(3)]
    fault(r"point 3 lies at \(12, 900\) in camera 1", container={"mesh": "bowl.ply", "points": clicks})
    fault(r"unknown marker dictionary", container=None, marker={"dictionary": "DICT_NOPE", "id": 1, "metres": 0.1})
    fault(r"has no marker 77", marker={"dictionary": "DICT_4X4_50", "id": 77, "metres": 0.1})
    for name, number in (("DICT_4X4_1000", 3), ("DICT_4X4_50", 19)):
        fault(rf"marker {number} .* is also on the board", marker={"dictionary": name, "id": number, "metres": 0.1})
    fault(r"sam3", marker=None, masks={"provider": "sam3", "checkpoint": "nowhere/sam3"})


def test_a_folder_that_is_no_session(session: Path) -> None:
    (session / "session.toml").unlink()
    fails(session, r"session\.toml does not exist")


def test_an_existing_scene_is_kept_unless_told_otherwise(session: Path) -> None:
    scene = session.parent / "scene"
    scene.mkdir()
    (scene / "notes.txt").write_text("mine")
    with pytest.raises(SplashbenchError, match="exists already"):
        prepare(session, scene)
    with pytest.raises(SplashbenchError, match="no earlier output"):
        prepare(session, scene, PrepareOptions(replace=True))
    (scene / "train_meta.json").touch()
    with pytest.raises(SplashbenchError, match="ChArUco"):
        prepare(session, scene, PrepareOptions(replace=True))
    assert (scene / "notes.txt").read_text() == "mine"


def test_command_line_exit_statuses(session: Path, capsys: pytest.CaptureFixture[str]) -> None:
    scene = str(session.parent / "scene")
    assert main(["prepare", str(session), scene]) == 1
    assert capsys.readouterr().err.splitlines()[-1].startswith("error: ")
    assert main(["prepare", str(session), scene, "--interval", "3", "2"]) == 1
    assert "START before END" in capsys.readouterr().err
    for wrong in (["--timesteps", "1"], ["--interval", "1"], ["--image-format", "bmp"]):
        with pytest.raises(SystemExit) as caught:
            main(["prepare", str(session), scene, *wrong])
        assert caught.value.code == 2
    capsys.readouterr()
    with pytest.raises(SystemExit) as caught:
        main(["prepare", "--help"])
    assert caught.value.code == 0
    assert "splashbench prepare sessions/monday scenes/monday" in capsys.readouterr().out


@pytest.fixture(scope="module")
def synthetic(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A synthetic session with exact ground truth, smaller than the default."""
    directory = tmp_path_factory.mktemp("synthetic") / "session"
    assert main(["synth", "session", str(directory), "--fps", "30", "--particle-radius", "0.004"]) == 0
    return directory


@pytest.mark.slow
def test_a_synthetic_session_becomes_a_scene(synthetic: Path, tmp_path: Path) -> None:
    from splashbench.scene import Scene

    out = tmp_path / "scene"
    preparation = prepare(synthetic, out, PrepareOptions(timesteps=20))
    assert [gate.name for gate in preparation.warnings] == []
    scene = Scene.open(out)
    assert scene.n_frames == 20
    assert (scene.train, scene.test) == (("1", "2", "3", "4", "5"), ("6", "7"))
    assert scene.metres_per_unit == 1.0
    np.testing.assert_allclose(scene.gravity, [0.0, -1.0, 0.0])
    assert scene.initial_points().shape[1] == 7
    for camera in scene.cameras.values():
        assert camera.width % 8 == 0
        assert scene.image(camera.name, 10).shape == (camera.height, camera.width, 3)
        assert scene.mask(camera.name, 10).any()

    truth = json.loads((synthetic / "truth/truth.json").read_text())
    report = json.loads((out / "prepare_report.json").read_text())
    for camera, known in truth["cameras"].items():
        focal = np.array(report["intrinsics"][camera]["K"])[[0, 1], [0, 1]]
        np.testing.assert_allclose(focal, np.array(known["K"])[[0, 1], [0, 1]], rtol=0.01)
        clock = report["sync"][camera]
        for local in (1.0, 3.0):
            found = clock["start_s"] + clock["clock_rate"] * local
            assert abs(found - known["start_s"] - known["clock_rate"] * local) < 1e-3
    # Distances between cameras need no common frame.
    found, known = (
        np.array([_centre(matrices[camera]["w2c"]) for camera in truth["cameras"]])
        for matrices in (report["poses"], truth["cameras"])
    )
    spans = [np.linalg.norm(centres[:, None] - centres[None], axis=-1).sum() for centres in (found, known)]
    assert abs(spans[0] / spans[1] - 1) < 0.005
    page = (out / "prepare_report.html").read_text()
    assert page.count("data:image/png;base64,") == 4
    assert page.count("data:image/jpeg;base64,") == 1
    assert "http" not in page


@pytest.mark.slow
def test_only_what_changed_is_done_again(synthetic: Path, tmp_path: Path) -> None:
    session = Path(shutil.copytree(synthetic, tmp_path / "session"))
    shutil.rmtree(session / "prepare", ignore_errors=True)  # of other tests
    options = PrepareOptions(timesteps=5)
    first = prepare(session, tmp_path / "first", options)
    again = prepare(session, tmp_path / "again", options)
    assert [stage for stage, record in first.stages.items() if record.reused] == []
    assert [stage for stage, record in again.stages.items() if not record.reused] == ["scene"]
    assert contents(tmp_path / "again") == contents(tmp_path / "first")

    masks = prepare(session, tmp_path / "masks", PrepareOptions(timesteps=5, again_from="masks"))
    assert [stage for stage, record in masks.stages.items() if not record.reused] == ["masks", "scene"]
    assert contents(tmp_path / "masks") == contents(tmp_path / "first")

    # The container is new, and the sound's source shifts clocks, hence frames, hence masks; nothing else is touched.
    container = {"mesh": "truth/container.ply", "masks": "truth/container_masks"}
    edit(session, container=container, sound={"source": [0.6, 0.1, 0.2]})
    changed = prepare(session, tmp_path / "changed", options)
    redone = [stage for stage, record in changed.stages.items() if not record.reused]
    assert set(redone) == {"motion", "metric", "container", "masks", "scene"}
    assert changed.sound_paths.applied
    reach = {camera: changed.sound_paths.distance_m[camera] for camera in changed.clocks}
    for camera, clock in changed.clocks.items():
        moved = clock.start_s - first.clocks[camera].start_s
        assert moved == pytest.approx((reach[camera] - reach["1"]) / 343.0, abs=1e-9)
    assert changed.container is not None
    assert min(seen.iou for seen in changed.container.projections.values()) > 0.99
    names = {gate.name for gate in changed.warnings}
    assert not {name for name in names if name.startswith("container")}
    from splashbench.scene import Scene

    mesh = Scene.open(tmp_path / "changed").container_mesh()
    assert mesh is not None
    page = (tmp_path / "changed/prepare_report.html").read_text()
    assert page.count("data:image/jpeg;base64,") == 1 + 7


def contents(folder: Path) -> dict[str, bytes]:
    return {str(path.relative_to(folder)): path.read_bytes() for path in sorted(folder.rglob("*")) if path.is_file()}


@pytest.mark.slow
def test_a_folder_of_masks_whole_frames_and_a_given_interval(synthetic: Path, tmp_path: Path) -> None:
    from splashbench.scene import Scene

    options = PrepareOptions(
        masks=str(synthetic / "truth/masks"), timesteps=5, interval=(2.2, 3.0), crop=False, image_format="jpg"
    )
    prepare(synthetic, tmp_path / "scene", options)
    scene = Scene.open(tmp_path / "scene")
    assert {(camera.width, camera.height) for camera in scene.cameras.values()} == {(480, 270)}
    assert (tmp_path / "scene/ims/1/000004.jpg").is_file()
    np.testing.assert_allclose(scene.times[[0, -1]], [2.2, 3.0], atol=0.02)


@pytest.mark.slow
def test_a_camera_that_cannot_be_posed_is_named(synthetic: Path, tmp_path: Path) -> None:
    session = Path(shutil.copytree(synthetic, tmp_path / "session"))
    static = toml.load(session / "session.toml")["recordings"]["static"]["4"][0]
    write_clip(session / static, seconds=0.5, size=(480, 270))  # something else altogether
    fails(session, "no pose for camera 4;")


@pytest.mark.slow
def test_a_camera_that_was_bumped_after_its_static_clip_stops_it(synthetic: Path, tmp_path: Path) -> None:
    """Two pixels of 480; the sound session's own shifts stand in its report."""
    session = Path(shutil.copytree(synthetic, tmp_path / "session"))
    static = session / toml.load(session / "session.toml")["recordings"]["static"]["4"][0]
    frames = [np.roll(frame, (0, 2), (0, 1)) for _, frame in Recording([static]).frames(range(10))]
    static.unlink()
    write_recording(static, (frame for frame in frames), 30, np.zeros(16000, np.float32))
    pattern = r"camera_shift is 2\.\d+, at most 0\.5 is needed \(.*camera 4: start .*camera 4 moved between its static"
    fails(session, pattern, PrepareOptions(timesteps=5))
    stillness = json.loads((session / "prepare/poses/stillness.json").read_text())["result"]
    still = [s["px"] for camera, seen in stillness.items() if camera != "4" for s in seen.values()]
    assert max(still) < 0.1


class BoardBeforeTheRig:
    """The board held up before the rig of the synthetic session, in `count` places, tilted."""

    def __init__(self, count: int) -> None:
        from splashbench.synth.imaging.geometry import LOOK_AT
        from splashbench.synth.recording.plan import RecordingOptions, make_plan

        self.rng = np.random.default_rng(3)
        self.recorders = make_plan(RecordingOptions(fps=30, particle_radius=0.004)).recorders
        middle = np.mean([recorder.camera.center for recorder in self.recorders.values()], axis=0)
        self._facing = look_at(middle, LOOK_AT)[:3, :3].T  # of a print held up to it: x right, y down
        places = [(self.rng.normal(0, 0.35, 3), self.rng.uniform(-0.12, 0.12, 3)) for _ in range(count)]
        self.turns, self.centres = (np.array(values) for values in zip(*places, strict=True))
        self.centres = self.centres + LOOK_AT

    def pose(self, place: float) -> np.ndarray:
        """Board to world [4, 4] at a place, or on the way from one to the next: still about each, and smooth."""
        from splashbench.synth.recording.plan import BOARD

        k = min(int(place), len(self.turns) - 2)
        on = np.clip((place - k - 0.2) / 0.6, 0, 1)
        on = on * on * (3 - 2 * on)
        turn, centre = ((1 - on) * values[k] + on * values[k + 1] for values in (self.turns, self.centres))
        board = np.eye(4)
        board[:3, :3] = self._facing @ Rotation.from_rotvec(turn).as_matrix()
        board[:3, 3] = centre - board[:3, :3] @ [4 * BOARD["square_metres"], 2.5 * BOARD["square_metres"], 0]
        return board

    def photograph(self, session: Path) -> dict[str, list[str]]:
        """A photograph of every place by every camera, the n-th of all cameras together; the recordings."""
        from splashbench.synth.recording.board_clip import board_images
        from splashbench.synth.recording.plan import BOARD

        for name, recorder in self.recorders.items():
            poses = [recorder.camera.w2c @ self.pose(k) for k in range(len(self.turns))]
            noise = SensorNoise(480, 270, (1, int(name)))
            for k, image in enumerate(board_images(recorder.camera, BOARD, poses, self.rng)):
                write_png(session / f"cameras/{name}/extrinsics/{k:02d}.png", noise.expose(image))
        return {name: [f"cameras/{name}/extrinsics"] for name in self.recorders}

    def film(self, session: Path, seconds_a_place: float) -> dict[str, list[str]]:
        """A video by every camera, each by its own clock and with irregular claps to be heard; the recordings."""
        from splashbench.synth.recording.audio import Microphone, clap, record
        from splashbench.synth.recording.board_clip import board_images
        from splashbench.synth.recording.plan import BOARD

        seconds = seconds_a_place * (len(self.turns) - 1)
        claps = [
            clap(np.random.default_rng((7, k)), float(at), np.array([0.3, 0.4, -0.2]))
            for k, at in enumerate(np.sort(self.rng.uniform(0.5, seconds - 0.5, round(seconds))))
        ]
        for name, recorder in self.recorders.items():
            start, rate = 0.37 * float(recorder.start_s), recorder.clock_rate
            times = start + rate * np.arange(round((seconds - start) * 30)) / 30
            poses = (recorder.camera.w2c @ self.pose(max(0.0, time) / seconds_a_place) for time in times)
            noise = SensorNoise(480, 270, (2, int(name)))
            images = board_images(recorder.camera, BOARD, list(poses), self.rng)
            ear = Microphone(recorder.camera.center, start, rate, seed=(8, int(name)))
            sound = record(ear, claps, len(times) / 30)
            path = session / f"cameras/{name}/extrinsics/GX010004.MP4"
            write_recording(path, (noise.expose(image) for image in images), 30, sound)
        return {name: [f"cameras/{name}/extrinsics/GX010004.MP4"] for name in self.recorders}


@pytest.mark.slow
@pytest.mark.parametrize("way", ["photographs", "videos"])
def test_a_board_that_all_see_places_the_cameras_without_a_sweep(synthetic: Path, tmp_path: Path, way: str) -> None:
    session = Path(shutil.copytree(synthetic, tmp_path / "session"))
    board = BoardBeforeTheRig(25 if way == "photographs" else 13)
    recordings = toml.load(session / "session.toml")["recordings"]
    recordings["extrinsics"] = board.photograph(session) if way == "photographs" else board.film(session, 1.2)
    edit(session, recordings=recordings)
    with pytest.raises(SplashbenchError, match=r"places the cameras by the board; leave out that or \[sweep\]"):
        prepare(session, tmp_path / "scene")
    edit(session, sweep=None)
    preparation = prepare(session, tmp_path / "scene", PrepareOptions(timesteps=5))
    placed = {"camera_shift", "cameras_posed", "mean_reprojection", "centre_sigma", "board_residual", "scale_agreement"}
    assert placed <= {gate.name for gate in preparation.gates if gate.passed}
    assert preparation.metric.scale_source == "extrinsics"
    assert set(preparation.metric.scales) == {"extrinsics", "board"}
    truth = json.loads((synthetic / "truth/truth.json").read_text())["cameras"]
    found, known = (
        np.array([_centre(matrices[camera]) for camera in truth])
        for matrices in (preparation.poses.w2c, {camera: value["w2c"] for camera, value in truth.items()})
    )
    # The scene's frame is the world's up to a rigid motion: its scale is the board's.
    turn, _ = Rotation.align_vectors(known - known.mean(0), found - found.mean(0))
    off = np.linalg.norm(turn.apply(found - found.mean(0)) + known.mean(0) - known, axis=1)
    sigma = np.array([preparation.poses.centre_sigma[camera] for camera in truth])
    print(f"centres off by {off * 1e3} mm, said {sigma * 1e3} mm")
    assert off.max() < 5e-3
    assert np.sqrt(np.mean((off / sigma) ** 2)) < 2
    assert preparation.metric.scale_disagreement is not None
    assert preparation.metric.scale_disagreement < 0.01


def _centre(w2c: list[list[float]]) -> np.ndarray:
    matrix = np.array(w2c)
    return -matrix[:3, :3].T @ matrix[:3, 3]


def test_masks_folder_option_must_be_a_folder(session: Path, tmp_path: Path) -> None:
    write_png(tmp_path / "masks.png", np.zeros((4, 4), np.uint8))
    from splashbench.prepare.masks.session_masks import choose_provider
    from splashbench.prepare.session import Session

    with pytest.raises(SplashbenchError, match=r"masks\.png is not a folder of masks"):
        choose_provider(Session.open(session), str(tmp_path / "masks.png"), {}, {}, 0.0)

"""A synthetic session is complete, readable by `prepare`, and agrees with its own truth."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from splashbench.cli.main import main
from splashbench.errors import SplashbenchError
from splashbench.files import read_gray
from splashbench.prepare.session import Session
from splashbench.prepare.video.recording import Recording
from splashbench.synth.recording.audio import SAMPLE_RATE, SPEED_OF_SOUND, clap, interpolate
from splashbench.synth.recording.plan import CAMERAS, CHAPTERED, RecordingOptions, make_plan
from splashbench.synth.recording.session import make_session
from splashbench.synth.recording.truth import Truth
from splashbench.synth.recording.video import write_recording

av = pytest.importorskip("av")


def recording(session: Path, camera: str) -> list[Path]:
    return sorted((session / "cameras" / camera / "pour").glob("*.MP4"))


def audio_of(files: list[Path]) -> np.ndarray:
    """The first channel of all chapters on the recording's local clock; a chapter lasts as long as its video."""
    tracks = []
    for file in files:
        with av.open(str(file)) as container:
            video = container.streams.video[0]
            length = round(float(video.duration * video.time_base) * SAMPLE_RATE)
            frames = list(container.decode(audio=0))
        assert frames[0].pts == 0
        tracks.append(np.concatenate([frame.to_ndarray()[0] for frame in frames])[:length])
    return np.concatenate(tracks)


@pytest.fixture(scope="module")
def truth(small_session: Path) -> Truth:
    return Truth(small_session)


def test_prepare_reads_the_session(small_session: Path) -> None:
    session = Session.open(small_session)
    assert tuple(session.cameras) == CAMERAS
    assert list(session.train) == ["1", "2", "3", "4", "5"]
    assert list(session.test) == ["6", "7"]


def test_every_listed_file_is_there_and_decodes(small_session: Path) -> None:
    files = sorted(small_session.rglob("*.MP4"))
    assert len(files) == 3 * 7 + 1 + 1  # three recordings per camera, one of them in two chapters, and the sweep
    for file in files:
        with av.open(str(file)) as container:
            assert container.streams.video[0].codec_context.name == "h264"
            assert container.streams.audio[0].codec_context.name == "aac"
            assert container.metadata["creation_time"].startswith("2024-05-04T")
            frame = next(container.decode(video=0))
            assert (frame.width, frame.height) == (128, 72)


def test_chapters_join_without_a_gap(small_session: Path) -> None:
    chapters = recording(small_session, CHAPTERED)
    assert [file.name for file in chapters] == ["GX010003.MP4", "GX020003.MP4"]
    recorder = make_plan(
        RecordingOptions(size=(128, 72), fps=20, seed=3, duration=0.7, particle_radius=0.005)
    ).recorders["3"]
    counts = []
    for file in chapters:
        with av.open(str(file)) as container:
            counts.append(sum(1 for _ in container.decode(video=0)))
    assert sum(counts) == recorder.n_frames
    assert len(audio_of(chapters)) == recorder.n_frames * SAMPLE_RATE // 20


@pytest.mark.parametrize("camera", CAMERAS)
def test_the_clap_is_heard_when_clock_and_distance_say(small_session: Path, truth: Truth, camera: str) -> None:
    facts = truth.file.cameras[camera]
    sound = truth.file.sound
    distance = np.linalg.norm(np.array(sound.clap_position) - facts.camera().center)
    track = audio_of(recording(small_session, camera))
    # What the clap's own samples would look like on this camera's clock, if it were heard at its true time.
    burst = clap(np.random.default_rng([truth.file.seed, 4]), sound.clap_time_s, np.array(sound.clap_position))
    local = np.arange(len(track)) / SAMPLE_RATE
    common = facts.start_s + facts.clock_rate * local - distance / SPEED_OF_SOUND
    expected = interpolate(burst.samples, (common - burst.start_s) * SAMPLE_RATE)
    n = 2 * len(track)
    correlation = np.fft.irfft(np.fft.rfft(track, n) * np.conj(np.fft.rfft(expected, n)), 16 * n)
    peak = int(np.argmax(correlation))
    lag = (peak - 16 * n if peak > 8 * n else peak) / 16 / SAMPLE_RATE
    assert abs(lag) < 20e-6


@pytest.mark.parametrize("camera", ["1", "4", "7"])
def test_true_particles_lie_in_the_true_masks_of_the_distorted_frames(
    small_session: Path, truth: Truth, camera: str
) -> None:
    facts = truth.file.cameras[camera]
    lens = facts.camera()
    inside, compared = 0, 0
    for path in sorted((small_session / "truth" / "masks" / camera).glob("*.png")):
        time = facts.start_s + facts.clock_rate * int(path.stem) / facts.fps
        if time > truth.file.pour.end_s:
            continue
        positions, _, active = truth.particles_at(np.array([time]))
        mask = read_gray(path) > 127
        # Above the bowl nothing can hide the liquid. One pixel of grace: the mask counts whole pixels.
        above = active[0] & (positions[0, :, 1] > 0.11)
        uv, _ = lens.project(positions[0, above].astype(np.float64))
        pixel = np.floor(uv).astype(int)
        visible = ((pixel >= 1) & (pixel < np.array([lens.width - 1, lens.height - 1]))).all(axis=1)
        for u, v in pixel[visible]:
            inside += bool(mask[v - 1 : v + 2, u - 1 : u + 2].any())
            compared += 1
    assert compared > 300
    assert inside / compared > 0.97


def test_masks_exist_exactly_from_the_first_liquid_on(small_session: Path, truth: Truth) -> None:
    first = []
    for camera, facts in truth.file.cameras.items():
        frames = [int(path.stem) for path in (small_session / "truth" / "masks" / camera).glob("*.png")]
        assert sorted(frames) == list(range(min(frames), max(frames) + 1))
        first.append(facts.start_s + facts.clock_rate * min(frames) / facts.fps)
        assert (read_gray(small_session / "truth" / "container_masks" / f"{camera}.png") > 127).sum() > 300
    assert min(first) == pytest.approx(truth.file.pour.start_s)
    assert truth.file.pour.end_s == pytest.approx(1.8 + 0.7)


def test_liquid_changes_the_frames_where_the_mask_says(small_session: Path) -> None:
    """Frame numbers of masks and of the video are the same numbers."""
    with av.open(str(recording(small_session, "2")[0])) as container:
        frames = [frame.to_ndarray(format="rgb24").astype(float) for frame in container.decode(video=0)]
    masks = sorted((small_session / "truth" / "masks" / "2").glob("*.png"))
    background = np.mean(frames[: int(masks[0].stem) - 1], axis=0)
    for path in masks[3::4]:
        mask = read_gray(path) > 127
        difference = np.abs(frames[int(path.stem)] - background).max(axis=2)
        assert np.median(difference[mask]) > 40
        assert np.median(difference[~mask]) < 6


def test_colours_come_back_as_they_were_filmed(tmp_path: Path) -> None:
    """A file that does not state its matrix is decoded by another, with a cast of ten levels."""
    blue, brown = (20, 60, 180), (212, 172, 133)
    image = np.zeros((64, 96, 3), np.uint8)
    image[:, :48], image[:, 48:] = blue, brown
    write_recording(tmp_path / "a.mp4", [image] * 3, 30, np.zeros(4800, np.float32))
    (_, seen), *_ = Recording([tmp_path / "a.mp4"]).frames()
    assert np.abs(seen[10:54, 10:40].astype(int) - blue).max() <= 3
    assert np.abs(seen[10:54, 58:86].astype(int) - brown).max() <= 3


def test_a_frame_of_the_board_shows_the_board(small_session: Path) -> None:
    with av.open(str(small_session / "cameras" / "1" / "intrinsics" / "GX010001.MP4")) as container:
        frames = [frame.to_ndarray(format="gray") for frame in container.decode(video=0)]
    assert len(frames) == 200
    held = [np.abs(frames[k + 1].astype(float) - frames[k]).mean() for k in range(10)]
    assert held[4] > 5 > max(held[:4])  # a pose is held five frames


def test_the_same_seed_decides_the_same_and_another_does_not() -> None:
    def digest(seed: int) -> str:
        plan = make_plan(RecordingOptions(seed=seed))
        return json.dumps(
            [[r.start_s, r.clock_rate, r.camera.K.tolist(), r.camera.w2c.tolist()] for r in plan.recorders.values()]
            + [plan.pour.azimuth_degrees, plan.sources[1].samples[:100].tolist()]
        )

    assert digest(5) == digest(5)
    assert digest(5) != digest(6)


def test_clocks_differ_as_real_ones_do() -> None:
    recorders = make_plan(RecordingOptions()).recorders
    assert (recorders["1"].start_s, recorders["1"].clock_rate) == (0.0, 1.0)
    assert recorders["4"].clock_rate == pytest.approx(1 - 49e-6)
    assert recorders["7"].clock_rate == pytest.approx(1 - 81e-6)
    starts = [r.start_s for r in recorders.values()]
    assert 1.0 < max(starts) - min(starts) <= 2.0
    assert min(starts) < 0 < max(starts)


def test_an_existing_folder_is_kept(tmp_path: Path) -> None:
    (tmp_path / "mine").mkdir()
    (tmp_path / "mine" / "precious").touch()
    with pytest.raises(SplashbenchError, match="exists already"):
        make_session(tmp_path / "mine", RecordingOptions())
    assert (tmp_path / "mine" / "precious").exists()


@pytest.mark.parametrize(
    "arguments", [["--size", "481x270"], ["--fps", "2"], ["--duration", "0"], ["--particle-radius", "1"]]
)
def test_settings_that_cannot_work_are_refused(
    arguments: list[str], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["synth", "session", str(tmp_path / "out"), *arguments]) == 1
    assert capsys.readouterr().err.startswith(f"error: {arguments[0]}")
    assert not (tmp_path / "out").exists()


def test_a_missing_library_leaves_nothing_behind(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    from splashbench.synth.liquid import simulation

    def refuse() -> None:
        def load(name: str) -> None:
            raise OSError(name)

        check(load)

    check = simulation.check_libraries
    monkeypatch.setattr(simulation, "check_libraries", refuse)
    assert main(["synth", "session", str(tmp_path / "out")]) == 1
    error = capsys.readouterr().err
    assert "libgl1 and libx11-6" in error
    assert error.count("\n") == 1
    assert list(tmp_path.iterdir()) == []


@pytest.mark.slow
def test_the_default_session_can_be_calibrated(tmp_path: Path) -> None:
    """At the default size the boards are read in every camera, and the lenses come back to within 0.3 %."""
    import cv2

    from splashbench.synth.imaging.texture import charuco_board
    from splashbench.synth.recording.plan import BOARD

    session = make_session(tmp_path / "session", RecordingOptions())
    facts = Truth(session).file.cameras
    board = charuco_board(BOARD)
    detector = cv2.aruco.CharucoDetector(board)

    def frames(camera: str, kind: str) -> list[np.ndarray]:
        (file,) = (session / "cameras" / camera / kind).glob("*.MP4")
        with av.open(str(file)) as container:
            return [frame.to_ndarray(format="gray") for frame in container.decode(video=0)]

    for camera in CAMERAS:
        _, ids, _, _ = detector.detectBoard(frames(camera, "static")[30])
        assert ids is not None
        assert len(ids) >= 10
        objects, images = [], []
        for image in frames(camera, "intrinsics")[2::5]:
            corners, ids, _, _ = detector.detectBoard(image)
            if ids is not None and len(ids) >= 8:
                on_board, in_image = board.matchImagePoints(corners, ids)
                objects.append(on_board.reshape(-1, 1, 3).astype(np.float32))
                images.append(in_image.reshape(-1, 1, 2).astype(np.float32))
        assert len(objects) >= 35
        found = cv2.calibrateCameraExtended(objects, images, (480, 270), None, None, flags=cv2.CALIB_FIX_K3)
        assert found[1][0, 0] == pytest.approx(facts[camera].K[0][0], rel=3e-3)
        assert found[1][1, 1] == pytest.approx(facts[camera].K[1][1], rel=3e-3)

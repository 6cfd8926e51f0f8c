"""Recordings are read frame for frame and sample for sample, whatever the encoder and the camera did to the file."""

from __future__ import annotations

import os
import shutil
from fractions import Fraction
from pathlib import Path

import av
import numpy as np
import pytest

from splashbench.errors import SplashbenchError
from splashbench.prepare.media.reading import probe, scan
from splashbench.prepare.video.recording import Recording

RATE = 48000
B_FRAMES = {"bf": "3", "g": "12", "crf": "20"}


def picture(number: int, width: int = 160, height: int = 96) -> np.ndarray:
    """A frame that differs from every other one everywhere: a moving gradient with the number in its brightness."""
    y, x = np.mgrid[:height, :width]
    return np.stack([(x + 5 * number) % 256, (2 * y + 3 * number) % 256, np.full_like(x, 2 * number % 256)], -1).astype(
        np.uint8
    )


def write_video(
    path: Path,
    n: int,
    fps: int = 30,
    codec: str = "libx264",
    options: dict[str, str] | None = None,
    sound: np.ndarray | None = None,
    sound_start: float = 0.0,
    video_start: int = 0,
    first_picture: int = 0,
    container: dict[str, str] | None = None,
    rotation: int = 0,
) -> Path:
    """Encode `n` pictures, and `sound` (mono, 48 kHz) as AAC if given."""
    path.parent.mkdir(parents=True, exist_ok=True)
    with av.open(str(path), "w", options=container or {}) as out:
        video = out.add_stream(codec, rate=fps, options=options or B_FRAMES)
        video.width, video.height, video.pix_fmt = 160, 96, "yuv420p"
        if rotation:
            video.set_display_rotation(rotation)
        if sound is not None:
            audio = out.add_stream("aac", rate=RATE, layout="mono")
            audio.bit_rate = 192000
        packets = []
        for number in range(n):
            frame = av.VideoFrame.from_ndarray(picture(first_picture + number), format="rgb24")
            frame.pts, frame.time_base = number + video_start, Fraction(1, fps)
            packets += video.encode(frame)
        packets += video.encode(None)
        if sound is not None:
            block = av.AudioFrame.from_ndarray(sound[None].astype(np.float32), format="fltp", layout="mono")
            block.sample_rate, block.pts, block.time_base = RATE, round(sound_start * RATE), Fraction(1, RATE)
            packets += audio.encode(block)
            packets += audio.encode(None)
        for packet in sorted(packets, key=lambda p: float(p.dts * p.time_base)):
            out.mux(packet)
    return path


def click(at: float, seconds: float) -> np.ndarray:
    """Silence with one sharp click at a known time."""
    sound = np.zeros(round(seconds * RATE), np.float32)
    sound[round(at * RATE)] = 0.9
    return sound


def click_time(recording: Recording) -> float:
    """Where the click is on the recording's clock: centre of its energy."""
    samples, start = recording.audio(RATE)
    power = np.square(samples.astype(np.float64))
    return start + float(power @ np.arange(len(samples)) / power.sum()) / RATE


def sequential(path: Path) -> list[np.ndarray]:
    """The frames as the plainest decoding loop gives them."""
    with av.open(str(path)) as container:
        return [frame.to_ndarray(format="rgb24") for frame in container.decode(video=0)]


@pytest.mark.parametrize(
    ("codec", "options"),
    [
        ("libx264", B_FRAMES),
        ("libx264", {"bf": "3", "g": "24", "crf": "20", "x264-params": "open-gop=1:scenecut=0:b-pyramid=normal"}),
        ("libx264", {"bf": "0", "g": "300"}),
        ("libx265", {"x265-params": "open-gop=1:keyint=24:bframes=4:log-level=none:pools=1:frame-threads=1"}),
        ("libx265", {"x265-params": "open-gop=0:keyint=24:bframes=4:log-level=none:pools=1:frame-threads=1"}),
        ("mpeg4", {}),
    ],
)
def test_frames_equal_a_sequential_decode(tmp_path: Path, codec: str, options: dict[str, str]) -> None:
    if codec not in av.codecs_available:
        pytest.skip(f"PyAV was built without {codec}")
    path = write_video(tmp_path / "a.mp4", 260, codec=codec, options=options)
    truth = sequential(path)
    recording = Recording([path])
    assert len(truth) == len(recording.frame_times) == 260
    everything = list(recording.frames())
    assert [index for index, _ in everything] == list(range(260))
    assert all(np.array_equal(image, truth[index]) for index, image in everything)
    # Far apart, unordered and doubled: the decoder enters the file anew where it may.
    for wanted in ([259, 3, 3, 100, 101, 190], [258], [97, 240], list(range(7, 260, 83))):
        got = list(recording.frames(wanted))
        assert [index for index, _ in got] == sorted(set(wanted))
        assert all(np.array_equal(image, truth[index]) for index, image in got)


def test_seeking_happens_only_into_pictures_that_need_no_past(tmp_path: Path) -> None:
    open_groups = {"bf": "3", "g": "24", "x264-params": "open-gop=1:scenecut=0"}
    closed = scan(write_video(tmp_path / "closed.mp4", 120, options={"bf": "3", "g": "24", "sc_threshold": "0"}))
    assert closed.entries.tolist() == [0, 24, 48, 72, 96]
    assert scan(write_video(tmp_path / "open.mp4", 120, options=open_groups)).entries.tolist() == [0]


def test_chapters_join_on_one_clock(tmp_path: Path) -> None:
    paths = [
        write_video(tmp_path / f"GX0{k}0003.MP4", n, first_picture=first, sound=click(at, n / 30))
        for k, n, first, at in ((1, 45, 0, 0.5), (2, 30, 45, 0.25), (3, 60, 75, 1.0))
    ]
    recording = Recording(paths)
    truth = [image for path in paths for image in sequential(path)]
    np.testing.assert_allclose(recording.frame_times, np.arange(135) / 30, atol=1e-9)
    assert recording.info.n_frames == 135
    assert recording.info.duration == pytest.approx(4.5)
    assert all(np.array_equal(image, truth[index]) for index, image in recording.frames())
    assert [index for index, _ in recording.frames([44, 45, 134])] == [44, 45, 134]
    samples, start = recording.audio(RATE)
    loud = start + np.flatnonzero(np.abs(samples) > 0.3) / RATE
    clicks = [loud[np.abs(loud - at) < 0.1].mean() for at in (0.5, 1.5 + 0.25, 2.5 + 1.0)]
    np.testing.assert_allclose(clicks, [0.5, 1.75, 3.5], atol=2 / RATE)


@pytest.mark.parametrize(
    ("codec", "options"),
    [
        ("libx264", {"bf": "3", "g": "24", "crf": "20", "x264-params": "open-gop=1:scenecut=0:b-pyramid=normal"}),
        ("libx265", {"x265-params": "open-gop=1:keyint=24:bframes=4:log-level=none:pools=1:frame-threads=1"}),
    ],
)
def test_frames_of_chapters_equal_a_sequential_decode(tmp_path: Path, codec: str, options: dict[str, str]) -> None:
    if codec not in av.codecs_available:
        pytest.skip(f"PyAV was built without {codec}")
    paths = [
        write_video(tmp_path / f"GX0{k}0007.MP4", 130, codec=codec, options=options, first_picture=130 * k)
        for k in range(2)
    ]
    truth = [image for path in paths for image in sequential(path)]
    for wanted in ([0, 128, 129, 130, 131, 259], [133], list(range(5, 260, 61))):
        got = list(Recording(paths).frames(wanted))
        assert [index for index, _ in got] == wanted
        assert all(np.array_equal(image, truth[index]) for index, image in got)


def test_a_gap_in_the_sound_between_chapters_is_silent_and_reported(tmp_path: Path) -> None:
    noise = np.random.default_rng(0).uniform(-0.5, 0.5, RATE).astype(np.float32)
    paths = [
        write_video(tmp_path / "GX010003.MP4", 30, sound=noise[: round(0.8 * RATE)]),
        write_video(tmp_path / "GX020003.MP4", 30, sound=noise),
    ]
    track = Recording(paths).audio_track(RATE)
    assert len(track.seams) == 1
    assert track.seams[0].gap_s == pytest.approx(0.2, abs=0.022)  # AAC ends on whole blocks of 1024 samples
    quiet = slice(round(0.85 * RATE), round(0.97 * RATE))
    assert np.abs(track.samples[quiet]).max() == 0.0
    assert np.abs(track.samples[round(1.1 * RATE) : round(1.9 * RATE)]).max() > 0.3


@pytest.mark.parametrize(("sound_start", "video_start"), [(0.0, 0), (0.4, 0), (0.0, 12), (0.1, 3)])
def test_sound_keeps_its_place_against_the_video(tmp_path: Path, sound_start: float, video_start: int) -> None:
    path = write_video(
        tmp_path / "a.mp4",
        60,
        sound=click(0.7, 1.5),
        sound_start=sound_start,
        video_start=video_start,
        # By default the writer rounds the start of a late track to whole milliseconds.
        container={"movie_timescale": "48000"},
    )
    recording = Recording([path])
    assert recording.frame_times[0] == 0.0
    expected = sound_start + 0.7 - video_start / 30
    assert click_time(recording) == pytest.approx(expected, abs=1 / RATE)


def test_another_sample_rate_moves_nothing(tmp_path: Path) -> None:
    recording = Recording([write_video(tmp_path / "a.mp4", 60, sound=click(0.7, 2.0))])
    samples, start = recording.audio(16000)
    assert start + int(np.argmax(np.abs(samples))) / 16000 == pytest.approx(0.7, abs=1 / 16000)


def test_a_rotation_tag_is_obeyed(tmp_path: Path) -> None:
    plain = Recording([write_video(tmp_path / "plain.mp4", 5)])
    for degrees, shape in ((180, (96, 160)), (90, (160, 96))):
        turned = Recording([write_video(tmp_path / f"{degrees}.mp4", 5, rotation=degrees)])
        assert (turned.info.height, turned.info.width) == shape
        image, upright = dict(turned.frames([2]))[2], dict(plain.frames([2]))[2]
        assert image.shape[:2] == shape
        np.testing.assert_array_equal(image, np.rot90(upright, degrees // 90))


def test_luma_is_the_picture_in_small(tmp_path: Path) -> None:
    recording = Recording([write_video(tmp_path / "a.mp4", 40)])
    small = dict(recording.luma(80, 10, 19))
    assert list(small) == list(range(10, 20))
    large = dict(recording.frames([15]))[15].astype(float) @ [0.299, 0.587, 0.114]
    shrunk = large.reshape(48, 2, 80, 2).mean(axis=(1, 3))
    studio = small[15].astype(float)
    assert small[15].shape == (48, 80)
    assert np.corrcoef(studio.ravel(), shrunk.ravel())[0, 1] > 0.98
    keys = [index for index, _ in recording.luma(80, keyframes=True)]
    assert 0 < len(keys) < 40
    assert keys[0] == 0


def test_a_file_without_sound_is_named_with_the_remedy(tmp_path: Path) -> None:
    recording = Recording([write_video(tmp_path / "mute.mp4", 5)])
    assert not recording.info.has_audio
    with pytest.raises(SplashbenchError, match=r"mute\.mp4 has no audio track.*microphone"):
        recording.audio()


def damaged(tmp_path: Path, kind: str) -> Path:
    source = write_video(tmp_path / "whole.mp4", 90, container={"movflags": "faststart"}, sound=click(0.1, 3.0))
    path = tmp_path / f"{kind}.mp4"
    if kind == "cut":
        path.write_bytes(source.read_bytes()[: source.stat().st_size * 7 // 10])
    elif kind == "headless":
        path.write_bytes(write_video(tmp_path / "tail.mp4", 90).read_bytes()[:9000])
    elif kind == "text":
        path.write_text("not a video at all\n" * 50)
    elif kind == "empty":
        path.touch()
    elif kind == "playlist":
        # A "video" that would make FFmpeg open another file.
        path.write_text(f"ffconcat version 1.0\nfile {source.name}\n")
    return path


@pytest.mark.parametrize(
    ("kind", "message"),
    [
        ("cut", r"cut\.mp4 is cut short: \d+ frames of the 90 promised; copy it"),
        ("headless", r"headless\.mp4 is damaged, cut short or no video .*; copy it"),
        ("text", r"text\.mp4 is damaged"),
        ("empty", r"empty\.mp4 is damaged"),
        ("playlist", r"playlist\.mp4 is damaged"),
        ("absent", r"absent\.mp4 does not exist"),
    ],
)
def test_unusable_files_are_one_line_naming_them(tmp_path: Path, kind: str, message: str) -> None:
    path = damaged(tmp_path, kind)
    for attempt in (lambda: Recording([path]).info, lambda: list(Recording([path]).frames())):
        with pytest.raises(SplashbenchError, match=message) as caught:
            attempt()
        assert "\n" not in str(caught.value)


def test_damage_in_the_middle_never_passes_as_a_frame_of_another_time(tmp_path: Path) -> None:
    source = write_video(tmp_path / "whole.mp4", 90, container={"movflags": "faststart"})
    data = bytearray(source.read_bytes())
    data[len(data) // 2 : len(data) // 2 + 2000] = b"\xff" * 2000
    (tmp_path / "hit.mp4").write_bytes(data)
    with pytest.raises(SplashbenchError, match=r"hit\.mp4"):
        list(Recording([tmp_path / "hit.mp4"]).frames())


def test_chapters_of_different_recordings_do_not_join(tmp_path: Path) -> None:
    first = write_video(tmp_path / "a.mp4", 10)
    second = write_video(tmp_path / "b.mp4", 10, codec="mpeg4", options={})
    with pytest.raises(SplashbenchError, match=r"b\.mp4 differs in size or codec"):
        _ = Recording([first, second]).info


def test_indices_outside_the_recording_are_refused(tmp_path: Path) -> None:
    recording = Recording([write_video(tmp_path / "a.mp4", 10)])
    with pytest.raises(ValueError, match=r"0\.\.9"):
        list(recording.frames([10]))
    assert list(recording.frames([])) == []


def test_a_colon_in_a_name_is_no_address(tmp_path: Path) -> None:
    path = tmp_path / "pipe:0"
    shutil.copy(write_video(tmp_path / "a.mp4", 5), path)
    assert probe(path).n_frames == 5


def real(name: str) -> Path:
    root = os.environ.get("SPLASHBENCH_TEST_DATA")
    if not root:
        pytest.skip("SPLASHBENCH_TEST_DATA is not set")
    path = Path(root, "real", name)
    if not path.exists():
        pytest.skip(f"{path} is not there")
    return path


def test_a_gopro_file() -> None:
    recording = Recording([real("gopro/karma.mp4")])
    info = recording.info
    assert (info.n_frames, info.timecode, info.codec) == (362, "19:26:48:04", "h264")
    assert (info.width, info.height) == (854, 480)
    assert info.fps == pytest.approx(30000 / 1001)
    assert info.audio_minus_video_s == pytest.approx(-4.07e-3, abs=1e-5)
    np.testing.assert_allclose(recording.frame_times, np.arange(362) * 1001 / 30000, atol=1e-6)
    samples, start = recording.audio()
    assert (len(samples), start) == (579584, 0.0)
    truth = sequential(recording.paths[0])
    chosen = dict(recording.frames([0, 7, 200, 361]))
    assert all(np.array_equal(chosen[index], truth[index]) for index in (0, 7, 200, 361))


def test_pipes_and_devices_are_refused_at_once(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "pipe.mp4")
    (tmp_path / "endless.mp4").symlink_to("/dev/zero")
    for name in ("pipe.mp4", "endless.mp4"):
        with pytest.raises(SplashbenchError, match=name.replace(".", r"\.")):
            probe(tmp_path / name)

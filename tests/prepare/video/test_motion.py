"""The interval in which liquid moves is found in the pictures, through noise, flicker and a changed scene after."""

from __future__ import annotations

from collections.abc import Iterator
from fractions import Fraction
from pathlib import Path

import av
import numpy as np
import pytest

from splashbench.errors import SplashbenchError
from splashbench.prepare.audio.sync import ClockFit
from splashbench.prepare.video.motion import camera_motion, find_motion
from splashbench.prepare.video.recording import Recording

FPS = 30


def clock(start: float = 0.0, rate: float = 1.0) -> ClockFit:
    return ClockFit(start, rate, 10.0, 1e-5, 10, "ok")


class Scene:
    """A camera's view of a pour: stands in for a `Recording`.

    Liquid enters as a stream 3 px wide at `begin`, moves until `end`, and lies still in its bowl afterwards.
    """

    def __init__(
        self,
        begin: float = 2.0,
        end: float = 4.0,
        seconds: float = 7.0,
        noise: float = 2.0,
        flicker: float = 0.0,
        contrast: float = 40.0,
        extra: tuple[tuple[float, float], ...] = (),
        key_every: int = 12,
        seed: int = 0,
    ) -> None:
        self.paths = (Path("view.MP4"),)
        self.frame_times = np.arange(round(seconds * FPS)) / FPS
        self.begin, self.end, self.noise, self.flicker, self.contrast = begin, end, noise, flicker, contrast
        self.extra, self.key_every = extra, key_every
        self.table = np.random.default_rng(seed).uniform(60, 180, (90, 160)).repeat(2, 0).repeat(2, 1)
        self.decoded = 0

    def picture(self, index: int) -> np.ndarray:
        time = self.frame_times[index]
        rng = np.random.default_rng(index)
        image = self.table.copy()
        if time >= self.begin:
            if time <= self.end:
                fall = int(min(100.0, 400 * (time - self.begin + 1 / FPS)))
                image[20 : 20 + fall, 150:153] += self.contrast * rng.uniform(0.2, 1, (fall, 1))
            level = 10 * min(1.0, (min(time, self.end) - self.begin) / (self.end - self.begin))
            image[round(140 - level) : 140, 100:220] += self.contrast
        for begin, end in self.extra:
            if begin <= time <= end:
                image[30:60, 200:210] += 50 * rng.uniform(0.5, 1, (30, 10))
        image += self.flicker * np.sin(2 * np.pi * 7.3 * time) + self.noise * rng.standard_normal(image.shape)
        return np.clip(np.round(image), 0, 255).astype(np.uint8)

    def luma(
        self, width: int, first: int = 0, last: int | None = None, keyframes: bool = False
    ) -> Iterator[tuple[int, np.ndarray]]:
        assert width == 320
        last = len(self.frame_times) - 1 if last is None else last
        for index in range(first, min(last, len(self.frame_times) - 1) + 1):
            if not keyframes or index % self.key_every == 0:
                self.decoded += 1
                yield index, self.picture(index)


@pytest.mark.parametrize(
    "scene",
    [
        Scene(),
        Scene(noise=8.0, contrast=70.0),
        Scene(flicker=12.0),
        Scene(begin=0.9, end=1.9, seconds=4.0),
        Scene(contrast=-45.0),
    ],
    ids=["plain", "noisy", "flickering lamp", "brief", "dark liquid"],
)
def test_the_pour_is_found_to_a_tenth_of_a_second(scene: Scene) -> None:
    span, notes = camera_motion(scene)  # type: ignore[arg-type]
    assert span is not None
    assert span[0] == pytest.approx(scene.begin, abs=0.1)
    assert span[1] == pytest.approx(scene.end, abs=0.15)
    assert notes == []


@pytest.mark.parametrize("noise", [0.0, 2.0, 8.0])
def test_nothing_moves_in_a_static_scene(noise: float) -> None:
    span, notes = camera_motion(Scene(begin=99, end=100, noise=noise, flicker=6.0))  # type: ignore[arg-type]
    assert span is None
    assert notes == ["nothing moves"]


def test_common_time_and_a_bumped_camera() -> None:
    """Three cameras with clocks of their own; the fourth was touched before the pour."""
    recordings = {
        "1": Scene(),
        "2": Scene(begin=3.1, end=5.1, seconds=8, seed=1),
        "3": Scene(begin=1.4, end=3.4, seed=2),
        "4": Scene(extra=((1.2, 1.6),), seed=3),
    }
    clocks = {"1": clock(), "2": clock(-1.1), "3": clock(0.6), "4": clock()}
    motion = find_motion(recordings, clocks)  # type: ignore[arg-type]
    assert motion.start == pytest.approx(2.0, abs=0.1)
    assert motion.end == pytest.approx(4.0, abs=0.15)
    assert motion.per_camera["4"][0] < 1.5
    assert len(motion.per_camera) == 4
    assert any("second camera" in reason for reason in motion.reasons)
    chosen = find_motion(recordings, clocks, cameras=["1", "3"])  # type: ignore[arg-type]
    assert set(chosen.per_camera) == {"1", "3"}


def test_an_override_is_taken_without_looking() -> None:
    scene = Scene()
    motion = find_motion({"1": scene}, {"1": clock()}, override=(1.25, 2.5))  # type: ignore[dict-item]
    assert motion.interval == (1.25, 2.5)
    assert scene.decoded == 0
    assert "session.toml" in motion.reasons[0]


def test_no_motion_is_an_error_with_the_remedy() -> None:
    still = Scene(begin=99, end=100)
    with pytest.raises(SplashbenchError, match=r"view\.MP4: 1 of 2 cameras see motion; set motion_interval"):
        find_motion({"1": still, "2": Scene()}, {"1": clock(), "2": clock()})  # type: ignore[dict-item]


def test_of_several_pours_the_largest_is_taken_and_said_so() -> None:
    span, notes = camera_motion(Scene(begin=6, end=8, seconds=10, extra=((2.0, 2.4),)))  # type: ignore[arg-type]
    assert span is not None
    assert span == (pytest.approx(6.0, abs=0.1), pytest.approx(8.0, abs=0.15))
    assert "2 separate motions" in notes[0]


def test_a_long_recording_is_searched_by_key_frames_first() -> None:
    scene = Scene(begin=40.2, end=42.4, seconds=60)
    span, notes = camera_motion(scene)  # type: ignore[arg-type]
    assert span == (pytest.approx(40.2, abs=0.1), pytest.approx(42.4, abs=0.15))
    assert scene.decoded < 0.3 * len(scene.frame_times)
    assert "key frames" in notes[0]
    rare = Scene(begin=44.2, end=46.0, seconds=50, key_every=300)
    span, _ = camera_motion(rare)  # type: ignore[arg-type]
    assert span == (pytest.approx(44.2, abs=0.1), pytest.approx(46.0, abs=0.15))


def test_doubts_are_reported() -> None:
    _, notes = camera_motion(Scene(begin=0.1, end=2.0, seconds=4))  # type: ignore[arg-type]
    assert any("very beginning" in note for note in notes)
    _, notes = camera_motion(Scene(begin=2.0, end=9.0, seconds=4))  # type: ignore[arg-type]
    assert notes == ["still moves at the end of the recording"]


def test_through_a_real_file(tmp_path: Path) -> None:
    """The same scene compressed by H.264, which smooths noise between key frames and lets it jump at them."""
    scene = Scene(begin=1.5, end=3.0, seconds=5, noise=3.0)
    path = tmp_path / "view.mp4"
    with av.open(str(path), "w") as out:
        stream = out.add_stream("libx264", rate=FPS, options={"g": "15", "bf": "2", "crf": "23"})
        stream.width, stream.height, stream.pix_fmt = 640, 360, "yuv420p"
        for index in range(len(scene.frame_times)):
            grey = scene.picture(index).repeat(2, 0).repeat(2, 1)
            frame = av.VideoFrame.from_ndarray(np.repeat(grey[..., None], 3, -1), format="rgb24")
            frame.pts, frame.time_base = index, Fraction(1, FPS)
            out.mux(stream.encode(frame))
        out.mux(stream.encode(None))
    span, notes = camera_motion(Recording([path]))
    assert span == (pytest.approx(1.5, abs=0.1), pytest.approx(3.0, abs=0.15))
    assert notes == []


def test_a_beginning_that_does_not_decode_is_one_line() -> None:
    class Cut(Scene):
        def luma(self, *among: object, **how: object) -> Iterator[tuple[int, np.ndarray]]:
            return iter(())

    with pytest.raises(SplashbenchError, match=r"view\.MP4: no frame of the first 0\.5 s can be decoded"):
        camera_motion(Cut())  # type: ignore[arg-type]

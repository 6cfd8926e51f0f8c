"""Whatever a media file does to its decoder, one line tells of it, and the next file is read."""

from __future__ import annotations

import os
import subprocess
import sys
import time
from collections.abc import Iterator
from fractions import Fraction
from importlib import import_module
from pathlib import Path

import av
import numpy as np
import psutil
import pytest

from splashbench.errors import SplashbenchError
from splashbench.prepare.audio.waveform import join_audio
from splashbench.prepare.media import messages, reading, worker
from splashbench.prepare.video.recording import Recording


def write_film(
    path: Path, n: int = 9, size: tuple[int, int] = (64, 48), metadata: dict[str, str] | None = None
) -> Path:
    with av.open(str(path), "w") as out:
        out.metadata.update(metadata or {})
        stream = out.add_stream("libx264", rate=30, options={"g": "4"})
        stream.width, stream.height, stream.pix_fmt = *size, "yuv420p"
        rng = np.random.default_rng(0)
        for number in range(n):
            pixels = rng.integers(0, 255, (size[1], size[0], 3), dtype=np.uint8)
            frame = av.VideoFrame.from_ndarray(pixels, format="rgb24")
            frame.pts, frame.time_base = number, Fraction(1, 30)
            out.mux(stream.encode(frame))
        out.mux(stream.encode(None))
    return path


@pytest.fixture
def film(tmp_path: Path) -> Path:
    return write_film(tmp_path / "film.mp4")


@pytest.fixture(autouse=True)
def _own_children() -> Iterator[None]:
    reading.end_children()
    yield
    reading.end_children()


def decoders() -> list[psutil.Process]:
    return [each for each in psutil.Process().children() if "media" in " ".join(each.cmdline())]


@pytest.mark.parametrize(
    ("name", "said"),
    [
        ("sleeps", "nothing came of it for 0 s"),
        ("dies", "the decoder ended with -11"),
        ("babbles", "the decoder broke off"),
        ("boasts", "the decoder broke off"),
    ],
)
def test_a_decoder_that_a_file_breaks(film: Path, name: str, said: str, monkeypatch: pytest.MonkeyPatch) -> None:
    with monkeypatch.context() as within:
        within.syspath_prepend(Path(__file__).parent)  # the child imports from where this process does
        within.setattr(reading, "serve", getattr(import_module("bad_decoders"), name))
        within.setattr(reading, "PATIENCE_S", 0.4)
        within.setattr(reading, "_END_SECONDS", 0.4)
        with pytest.raises(SplashbenchError, match=rf"film\.mp4 is damaged, cut short or no video \({said}\); copy it"):
            reading.probe(film)
    assert not [each for each in psutil.Process().children() if "bad_decoders" in " ".join(each.cmdline())]
    assert reading.probe(film).n_frames == 9


def test_memory_beyond_the_limit_is_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    small, large = write_film(tmp_path / "small.mp4"), write_film(tmp_path / "large.mp4", 3, (4096, 3072))
    # What the child takes before it decodes anything differs from machine to machine.
    reading.probe(small)
    (child,) = decoders()
    room = child.memory_info().vms + (100 << 20)
    reading.end_children()
    with monkeypatch.context() as within:
        within.setattr(reading, "MAX_MEMORY_BYTES", room)
        assert reading.probe(small).n_frames == 9
        with pytest.raises(SplashbenchError, match=r"large\.mp4 is damaged"):  # what FFmpeg says of it varies
            list(Recording([large]).frames())
        chapter = reading.scan(small)
        (child,) = decoders()
        with pytest.raises(SplashbenchError, match=r"small\.mp4 is damaged"):
            list(reading.luma(chapter, 20_000, 0, 0))
        assert not child.is_running()  # it may be short of memory for the next file
        reading.end_children()
    assert len(list(Recording([large]).frames())) == 3


def test_want_of_memory_is_told_as_such(film: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def in_want(path: Path) -> None:
        raise MemoryError

    monkeypatch.setattr(worker.container, "probe", in_want)
    out, into = os.pipe()
    worker.answer({"task": "probe", "path": str(film)}, [], into)
    (head, _) = messages.receive(out)
    assert head["fault"].startswith(f"{film} is damaged, cut short or no video (it needs more than ")
    assert head["worn"]
    os.close(out)
    os.close(into)


def test_a_child_is_kept_for_the_next_file_and_ends_with_this_process(film: Path) -> None:
    recording = Recording([film])
    _ = recording.info
    (first,) = decoders()
    list(recording.frames())
    assert [child.pid for child in decoders()] == [first.pid]
    code = (
        "import sys, psutil\n"
        "from pathlib import Path\n"
        "from splashbench.prepare.media import reading\n"
        "reading.probe(Path(sys.argv[1]))\n"
        "print(*[child.pid for child in psutil.Process().children()])\n"
    )
    said = subprocess.run([sys.executable, "-W", "error", "-c", code, film], capture_output=True, text=True, check=True)
    (pid,) = map(int, said.stdout.split())
    assert said.stderr == ""
    until = time.monotonic() + 10
    while psutil.pid_exists(pid) and time.monotonic() < until:
        time.sleep(0.05)
    assert not psutil.pid_exists(pid)


def test_two_files_at_once_and_one_that_is_left_off(film: Path) -> None:
    recording = Recording([film])
    truth = dict(recording.frames())
    for (k, a), (j, b) in zip(recording.frames(), recording.frames(range(1, 9)), strict=False):
        np.testing.assert_array_equal(a, truth[k])
        np.testing.assert_array_equal(b, truth[j])
    assert len(decoders()) == 1
    left_off = recording.frames()
    next(left_off)
    del left_off
    assert len(list(recording.frames())) == 9


def test_a_table_that_lists_more_than_the_file_has(film: Path, tmp_path: Path) -> None:
    """stsz may give one size for any number of samples; the chunks' places say where they lie."""
    content = film.read_bytes()
    place = content.index(b"stsz")
    data = bytearray(content)
    data[place + 8 : place + 12] = (4096).to_bytes(4, "big")
    data[place + 12 : place + 16] = (10**7).to_bytes(4, "big")
    place = data.index(b"stsc")  # every chunk holds as many
    data[place + 12 : place + 16] = (10**7).to_bytes(4, "big")
    (path := tmp_path / "long.mp4").write_bytes(data)
    began = time.monotonic()
    with pytest.raises(SplashbenchError, match=r"long\.mp4"):
        list(Recording([path]).frames())
    assert time.monotonic() - began < reading.PATIENCE_S


def test_labels_that_are_no_text_are_left_out(tmp_path: Path) -> None:
    written = {"creation_time": "2026-01-02T03:04:05.000000Z"}
    assert reading.probe(write_film(tmp_path / "a.mp4", metadata=written)).created == written["creation_time"]
    path = write_film(tmp_path / "b.mkv", metadata={"timecode": "01:00\x1b[31m"})
    assert reading.probe(path).timecode is None


def test_sound_of_days_is_refused_before_memory_is_taken(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / "a.wav"
    with av.open(str(path), "w") as out:
        stream = out.add_stream("pcm_s16le", rate=8000, layout="mono")
        block = av.AudioFrame.from_ndarray(np.zeros((1, 800), np.int16), "s16", "mono")
        block.sample_rate, block.pts = 8000, 0
        out.mux(stream.encode(block))
    assert len(join_audio([path], [0.0], 8000).samples) == 800
    with pytest.raises(SplashbenchError, match=r"a\.wav and what follows it have 24\.0 hours of sound, more than 4"):
        join_audio([path, path], [0.0, 86400.0], 8000)


def test_messages_hold_what_was_sent() -> None:
    out, into = os.pipe()
    arrays = [np.arange(6, dtype=np.uint8).reshape(2, 3), np.zeros((0, 4), np.int64), np.ones((), np.float32)]
    messages.send(into, {"a": "\udcff", "b": [1.5, None]}, arrays)
    os.close(into)
    head, found = messages.receive(out)
    assert head == {"a": "\udcff", "b": [1.5, None]}
    assert [array.dtype for array in found] == [array.dtype for array in arrays]
    for a, b in zip(found, arrays):
        np.testing.assert_array_equal(a, b)
    with pytest.raises(messages.EndedError):
        messages.receive(out)
    os.close(out)

"""Whatever a media file does to its decoder, one line tells of it, and the next file is read."""

from __future__ import annotations

import io
import os
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from dataclasses import replace
from fractions import Fraction
from importlib import import_module
from pathlib import Path

import av
import numpy as np
import psutil
import pytest
from av.stream import Disposition
from PIL import Image

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
        ("lies", "the decoder says what makes no sense"),
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


def test_a_decoder_that_does_not_start_is_not_the_files_fault(film: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    with monkeypatch.context() as within:
        within.syspath_prepend(Path(__file__).parent)
        within.setattr(reading, "serve", import_module("bad_decoders").fails)
        with pytest.raises(
            SplashbenchError, match=r"film\.mp4 was not read: .* did not start \(the decoder ended with 3\)"
        ):
            reading.probe(film)

    def no_more(*arguments: object, **options: object) -> None:
        raise OSError(24, "Too many open files")

    with monkeypatch.context() as within:
        within.setattr(subprocess, "Popen", no_more)
        with pytest.raises(SplashbenchError, match=r"film\.mp4 was not read: .*\(Too many open files\); close other"):
            reading.probe(film)
    assert reading.probe(film).n_frames == 9


def test_a_child_that_was_killed_while_it_waited_costs_nothing(film: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    reading.probe(film)
    (child,) = decoders()
    monkeypatch.setattr(reading._Child, "is_alive", lambda self: True)  # it is killed just after it was looked at
    child.kill()
    child.wait()
    assert reading.probe(film).n_frames == 9
    assert [other.pid for other in decoders()] != [child.pid]


def test_a_child_that_does_not_listen_is_given_up(film: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    chapter = reading.scan(film)
    long = replace(chapter, pts=np.arange(200_000, dtype=np.int64))  # more than a pipe holds
    (child,) = decoders()
    child.suspend()
    monkeypatch.setattr(reading, "PATIENCE_S", 0.4)
    with pytest.raises(SplashbenchError, match="nothing came of it"):
        list(reading.frames(long, [0]))


def test_the_time_in_which_all_are_stopped_does_not_count(film: Path) -> None:
    """Ctrl-Z stops whoever asks and the child alike."""
    code = (
        "import sys\n"
        f"sys.path.insert(0, {str(Path(__file__).parent)!r})\n"
        "import bad_decoders\n"
        "from pathlib import Path\n"
        "from splashbench.errors import SplashbenchError\n"
        "from splashbench.prepare.media import reading\n"
        "reading.serve, reading.PATIENCE_S = bad_decoders.dawdles, 2.0\n"
        "for turn in range(2):\n"
        "    try:\n"
        "        reading.probe(Path(sys.argv[1]))\n"
        "    except SplashbenchError as error:\n"
        "        print(error, flush=True)\n"
    )
    command = [sys.executable, "-c", code, film]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True, start_new_session=True) as asks:
        assert asks.stdout is not None
        assert asks.stdout.readline() == "it has dawdled\n"
        time.sleep(0.3)
        os.killpg(asks.pid, signal.SIGSTOP)
        time.sleep(3)
        os.killpg(asks.pid, signal.SIGCONT)
        assert asks.stdout.readline() == "it has dawdled\n"


def test_a_removed_current_folder_is_told(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "gone").mkdir()
    monkeypatch.chdir(tmp_path / "gone")
    (tmp_path / "gone").rmdir()
    with pytest.raises(SplashbenchError, match=r"film\.mp4 does not exist, since the current folder was removed"):
        reading.probe(Path("film.mp4"))


def test_a_file_is_looked_for_where_this_process_is(
    film: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "other").mkdir()
    write_film(tmp_path / "other" / "film.mp4", 5)
    for folder, count in ((tmp_path, 9), (tmp_path / "other", 5)):
        monkeypatch.chdir(folder)
        assert reading.probe(Path("film.mp4")).n_frames == count
    monkeypatch.chdir("/")
    with pytest.raises(SplashbenchError, match=r"film\.mp4 does not exist"):
        reading.probe(Path("film.mp4"))


def test_a_file_that_was_exchanged_is_not_read_on(film: Path, tmp_path: Path) -> None:
    recording = Recording([film])
    assert len(list(recording.frames([0, 3]))) == 2
    write_film(film, 20)
    with pytest.raises(SplashbenchError, match=r"film\.mp4 was changed while it was read; run the command again"):
        list(recording.frames([0, 3]))


def test_a_child_serves_whatever_thread_asks_and_no_process_that_is_forked_off(film: Path) -> None:
    begun: list[Iterator[tuple[int, np.ndarray]]] = []

    def begin() -> None:
        frames = Recording([film]).frames()
        next(frames)
        begun.append(frames)

    thread = threading.Thread(target=begin)
    thread.start()
    thread.join()
    time.sleep(0.7)
    assert len(list(begun[0])) == 8
    code = (
        "import os, sys\n"
        "from pathlib import Path\n"
        "from splashbench.prepare.media import reading\n"
        "reading.probe(Path(sys.argv[1]))\n"
        "process = os.fork()\n"
        "print(reading.probe(Path(sys.argv[1])).n_frames, flush=True)\n"
        "if process:\n"
        "    sys.exit(os.waitstatus_to_exitcode(os.waitpid(process, 0)[1]))\n"
    )
    said = subprocess.run([sys.executable, "-W", "error", "-c", code, film], capture_output=True, text=True, check=True)
    assert (said.stdout, said.stderr) == ("9\n9\n", "")


@pytest.mark.slow
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
    assert head["fault"].startswith(f"{film} is damaged, cut short or no video (FFmpeg wants more than ")
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


@pytest.mark.parametrize("size", [(640, 16), (16, 640)])
def test_frames_as_no_camera_has_them_are_refused(size: tuple[int, int], tmp_path: Path) -> None:
    path = write_film(tmp_path / "odd.mp4", 3, size)
    for read in (lambda: reading.probe(path), lambda: list(Recording([path]).luma(320))):
        with pytest.raises(SplashbenchError, match=r"odd\.mp4 has frames of \d+x\d+: .*; give the camera's own file"):
            read()


def test_frames_that_change_their_size_are_refused(tmp_path: Path) -> None:
    path = tmp_path / "sizes.mkv"
    with av.open(str(path), "w") as out:
        stream = out.add_stream("mjpeg", rate=30)
        stream.width, stream.height, stream.pix_fmt = 64, 48, "yuvj420p"
        for number in range(6):
            encoder = av.CodecContext.create("mjpeg", "w")
            encoder.width, encoder.height = (64, 48) if number < 3 else (128, 96)
            encoder.pix_fmt, encoder.time_base = "yuvj420p", Fraction(1, 30)
            pixels = np.zeros((encoder.height, encoder.width, 3), np.uint8)
            frame = av.VideoFrame.from_ndarray(pixels, format="rgb24").reformat(format="yuvj420p")
            frame.pts, frame.time_base = number, Fraction(1, 30)
            for packet in [*encoder.encode(frame), *encoder.encode(None)]:
                packet.pts = packet.dts = number
                packet.time_base, packet.stream = Fraction(1, 30), stream
                out.mux(packet)
    with pytest.raises(SplashbenchError, match=r"sizes\.mkv changes from 64x48 to 128x96 midway"):
        list(Recording([path]).frames())


def write_sound(path: Path, rate: int, seconds: float, codec: str) -> Path:
    with av.open(str(path), "w") as out:
        stream = out.add_stream(codec, rate=rate, layout="mono")
        for start in range(0, round(rate * seconds), 1 << 16):
            samples = np.zeros((1, min(1 << 16, round(rate * seconds) - start)), np.int16)
            block = av.AudioFrame.from_ndarray(samples, "s16", "mono")
            block.sample_rate, block.pts = rate, start
            out.mux(stream.encode(block))
        out.mux(stream.encode(None))
    return path


def test_hours_of_silence_in_a_small_file_are_refused(tmp_path: Path) -> None:
    path = write_sound(tmp_path / "slow.flac", 1000, 3 * 3600, "flac")
    assert path.stat().st_size < 1_000_000
    with pytest.raises(SplashbenchError, match=r"slow\.flac has more than 2 hours of sound; cut it to the pour"):
        join_audio([path], [0.0], 48000)


def test_rates_that_no_camera_has_are_refused(tmp_path: Path) -> None:
    """To resample from them takes filters of a million taps, for each piece of sound."""
    path = write_sound(tmp_path / "prime.mkv", 47999, 0.2, "pcm_s16le")
    with pytest.raises(SplashbenchError, match=r"prime\.mkv has 47999 sound samples a second, which no camera has"):
        join_audio([path], [0.0], 48000)
    for rate in (8000, 11025, 22050, 44100, 96000):
        track = join_audio([write_sound(tmp_path / f"{rate}.mkv", rate, 0.5, "pcm_s16le")], [0.0], 48000)
        assert len(track.samples) == -(-round(rate / 2) * 48000 // rate)


def test_a_cover_is_no_film(tmp_path: Path) -> None:
    path = tmp_path / "cover.mp3"
    picture = io.BytesIO()
    Image.new("RGB", (32, 32)).save(picture, "PNG")
    with av.open(str(path), "w") as out:
        sound = out.add_stream("mp3", rate=48000, layout="mono")
        cover = out.add_stream("png", rate=1)
        cover.width, cover.height, cover.pix_fmt = 32, 32, "rgb24"
        cover.disposition = Disposition.attached_pic
        packet = av.Packet(picture.getvalue())
        packet.stream, packet.pts, packet.dts = cover, 0, 0
        out.mux(packet)
        block = av.AudioFrame.from_ndarray(np.zeros((1, 4800), np.float32), "fltp", "mono")
        block.sample_rate, block.pts = 48000, 0
        for part in [*sound.encode(block), *sound.encode(None)]:
            out.mux(part)
    with pytest.raises(SplashbenchError, match=r"cover\.mp3 has no video track"):
        reading.probe(path)


def test_sound_of_days_is_refused_before_memory_is_taken(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / "a.wav"
    with av.open(str(path), "w") as out:
        stream = out.add_stream("pcm_s16le", rate=8000, layout="mono")
        block = av.AudioFrame.from_ndarray(np.zeros((1, 800), np.int16), "s16", "mono")
        block.sample_rate, block.pts = 8000, 0
        out.mux(stream.encode(block))
    assert len(join_audio([path], [0.0], 8000).samples) == 800
    with pytest.raises(SplashbenchError, match=r"a\.wav and what follows it have 24\.0 hours of sound, more than 2"):
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

"""Video files: decoded again they are the frames, at their rate and size; and nothing half-written is left."""

from __future__ import annotations

import json
import threading
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import av
import imageio.v3 as imageio
import numpy as np
import pytest

from splashbench.errors import SplashbenchError
from splashbench.replay import Reconstruction
from splashbench.video import TRUTH, Comparison, VideoSettings, encoders, make_film, write_video
from splashbench.video.output import rate_for, require_place

PLAIN = VideoSettings(caption=False)


def decoded(path: Path) -> tuple[np.ndarray, Any]:
    """The frames [N, H, W, 3] of a video, and what its stream says."""
    with av.open(str(path)) as container:
        stream = container.streams.video[0]
        frames, seconds = [], []
        for frame in container.decode(stream):
            frames.append(frame.reformat(format="rgb24", src_colorspace="itu709").to_ndarray())
            seconds.append(float(frame.pts * frame.time_base))
        context = stream.codec_context
        facts = {
            "codec": context.name,
            "format": context.pix_fmt,
            "fps": float(stream.average_rate),
            "colorspace": int(context.colorspace),
            "range": int(context.color_range),
            "seconds": seconds,
        }
        return np.stack(frames), facts


def psnr(one: np.ndarray, other: np.ndarray) -> float:
    return float(10 * np.log10(255**2 / np.mean((one.astype(float) - other) ** 2)))


def test_an_mp4_has_the_frames_that_were_rendered(ball: Reconstruction, tmp_path: Path) -> None:
    film = make_film(ball, replace(PLAIN, slow=2, fps=24))
    write_video(film, tmp_path / "ball.mp4")
    frames, facts = decoded(tmp_path / "ball.mp4")
    assert frames.shape == (len(film), 64, 96, 3)
    assert (facts["format"], facts["fps"]) == ("yuv420p", 24)
    assert facts["codec"] == "h264"
    assert (facts["colorspace"], facts["range"]) == (1, 1)  # BT.709, as browsers take it
    assert facts["seconds"] == pytest.approx(np.arange(len(film)) / 24)
    for k, frame in enumerate(frames):
        truth = film.frame(k)
        assert psnr(frame, truth) > 27  # the ball's red edge has half the resolution in colour
        assert np.abs(frame[:20, :20].astype(int) - truth[:20, :20]).max() <= 3  # colours are not shifted
    # Each frame is nearer to its own render than to any other.
    renders = np.stack([film.frame(k) for k in range(len(film))]).astype(float)
    nearest = [int(np.abs(renders - frame).mean(axis=(1, 2, 3)).argmin()) for frame in frames]
    assert nearest == list(range(len(film)))


def test_the_index_stands_before_the_pictures(ball: Reconstruction, tmp_path: Path) -> None:
    write_video(make_film(ball, PLAIN), tmp_path / "ball.mp4")
    data = (tmp_path / "ball.mp4").read_bytes()
    assert 0 < data.index(b"moov") < data.index(b"mdat")


@pytest.mark.parametrize("fps", [23.976, 29.97, 60, 7.5])
def test_any_rate_is_the_one_that_was_asked_for(fps: float, ball: Reconstruction, tmp_path: Path) -> None:
    write_video(make_film(ball, replace(PLAIN, fps=fps)), tmp_path / "ball.mp4")
    _, facts = decoded(tmp_path / "ball.mp4")
    assert facts["fps"] == pytest.approx(fps, rel=1e-3)
    assert facts["seconds"][1] == pytest.approx(1 / fps, rel=1e-3)


def test_odd_sizes_lose_nothing(ball: Reconstruction, tmp_path: Path) -> None:
    camera = ball.cameras["6"]
    ball.cameras["6"] = replace(camera, width=95, height=63)
    film = make_film(ball, PLAIN)
    write_video(film, tmp_path / "ball.mp4")
    frames, _ = decoded(tmp_path / "ball.mp4")
    assert frames.shape[1:3] == (64, 96)
    assert psnr(frames[2][:63, :95], film.frame(2)) > 27
    assert np.abs(frames[2][63].astype(int) - frames[2][62]).max() <= 6
    write_video(make_film(ball, replace(PLAIN, fps=25)), tmp_path / "ball.gif")
    assert decoded(tmp_path / "ball.gif")[0].shape[1:3] == (63, 95)


def test_halves_of_a_file_are_what_was_compared(ball: Reconstruction, tmp_path: Path) -> None:
    film = make_film(ball, replace(PLAIN, timesteps=True, fps=10), Comparison([TRUTH]))
    write_video(film, tmp_path / "both.mp4")
    frames, _ = decoded(tmp_path / "both.mp4")
    assert frames.shape == (len(ball.times), 64, 192, 3)
    assert ball.scene is not None
    for k, frame in enumerate(frames):
        # Compressed, the floor's pattern of single pixels has half its colours.
        assert psnr(frame[:, 96:], ball.scene.image("6", k)) > 20
        assert psnr(frame[:, :96], make_film(ball, replace(PLAIN, timesteps=True)).frame(k)) > 25


def test_a_gif_plays_at_a_rate_that_gifs_have(ball: Reconstruction, tmp_path: Path) -> None:
    film = make_film(ball, PLAIN, rate=rate_for(tmp_path / "ball.gif"))
    assert film.timing.fps == pytest.approx(100 / 3)
    write_video(film, tmp_path / "ball.gif")
    frames, _ = decoded(tmp_path / "ball.gif")
    assert len(frames) == len(film)
    assert np.abs(frames[3].astype(int) - film.frame(3)).max() <= 4  # few colours, all of them in the palette
    durations = {imageio.immeta(tmp_path / "ball.gif", index=k, plugin="pillow")["duration"] for k in range(len(film))}
    assert durations == {30}  # milliseconds
    with pytest.raises(SplashbenchError, match=r"give --fps 33\.33"):
        write_video(make_film(ball, replace(PLAIN, fps=30)), tmp_path / "no.gif")
    assert [path.name for path in tmp_path.iterdir()] == ["ball.gif"]


def test_a_gif_has_the_timesteps_of_a_recording_of_any_rate(ball: Reconstruction, tmp_path: Path) -> None:
    ball.times = np.arange(8) / 30
    ball.camera_times = dict.fromkeys(ball.cameras, ball.times)
    film = make_film(ball, replace(PLAIN, timesteps=True), rate=rate_for(tmp_path / "ball.gif"))
    write_video(film, tmp_path / "ball.gif")
    assert len(decoded(tmp_path / "ball.gif")[0]) == 8
    assert film.timing.fps == pytest.approx(100 / 3)


def test_a_folder_has_the_frames_and_their_times(ball: Reconstruction, tmp_path: Path) -> None:
    film = make_film(ball, PLAIN)
    write_video(film, tmp_path / "frames")
    about = json.loads((tmp_path / "frames" / "frames.json").read_text())
    assert about["times"] == film.timing.times.tolist()
    assert (about["fps"], about["panels"]) == (30, ["oracle"])
    for k in range(len(film)):
        assert np.array_equal(imageio.imread(tmp_path / "frames" / f"{k:06d}.png"), film.frame(k))
    assert len(list((tmp_path / "frames").iterdir())) == len(film) + 1


def test_only_a_video_is_replaced_and_only_when_asked(ball: Reconstruction, tmp_path: Path) -> None:
    film = make_film(ball, PLAIN)
    (tmp_path / "photos").mkdir()
    (tmp_path / "photos" / "holiday.jpg").write_bytes(b"dear")
    (tmp_path / "ball.mp4").write_bytes(b"before")
    for out in ("photos", "ball.mp4"):
        with pytest.raises(SplashbenchError, match="exists already"):
            write_video(film, tmp_path / out)
    with pytest.raises(SplashbenchError, match=r"it has no frames\.json"):
        write_video(film, tmp_path / "photos", replace=True)
    assert (tmp_path / "ball.mp4").read_bytes() == b"before"
    write_video(film, tmp_path / "ball.mp4", replace=True)
    assert len(decoded(tmp_path / "ball.mp4")[0]) == len(film)
    for _ in range(2):
        write_video(film, tmp_path / "frames", replace=True)
    assert sorted(path.name for path in tmp_path.iterdir()) == ["ball.mp4", "frames", "photos"]
    assert (tmp_path / "photos" / "holiday.jpg").read_bytes() == b"dear"


def test_places_where_no_video_can_be(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("mine")
    (tmp_path / "folder.mp4").mkdir()
    for out, fault in (
        ("x.avi", r"ends in \.avi; give a name in \.mp4 or \.gif"),
        ("file/x.mp4", "is a file"),
        ("folder.mp4", "is a folder"),
    ):
        with pytest.raises(SplashbenchError, match=fault):
            require_place(tmp_path / out, True)
    for name in ("submission.toml", "SHA256SUMS"):
        require_place(tmp_path / "folder.mp4" / "deep" / "x.mp4", True)
        (tmp_path / "folder.mp4" / name).touch()
    with pytest.raises(SplashbenchError, match="whose files are sealed"):
        require_place(tmp_path / "folder.mp4" / "deep" / "x.mp4", True)


class Broken(Exception):
    pass


@pytest.mark.parametrize("name", ["ball.mp4", "ball.gif", "frames"])
@pytest.mark.parametrize("fault", [Broken, KeyboardInterrupt, SplashbenchError])
def test_what_breaks_off_leaves_nothing(
    name: str, fault: type[BaseException], ball: Reconstruction, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    film = make_film(ball, replace(PLAIN, fps=25))

    def frames() -> Iterator[np.ndarray]:
        yield film.frame(0)
        yield film.frame(1)
        raise fault("here")

    monkeypatch.setattr(film, "frames", frames)
    with pytest.raises(fault):
        write_video(film, tmp_path / "new" / name)
    assert [path for path in tmp_path.rglob("*") if path.is_file()] == []
    assert list(tmp_path.glob("new/*")) == []


def test_frames_are_rendered_in_one_thread_and_encoded_in_another(
    ball: Reconstruction, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    encoding: set[int] = set()
    add = encoders.PngFolder.add

    def noting(self: Any, pixels: np.ndarray) -> None:
        encoding.add(threading.get_ident())
        add(self, pixels)

    monkeypatch.setattr(encoders.PngFolder, "add", noting)
    write_video(make_film(ball, PLAIN), tmp_path / "frames")
    assert ball.fitted.threads == {threading.get_ident()}  # type: ignore[attr-defined]
    assert len(encoding) == 1
    assert encoding != ball.fitted.threads  # type: ignore[attr-defined]


def test_a_fault_while_encoding_is_told(ball: Reconstruction, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def broken(self: Any, pixels: np.ndarray) -> None:
        raise Broken("on the way")

    monkeypatch.setattr(encoders.PngFolder, "add", broken)
    with pytest.raises(Broken, match="on the way"):
        write_video(make_film(ball, PLAIN), tmp_path / "frames")
    assert list(tmp_path.iterdir()) == []

"""A camera path goes through its key frames, and is saved as nerfstudio has it."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from splashbench.errors import SplashbenchError
from splashbench.files import read_image
from splashbench.replay.paths import read_camera_path
from splashbench.viewer.geometry import View
from splashbench.viewer.keyframes import Keyframe, path_through
from splashbench.viewer.saving import camera_path_bytes, png_bytes, save

UP = np.array([0.0, 1.0, 0.0])
KEYS = [
    Keyframe(View(np.array([0.0, 0.5, 2.0]), np.zeros(3), UP, 0.8), 0.0),
    Keyframe(View(np.array([1.5, 0.5, 1.5]), np.array([0.1, 0, 0]), UP, 0.8), 0.2),
    Keyframe(View(np.array([2.0, 1.5, 0.0]), np.zeros(3), UP, 1.1), 0.2),
]


def test_it_goes_through_the_key_frames() -> None:
    frames = path_through(KEYS, seconds=2.0, fps=30.0)
    assert len(frames) == 121
    for number, key in zip((0, 60, 120), KEYS):
        frame = frames[number]
        np.testing.assert_allclose(frame.view.position, key.view.position, atol=1e-9)
        np.testing.assert_allclose(frame.view.rotation(), key.view.rotation(), atol=1e-9)
        assert frame.view.fov == pytest.approx(key.view.fov)
        assert frame.time == pytest.approx(key.time)


def test_it_is_smooth_and_never_leaves_the_span_of_its_key_frames() -> None:
    frames = path_through(KEYS, seconds=2.0, fps=30.0)
    places = np.array([frame.view.position for frame in frames])
    assert np.linalg.norm(np.diff(places, axis=0), axis=1).max() < 0.06
    assert places[:, 1].min() >= 0.5 - 1e-9
    times = np.array([frame.time for frame in frames])
    assert (np.diff(times) >= -1e-12).all()
    assert times.max() <= 0.2 + 1e-12
    assert min(frame.view.fov for frame in frames) >= 0.8 - 1e-9


def test_one_key_frame_is_no_path() -> None:
    with pytest.raises(SplashbenchError, match="two key frames or more; add another"):
        path_through(KEYS[:1], 2.0)


def test_what_is_saved_is_read_again(tmp_path: Path) -> None:
    frames = path_through(KEYS, seconds=1.0, fps=10.0)
    cameras = [frame.view.camera(f"path_{k:06d}", 640, 360) for k, frame in enumerate(frames)]
    path = tmp_path / "path.json"
    path.write_bytes(camera_path_bytes(cameras, [frame.time for frame in frames], 10.0))
    again = read_camera_path(path)
    assert again.fps == 10
    assert again.times is not None
    np.testing.assert_allclose(again.times, [frame.time for frame in frames], atol=1e-9)
    for before, after in zip(cameras, again.cameras):
        np.testing.assert_allclose(after.w2c, before.w2c, atol=1e-9)
        np.testing.assert_allclose(after.K, before.K, atol=1e-6)


class Client:
    """Keeps what it is sent to download."""

    def __init__(self) -> None:
        self.downloads: list[tuple[str, bytes]] = []

    def send_file_download(self, name: str, content: bytes, **_: Any) -> None:
        self.downloads.append((name, content))


def test_without_a_folder_the_browser_saves_it() -> None:
    client = Client()
    assert "view.png" in save(None, client, "view", ".png", b"content")
    assert client.downloads == [("view.png", b"content")]


def test_a_folder_keeps_every_one(tmp_path: Path) -> None:
    folder, client = tmp_path / "new" / "folder", Client()
    told = [save(folder, client, "view", ".png", bytes([k])) for k in range(3)]
    assert [path.name for path in sorted(folder.iterdir())] == ["view_001.png", "view_002.png", "view_003.png"]
    assert (folder / "view_003.png").read_bytes() == b"\x02"
    assert str(folder / "view_003.png") in told[2]
    assert client.downloads == []


def test_a_picture_is_a_png(tmp_path: Path) -> None:
    image = np.random.default_rng(0).integers(0, 256, (5, 7, 3)).astype(np.uint8)
    (tmp_path / "a.png").write_bytes(png_bytes(image))
    np.testing.assert_array_equal(read_image(tmp_path / "a.png"), image)

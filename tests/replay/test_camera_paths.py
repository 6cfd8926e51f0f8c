"""Camera paths: nerfstudio's axes and angles, the way to a file and back, orbits, and files that are none."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from splashbench.errors import SplashbenchError
from splashbench.replay.paths import CameraPath, orbit, read_camera_path, write_camera_path
from splashbench.scene import Camera, Scene

ORIGIN = np.zeros((1, 3))


def document(**changes: Any) -> dict[str, Any]:
    """A path of one camera as nerfstudio's viewer writes it: two units behind the origin, and looking at it."""
    pose = [[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 2], [0, 0, 0, 1]]
    frame = {"camera_to_world": np.array(pose, float).ravel().tolist(), "fov": 90.0, "aspect": 1.5}
    frame |= changes.pop("frame", {})
    plain = {"camera_type": "perspective", "render_height": 200, "render_width": 300, "fps": 24, "seconds": 4.0}
    plain |= {"keyframes": [], "is_cycle": False, "smoothness_value": 0.0, "camera_path": [frame]}
    return plain | changes


def written(path: Path, **changes: Any) -> Path:
    path.write_text(json.dumps(document(**changes)), encoding="utf-8")
    return path


def test_what_the_viewer_writes_is_read_in_its_axes(tmp_path: Path) -> None:
    path = read_camera_path(written(tmp_path / "path.json"))
    (camera,) = path.cameras
    assert (camera.width, camera.height, path.fps, path.times) == (300, 200, 24, None)
    assert camera.center == pytest.approx([0, 0, 2])
    # The field of view is vertical: at 90 degrees the focal length is half the height.
    assert pytest.approx(np.array([[100, 0, 150], [0, 100, 100], [0, 0, 1]])) == camera.K
    pixels, depths = camera.project([[0, 0, 0], [0.5, 0, 0], [0, 0.5, 0]])
    assert depths == pytest.approx([2, 2, 2])
    assert pixels == pytest.approx(np.array([[150, 100], [175, 100], [150, 75]]))  # up is up, right is right


def test_its_times_are_shares_of_the_recording(tmp_path: Path) -> None:
    path = written(tmp_path / "path.json", frame={"render_time": 0.25})
    assert read_camera_path(path).times is None
    times = read_camera_path(path, (10.0, 12.0)).times
    assert times is not None
    assert times == pytest.approx([10.5])
    data = document(frame={"render_time": 0.25})
    del (bare := dict(data["camera_path"][0]))["render_time"]
    path.write_text(json.dumps(data | {"camera_path": [data["camera_path"][0], bare]}))
    assert read_camera_path(path, (10.0, 12.0)).times is None  # not every frame has one


def test_cameras_come_back_as_they_were(balls: Scene, tmp_path: Path) -> None:
    cameras = [balls.cameras[name] for name in balls.train]
    # Pixels that are not square, and a principal point off the centre.
    cameras[1] = replace(cameras[1], K=cameras[1].K + np.array([[3, 0, 5], [0, 0, -7], [0, 0, 0]]))
    times = np.linspace(0.1, 0.2, len(cameras)).tolist()
    write_camera_path(tmp_path / "new" / "path.json", cameras, times, 12.5)
    path = read_camera_path(tmp_path / "new" / "path.json", (0.0, 99.0))
    assert path.fps == 12.5
    assert path.times is not None
    assert path.times.tolist() == times
    for before, after in zip(cameras, path.cameras):
        assert (before.width, before.height) == (after.width, after.height)
        assert before.w2c == pytest.approx(after.w2c, abs=1e-9)
        assert pytest.approx(after.K, abs=1e-9) == before.K
    data = json.loads((tmp_path / "new" / "path.json").read_text())
    assert data["seconds"] == pytest.approx(len(cameras) / 12.5)
    assert data["camera_path"][1]["fl_x"] == cameras[1].K[0, 0]


def test_the_file_has_what_nerfstudio_looks_for(tmp_path: Path) -> None:
    camera = Camera("a", 300, 200, np.array([[100.0, 0, 150], [0, 100, 100], [0, 0, 1]]), np.eye(4))
    write_camera_path(tmp_path / "path.json", [camera, camera], [0, 1], 24)
    data = json.loads((tmp_path / "path.json").read_text())
    assert {"camera_path", "keyframes", "render_height", "render_width", "fps", "seconds", "camera_type"} <= set(data)
    frame = data["camera_path"][0]
    assert frame["camera_to_world"] == np.diag([1.0, -1, -1, 1]).ravel().tolist()
    assert frame["fov"] == pytest.approx(90)
    assert frame["aspect"] == 1.5
    assert "fl_x" not in frame  # it says no more than the angle
    assert data["keyframes"][0]["matrix"] == frame["camera_to_world"]


@pytest.mark.parametrize(
    ("changes", "fault"),
    [
        ({"camera_path": []}, "camera_path"),
        ({"render_height": 1_000_000_000}, "render_height"),
        ({"render_width": 0}, "render_width"),
        ({"fps": float("nan")}, "fps"),
        ({"fps": 1e9}, "fps"),
        ({"fps": -1}, "fps"),
        ({"camera_type": "fisheye"}, "camera_type is fisheye"),
        ({"frame": {"fov": 180}}, "fov"),
        ({"frame": {"fov": float("inf")}}, "fov"),
        ({"frame": {"camera_to_world": [1.0] * 15}}, "camera_to_world"),
        ({"frame": {"camera_to_world": [float("nan")] * 16}}, "camera_to_world"),
        ({"frame": {"camera_to_world": [0.0] * 16}}, "no rotation"),
        ({"frame": {"camera_to_world": (3 * np.eye(4)).ravel().tolist()}}, "no rotation"),
        ({"frame": {"camera_to_world": "[1, 0]"}}, "camera_to_world"),
        ({"frame": {"render_time": 2}}, "render_time"),
        ({"frame": {"time": 1e300}}, "time"),
        ({"frame": {"fl_x": -1}}, "fl_x"),
    ],
)
def test_a_path_that_is_none_is_one_line(changes: dict[str, Any], fault: str, tmp_path: Path) -> None:
    path = written(tmp_path / "path.json", **changes)
    with pytest.raises(SplashbenchError) as error:
        read_camera_path(path)
    assert str(path) in str(error.value)
    assert fault in str(error.value)


def test_a_file_that_is_no_path_at_all_is_one_line(tmp_path: Path) -> None:
    for text in ("", "[]", "{}", '{"camera_path": 3}', "\0"):
        (tmp_path / "path.json").write_text(text)
        with pytest.raises(SplashbenchError, match=r"path\.json"):
            read_camera_path(tmp_path / "path.json")
    with pytest.raises(SplashbenchError, match="is a folder"):
        read_camera_path(tmp_path)
    with pytest.raises(SplashbenchError, match="does not exist"):
        read_camera_path(tmp_path / "none.json")


def test_only_paths_are_written(balls: Scene, tmp_path: Path) -> None:
    one = balls.cameras["1"]
    for cameras, times, fps in (
        ([], [], 24),
        ([one, one.scaled(0.5)], [0, 1], 24),
        ([one], [0, 1], 24),
        ([one], [float("nan")], 24),
        ([one], [0], float("nan")),
        ([one], [0], 0),
    ):
        with pytest.raises(SplashbenchError, match="cannot be written"):
            write_camera_path(tmp_path / "path.json", cameras, times, fps)
    assert list(tmp_path.iterdir()) == []
    with pytest.raises(ValueError, match="as many times"):
        CameraPath((one,), np.zeros(2), 24)


def ring(azimuths: list[float], distance: float = 2.0, height: float = 30.0) -> list[Camera]:
    """Cameras around (1, 2, 3) at the given azimuths, in degrees, around y."""
    rig = []
    for azimuth in np.radians(azimuths):
        level = np.array([np.cos(azimuth), 0, -np.sin(azimuth)]) * np.cos(np.radians(height))
        eye = np.array([1, 2, 3]) + distance * (level + np.array([0, np.sin(np.radians(height)), 0]))
        w2c = np.eye(4)
        w2c[:3, 3] = -eye
        rig.append(Camera("c", 300, 200, np.array([[250.0, 0, 140], [0, 250, 90], [0, 0, 1]]), w2c))
    return rig


def around(path: CameraPath) -> np.ndarray:
    """Azimuths of a path's cameras in degrees, as `ring` takes them, within 180 of the first."""
    x, _, z = (np.array([camera.center for camera in path.cameras]) - [1, 2, 3]).T
    return np.degrees(np.unwrap(np.arctan2(-z, x)))


def test_an_orbit_keeps_to_the_cameras_arc_and_looks_at_the_liquid() -> None:
    # Across the place where azimuths begin anew.
    path = orbit(ring([-20, 0, 30, 340]), [1, 2, 3], [0, 5, 0], 40)
    azimuths = around(path)
    assert azimuths.min() == pytest.approx(-20, abs=1e-6)
    assert azimuths.max() == pytest.approx(30, abs=1e-6)
    for camera in path.cameras:
        pixel, depth = camera.project([[1, 2, 3]])
        assert pixel[0] == pytest.approx([150, 100])
        assert depth == pytest.approx([2])
        above, _ = camera.project([[1, 2.1, 3]])
        assert above[0, 1] < 100
    # Smooth, also from the last frame to the first of a loop: no step is longer than those of a sine.
    steps = np.abs(np.diff(np.append(azimuths, azimuths[0])))
    assert steps.max() <= 25 * 2 * np.pi / 40
    elevations = [np.degrees(np.arcsin((camera.center[1] - 2) / 2)) for camera in path.cameras]
    assert elevations == pytest.approx([30] * 40)


def test_an_orbit_goes_all_around_where_cameras_stand_all_around() -> None:
    for path in (
        orbit(ring([0, 80, 160, 240, 300]), [1, 2, 3], [0, 1, 0], 12),
        orbit(ring([0, 10]), [1, 2, 3], [0, 1, 0], 12, degrees=360),
    ):
        assert np.diff(around(path)) == pytest.approx([30] * 11)


def test_an_orbit_of_ones_own_extent_and_height() -> None:
    path = orbit(ring([0, 40]), [1, 2, 3], [0, 1, 0], 30, degrees=100, height=-10, fps=25)
    assert path.fps == 25
    assert np.ptp(around(path)) == pytest.approx(100, abs=1e-6)
    assert around(path).mean() == pytest.approx(20, abs=1e-6)
    assert [camera.center[1] for camera in path.cameras] == pytest.approx([2 - 2 * np.sin(np.radians(10))] * 30)
    steep = orbit(ring([0, 40]), [1, 2, 3], [0, 1, 0], 3, height=90)
    assert all(np.isfinite(camera.w2c).all() for camera in steep.cameras)


def test_cameras_in_one_direction_have_no_arc_of_their_own() -> None:
    for rig in (ring([20]), ring([20, 20])):
        with pytest.raises(SplashbenchError, match="give the orbit's own \\(--orbit-degrees\\)"):
            orbit(rig, [1, 2, 3], [0, 1, 0], 12)
        assert np.ptp(around(orbit(rig, [1, 2, 3], [0, 1, 0], 12, degrees=40))) == pytest.approx(40, abs=1e-6)


def test_no_orbit_goes_around_what_all_cameras_look_down_on() -> None:
    with pytest.raises(SplashbenchError, match="above or below the liquid"):
        orbit(ring([0], height=90), [1, 2, 3], [0, 1, 0], 3)

"""What a video's frames show: at which instants, from where, which layer, beside what, and with which caption."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from splashbench.errors import SplashbenchError
from splashbench.harness.contract import Render
from splashbench.replay import Reconstruction, load
from splashbench.replay.paths import write_camera_path
from splashbench.scene import Scene
from splashbench.submission import to_8bit
from splashbench.video import TRUTH, Comparison, Film, VideoSettings, make_film
from splashbench.video.layers import Shot

PLAIN = VideoSettings(caption=False)
RED, SKY = np.array([255, 0, 0]), np.array([64, 128, 191])


def times(film: Film) -> list[float]:
    return film.timing.times.tolist()


def test_real_time_and_slow_motion_have_every_instant_once(ball: Reconstruction) -> None:
    last = ball.times[-1]
    film = make_film(ball, PLAIN)
    assert film.timing.fps == 30
    assert len(film) == int(last * 30) + 1
    assert times(film) == pytest.approx(np.arange(len(film)) / 30)
    assert film.timing.speed(0) == pytest.approx(1)
    slow = make_film(ball, replace(PLAIN, slow=8))
    assert len(slow) == int(last * 240) + 1
    assert np.diff(slow.timing.times) == pytest.approx([1 / 240] * (len(slow) - 1))
    assert slow.timing.speed(5) == pytest.approx(1 / 8)
    part = make_film(ball, replace(PLAIN, start=0.1, end=0.2, fps=50))
    assert times(part) == pytest.approx([0.1, 0.12, 0.14, 0.16, 0.18, 0.2])


def test_a_length_or_the_timesteps_alone(ball: Reconstruction) -> None:
    film = make_film(ball, replace(PLAIN, seconds=2, fps=10))
    assert len(film) == 20
    assert times(film)[:: len(film) - 1] == pytest.approx(ball.times[[0, -1]])
    steps = make_film(ball, replace(PLAIN, timesteps=True))
    assert times(steps) == ball.times.tolist()
    assert steps.timing.fps == pytest.approx(1 / np.median(np.diff(ball.times)))
    assert make_film(ball, replace(PLAIN, timesteps=True, slow=2)).timing.fps == pytest.approx(steps.timing.fps / 2)
    assert make_film(ball, replace(PLAIN, timesteps=True, fps=5)).timing.fps == 5


def test_frames_are_the_renders_of_the_chosen_view(ball: Reconstruction) -> None:
    for name in (None, "7", "2"):
        film = make_film(ball, replace(PLAIN, view=name))
        camera = ball.cameras[name or "6"]  # the first test camera
        assert film.size == (camera.width, camera.height)
        for k in (0, 3, len(film) - 1):
            assert np.array_equal(film.frame(k), to_8bit(ball.render(camera, film.timing.times[k]).rgb))
    small = make_film(ball, replace(PLAIN, resize=0.5)).frame(2)
    assert np.array_equal(small, to_8bit(ball.render(ball.cameras["6"].scaled(0.5), 2 / 30).rgb))


def test_all_frames_come_in_order_when_they_are_asked_for(ball: Reconstruction) -> None:
    film = make_film(ball, replace(PLAIN, slow=100))
    frames = film.frames()
    assert ball.fitted.times == []  # type: ignore[attr-defined]
    for k in range(3):
        assert np.array_equal(next(frames), film.frame(k))
    assert len(ball.fitted.times) == 6  # type: ignore[attr-defined]


@pytest.mark.parametrize(
    ("rgb", "fault"),
    [
        (np.zeros((3, 4, 3), np.float32), "ValueError: pictures of shape"),
        (np.full((64, 96, 3), np.nan, np.float32), "values that are not finite"),
        (None, r"ValueError: pictures of shape \(\)"),
    ],
)
def test_a_method_that_fails_is_one_line(rgb: np.ndarray | None, fault: str, ball: Reconstruction) -> None:
    ball.fitted.render = lambda camera, time: Render(rgb, np.zeros((64, 96), np.float32))  # type: ignore
    with pytest.raises(SplashbenchError, match=f"method oracle cannot give the view of camera .*{fault}"):
        make_film(ball, PLAIN).frame(1)


def test_an_orbit_moves_around_the_liquid_and_may_stop_the_time(ball: Reconstruction) -> None:
    film = make_film(ball, replace(PLAIN, orbit=True, start=0.1, end=0.1, seconds=1, fps=20))
    assert times(film) == [0.1] * 20
    assert len(film.cameras) == 20
    centers = np.array([camera.center for camera in film.cameras])
    assert np.linalg.norm(np.diff(centers, axis=0), axis=1).min() > 0
    # The liquid is before each camera: its ball is in each picture.
    assert all((film.frame(k) == film.frame(k)[0, 0]).all(axis=-1).mean() < 1 for k in range(20))
    assert make_film(ball, replace(PLAIN, orbit=True)).timing.times.tolist() == times(make_film(ball, PLAIN))


def test_a_path_brings_its_cameras_and_their_times(ball: Reconstruction, tmp_path: Path) -> None:
    cameras = [ball.cameras[name] for name in ("1", "2", "3")]
    write_camera_path(tmp_path / "path.json", cameras, [0.3, 0.2, 0.2], 12)
    film = make_film(ball, replace(PLAIN, path=tmp_path / "path.json"))
    assert times(film) == [0.3, 0.2, 0.2]
    assert film.timing.fps == 12
    for k, camera in enumerate(cameras):
        assert np.abs(film.frame(k).astype(int) - to_8bit(ball.render(camera, times(film)[k]).rgb)).mean() < 0.5
    text = (tmp_path / "path.json").read_text().replace('"time":', '"once":')
    (tmp_path / "untimed.json").write_text(text)
    spread = make_film(ball, replace(PLAIN, path=tmp_path / "untimed.json", start=0.1, end=0.3, fps=5))
    assert times(spread) == pytest.approx([0.1, 0.2, 0.3])
    assert spread.timing.fps == 5


def test_halves_are_the_render_and_the_nearest_photograph(ball: Reconstruction, balls: Scene) -> None:
    film = make_film(ball, PLAIN, Comparison([TRUTH]))
    width = ball.cameras["6"].width
    assert film.size == (2 * width, ball.cameras["6"].height)
    alone = make_film(ball, PLAIN)
    for k in range(len(film)):
        frame = film.frame(k)
        assert np.array_equal(frame[:, :width], alone.frame(k))
        nearest = int(np.abs(balls.times - times(film)[k]).argmin())
        assert np.array_equal(frame[:, width:], balls.image("6", nearest))
        assert film.panels[1].note(times(film)[k]) == f"taken at {balls.times[nearest]:.3f} s"


def test_a_view_keeps_the_time_of_its_own_photographs(tmp_path: Path, oracle: Path) -> None:
    from splashbench.harness.runner import run_method
    from splashbench.synth.balls import write_balls_scene

    scene = write_balls_scene(tmp_path / "late", delays={"6": 0.01})
    run_method("oracle", tmp_path / "late", tmp_path / "submission", timing_frames=0)
    film = make_film(load(tmp_path / "submission", tmp_path / "late"), PLAIN, Comparison([TRUTH]))
    assert times(film) == scene.camera_times["6"].tolist()
    assert np.array_equal(film.frame(3)[:, 96:], scene.image("6", 3))


def test_a_wipe_has_one_picture_on_either_side(ball: Reconstruction, balls: Scene) -> None:
    film = make_film(ball, PLAIN, Comparison([TRUTH], "wipe", 0.25))
    frame, width = film.frame(0), 96
    assert film.size == (width, 64)
    assert np.array_equal(frame[:, :23], make_film(ball, PLAIN).frame(0)[:, :23])
    assert np.array_equal(frame[:, 25:], balls.image("6", 0)[:, 25:])
    assert (frame[:, 23:25] == 255).all()
    moving = make_film(ball, replace(PLAIN, slow=4), Comparison([TRUTH], "wipe"))
    places = [int(np.flatnonzero((moving.frame(k) == 255).all(axis=(0, 2)))[0]) for k in range(len(moving))]
    assert min(places) < 0.1 * width
    assert max(places) > 0.9 * width
    assert np.abs(np.diff(places)).max() < 0.1 * width


def test_two_submissions_beside_each_other(ball: Reconstruction, oracle: Path, balls_directory: Path) -> None:
    other = load(oracle, balls_directory)  # the true pictures
    film = make_film(ball, PLAIN, Comparison([other, TRUTH]))
    assert times(film) == ball.times.tolist()  # what keeps no model has timesteps alone
    frame = film.frame(2)
    assert np.array_equal(frame[:, 96:192], frame[:, 192:])
    # Both are of one method, preset, seed and folder's name: a number tells them apart.
    assert [panel.title for panel in film.panels] == ["oracle (1)", "oracle (2)", "photograph"]


def test_layers_show_what_their_names_say(ball: Reconstruction, balls: Scene) -> None:
    camera = ball.cameras["6"]
    shot = Shot(ball, camera, 0.2)
    inside = shot.alpha > 0.5
    assert 50 < inside.sum() < inside.size / 2

    def values(layer: str, **more: object) -> tuple[np.ndarray, Film]:
        film = make_film(ball, replace(PLAIN, layer=layer, start=0.2, end=0.25, **more))  # type: ignore[arg-type]
        return film.frame(0), film

    opacity, film = values("opacity")
    assert film.panels[0].scale is not None
    table = film.panels[0].scale.colors(np.array([0.0, 0.75]))
    assert np.array_equal(opacity[inside], np.broadcast_to(table[1], (inside.sum(), 3)))
    assert np.array_equal(opacity[~inside], np.broadcast_to(table[0], ((~inside).sum(), 3)))

    liquid, _ = values("liquid", flat=(10, 20, 30))
    assert np.array_equal(liquid[0, 0], [10, 20, 30])
    assert np.abs(liquid[inside] - (0.75 * RED + 0.25 * np.array([10, 20, 30]))).max() <= 1

    error, film = values("error", scale=(0.0, 1.0))
    photograph = balls.image("6", int(np.abs(balls.times - 0.2).argmin()))
    expected = np.abs(shot.rgb - photograph / 255.0).mean(axis=-1)
    assert film.panels[0].scale is not None
    assert np.abs(error.astype(int) - film.panels[0].scale.colors(expected)).max() <= 5  # a step of the map

    _, film = values("velocity")
    assert film.panels[0].scale is not None
    assert (film.panels[0].scale.unit, film.panels[0].scale.low) == ("m/s", 0)
    assert film.panels[0].scale.high >= 0.5
    assert np.nanmin(shot.speed) == pytest.approx(0.5)
    assert np.nanmax(shot.speed) == pytest.approx(0.5)

    depth, film = values("depth")
    assert film.panels[0].scale is not None
    assert film.panels[0].scale.unit == "m"
    low, high = film.panels[0].scale.low, film.panels[0].scale.high
    center = camera.w2c[:3] @ np.array([-0.1 + 0.5 * 0.2, 0.3, 0, 1])
    nearest = np.nanmin(shot.depth)
    assert nearest == pytest.approx(center[2] - 0.15, abs=0.01)
    seen = shot.depth[np.isfinite(shot.depth)]
    assert low <= seen.min()
    assert seen.max() <= high
    assert high - low < 2 * np.ptp(seen)
    gray = depth[~inside].astype(int)
    assert (np.ptp(gray, axis=1) == 0).all()  # what is no liquid has no colour


def test_a_scale_is_that_of_the_whole_video_and_of_all_who_are_compared(ball: Reconstruction) -> None:
    film = make_film(ball, replace(PLAIN, layer="depth", slow=2), Comparison([ball]))
    assert film.panels[0].scale == film.panels[1].scale
    scale = film.panels[0].scale
    assert scale is not None
    for k in range(len(film)):
        depths = Shot(ball, film.camera(k), times(film)[k]).depth
        if np.isfinite(depths).any():
            assert scale.low - 0.05 <= np.nanmin(depths) <= np.nanmax(depths) <= scale.high + 0.05


def test_a_caption_never_covers_the_picture(ball: Reconstruction) -> None:
    for layer in ("color", "error"):
        plain = make_film(ball, replace(PLAIN, layer=layer), Comparison([TRUTH]))
        told = make_film(ball, replace(PLAIN, layer=layer, caption=True), Comparison([TRUTH]))
        height = plain.size[1]
        assert told.size[0] == plain.size[0]
        assert told.size[1] > height
        frames = [told.frame(k) for k in range(len(told))]
        assert all(frame.shape == (told.size[1], told.size[0], 3) for frame in frames)
        for k, frame in enumerate(frames):
            assert np.array_equal(frame[:height], plain.frame(k))
        # Text is bright on dark, below both pictures, and tells the time.
        assert all(frame[height:, :96].max() > 150 and frame[height:, 96:].max() > 150 for frame in frames)
        assert not np.array_equal(frames[0][height:], frames[1][height:])


@pytest.mark.parametrize(
    ("changes", "fault"),
    [
        ({"view": "9"}, "there is no camera '9'; choose one of"),
        ({"view": "6", "orbit": True}, "exclude each other"),
        ({"start": -1.0}, "--start -1 is beyond the recording, which lasts from 0.000 to"),
        ({"end": 99.0}, "--end 99 is beyond the recording"),
        ({"start": 0.2, "end": 0.1}, "is before --start"),
        ({"start": 0.2, "end": 0.2}, "--orbit and --seconds"),
        ({"start": 0.2, "end": 0.2, "seconds": 3.0}, "--orbit and --seconds"),
        ({"slow": 1e9}, "more than 100000 frames"),
        ({"seconds": 1e9}, "a video has 1 to 100000"),
        ({"seconds": 1e-9}, "would have 0 frames"),
        ({"slow": 2.0, "seconds": 3.0}, "give one of them"),
        ({"fps": 1e6}, "give another --fps"),
        ({"fps": float("nan")}, "frames a second"),
        ({"timesteps": True, "seconds": 3.0}, "leave --seconds out"),
        ({"layer": "sparkle"}, "there is no layer 'sparkle'; choose one of color, opacity"),
        ({"resize": 1000.0}, "give a smaller --resize"),
    ],
)
def test_what_cannot_be_is_told_before_a_frame_is_made(
    changes: dict[str, object], fault: str, ball: Reconstruction
) -> None:
    with pytest.raises(SplashbenchError) as error:
        make_film(ball, replace(PLAIN, **changes))  # type: ignore[arg-type]
    assert fault in str(error.value)
    assert ball.fitted.times == []  # type: ignore[attr-defined]


def test_photographs_need_a_scene_and_one_of_its_cameras(ball: Reconstruction, oracle: Path) -> None:
    with pytest.raises(SplashbenchError, match="give --view, not an orbit"):
        make_film(ball, replace(PLAIN, orbit=True), Comparison([TRUTH]))
    with pytest.raises(SplashbenchError, match="give --scene"):
        make_film(load(oracle), PLAIN, Comparison([TRUTH]))
    with pytest.raises(SplashbenchError, match="give --scene"):
        make_film(load(oracle), replace(PLAIN, layer="error"))


def test_what_a_method_does_not_hand_in_cannot_be_shown(points: Path) -> None:
    reconstruction = load(points)
    for layer in ("depth", "velocity"):
        with pytest.raises(SplashbenchError, match="method hull_points hands in none"):
            make_film(reconstruction, replace(PLAIN, layer=layer))
    # Without an empty view, what is not liquid is the colour alone.
    frame = make_film(reconstruction, replace(PLAIN, layer="liquid", flat=(10, 20, 30))).frame(3)
    assert np.array_equal(frame[0, 0], [10, 20, 30])


def test_submissions_of_two_scenes_are_not_compared(ball: Reconstruction, tmp_path: Path) -> None:
    from splashbench.harness.runner import run_method
    from splashbench.synth.balls import write_balls_scene

    write_balls_scene(tmp_path / "other", seed=1)
    run_method("oracle", tmp_path / "other", tmp_path / "submission", timing_frames=0)
    with pytest.raises(SplashbenchError, match="compare two of one scene"):
        make_film(ball, PLAIN, Comparison([load(tmp_path / "submission")]))


def test_rates_that_nobody_said_are_those_that_the_file_can_have(ball: Reconstruction, tmp_path: Path) -> None:
    write_camera_path(tmp_path / "path.json", [ball.cameras["1"]] * 3, [0.1, 0.2, 0.3], 30)
    for changes in ({}, {"timesteps": True}, {"path": tmp_path / "path.json"}):
        settings = replace(PLAIN, **changes)  # type: ignore[arg-type]
        plain, made = make_film(ball, settings), make_film(ball, settings, rate=lambda fps: fps + 3)
        assert made.timing.fps == pytest.approx(plain.timing.fps + 3)
        assert make_film(ball, replace(settings, fps=12), rate=lambda fps: fps + 3).timing.fps == 12


def test_a_photograph_is_read_once_while_it_is_shown(ball: Reconstruction, monkeypatch: pytest.MonkeyPatch) -> None:
    film = make_film(ball, replace(PLAIN, slow=4, resize=0.5), Comparison([TRUTH]))
    read: list[int] = []
    real = Scene.image
    monkeypatch.setattr(Scene, "image", lambda scene, name, t: read.append(t) or real(scene, name, t))
    frames = list(film.frames())
    assert len(frames) > 2 * len(ball.times)
    assert read == list(range(len(ball.times)))


def test_a_path_does_not_leave_the_recording(ball: Reconstruction, tmp_path: Path) -> None:
    path = tmp_path / "path.json"
    write_camera_path(path, [ball.cameras["1"]] * 2, [0.1, 5.0], 12)
    with pytest.raises(SplashbenchError, match=r"frame 1 is at 5\.000 s, beyond the recording"):
        make_film(ball, replace(PLAIN, path=path))
    for changes in ({"slow": 2.0}, {"seconds": 2.0}, {"timesteps": True}, {"start": 0.1}):
        with pytest.raises(SplashbenchError, match="frames and their times"):
            make_film(ball, replace(PLAIN, path=path, **changes))  # type: ignore[arg-type]

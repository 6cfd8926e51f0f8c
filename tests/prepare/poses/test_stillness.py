"""A camera that moved between its static clip and the pour is found, in pixels; one that stayed is not reported."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from splashbench.errors import SplashbenchError
from splashbench.prepare.gate import Gate, require
from splashbench.prepare.gates import stillness_gates, stillness_limit
from splashbench.prepare.poses.stillness import INSTANTS, Shift, Stillness, background_shift
from splashbench.synth.imaging.lens import LensCamera
from splashbench.synth.imaging.rendering import RoomView, TracedRoom
from splashbench.synth.imaging.room import pour_room, static_room
from splashbench.synth.recording.plan import BOARD, RecordingOptions, make_plan
from splashbench.synth.recording.video import SensorNoise

SIZE = (480, 270)


class Filming:
    """The rooms of one seed: with the board on the table, and with the bowl and something red that moves before it."""

    def __init__(self, seed: int) -> None:
        self.seed = seed
        self.rng = np.random.default_rng([seed, 99])
        self.recorders = make_plan(RecordingOptions(size=SIZE, fps=30, seed=seed)).recorders
        self.static_room, self.pour_room = TracedRoom(static_room(seed, BOARD)), TracedRoom(pour_room(seed))

    def static(self, name: str) -> np.ndarray:
        image = RoomView(self.static_room, self.recorders[name].camera, samples=2).image
        frames = [self.exposed(image, 1.3, 1.0) for _ in range(5)]
        return np.median(np.stack(frames), axis=0).round().astype(np.uint8)

    def pour(self, name: str, turned: tuple[float, float, float] = (0, 0, 0), noise=1.3, gain=1.0) -> list[np.ndarray]:
        """Five frames by a camera turned by so many pixels about its x, y and viewing axis."""
        camera = self.recorders[name].camera
        view = RoomView(self.pour_room, turned_by(camera, turned), samples=2).image
        frames = []
        for step in range(5):
            image = view.copy()
            cv2.circle(image, (210 + 9 * step, 120 + 5 * step), 35, (0.8, 0.1, 0.1), -1)
            frames.append(self.exposed(image, noise, gain))
        return frames

    def exposed(self, image: np.ndarray, noise: float, gain: float) -> np.ndarray:
        """A noisy frame at another exposure, compressed as a video is."""
        frame = SensorNoise(*SIZE, (int(self.rng.integers(1 << 30)),), noise).expose(np.float32(gain) * image)
        return cv2.imdecode(cv2.imencode(".jpg", frame, (cv2.IMWRITE_JPEG_QUALITY, 80))[1], cv2.IMREAD_COLOR)


def turned_by(camera: LensCamera, pixels: tuple[float, float, float]) -> LensCamera:
    turn = np.eye(4)
    angles = np.array(pixels) / [camera.K[0, 0], camera.K[0, 0], 180.0]  # about the axis: where its features lie
    turn[:3, :3] = Rotation.from_rotvec(angles).as_matrix()
    return camera.moved(turn @ camera.w2c)


@pytest.fixture(scope="module")
def filming() -> Filming:
    return Filming(0)


@pytest.mark.parametrize(
    ("turned", "px"), [((0, 0, 0), 0.0), ((2, 0, 0), 2.0), ((0, -2, 0), 2.0), ((0, 0, 3), 3.0), ((0, 30, 0), 30.0)]
)
def test_a_bump_is_measured_in_pixels(filming: Filming, turned: tuple[float, float, float], px: float) -> None:
    shift = background_shift(filming.static("2"), filming.pour("2", turned))
    assert shift.px is not None
    assert shift.px == pytest.approx(px, abs=0.1 + 0.1 * px)
    assert (shift.px > stillness_limit(SIZE[0])) is (px > 0)


def test_another_place_is_not_taken_for_this_one(filming: Filming) -> None:
    elsewhere = Filming(3)
    shift = background_shift(filming.static("1"), elsewhere.pour("1"))
    assert shift.px is None
    gates = stillness_gates(seen(shift), widths(SIZE[0]))
    with pytest.raises(SplashbenchError, match="the pour of camera 1 shows another place than its static clip"):
        require(gates, "session")


def test_a_blank_picture_agrees_with_nothing(filming: Filming) -> None:
    blank = np.full((*SIZE[::-1], 3), 90, np.uint8)
    assert background_shift(filming.static("1"), [blank] * 5) == Shift(None, 0, 0)


def test_a_cloth_that_was_moved_is_no_camera_that_moved() -> None:
    """The thing that moved has more features than the background, but it is compact."""
    rng = np.random.default_rng(4)
    scenery = cv2.resize(rng.integers(90, 130, (27, 48, 3)).astype(np.uint8), SIZE, interpolation=cv2.INTER_CUBIC)
    cloth = cv2.resize(rng.integers(0, 255, (40, 40, 3)).astype(np.uint8), (120, 120), interpolation=cv2.INTER_CUBIC)
    before, now = scenery.copy(), scenery.copy()
    before[100:220, 180:300], now[112:232, 195:315] = cloth, cloth
    shift = background_shift(before, [now] * 3)
    assert shift.px is not None
    assert shift.px < 0.2


@pytest.mark.slow
def test_ten_good_sessions_report_nothing() -> None:
    """Seven cameras each, at the noise and exposure of ten days; docs/session_format.md has the figures."""
    shifts, bumps = [], []
    for seed in range(10):
        filming = Filming(seed)
        noise, gain = np.random.default_rng([seed, 5]).uniform([0.5, 0.6], [5.0, 1.3])
        for name in filming.recorders:
            static = filming.static(name)
            shifts.append(background_shift(static, filming.pour(name, noise=noise, gain=gain)))
        bumps.append(background_shift(static, filming.pour(name, (1.6, 1.2, 0), noise, gain)))
    px = [shift.px for shift in shifts if shift.px is not None]
    print(f"at rest: at most {max(px):.3f} px, median {np.median(px):.3f}, fewest {min(s.agreeing for s in shifts)}")
    print(f"bumped by 2 px: {min(b.px or 0 for b in bumps):.3f} to {max(b.px or 0 for b in bumps):.3f} px")
    assert len(px) == 70
    assert max(px) < stillness_limit(SIZE[0]) / 2
    assert all(bump.px == pytest.approx(2, abs=0.3) for bump in bumps)


def seen(*shifts: Shift) -> dict[str, Stillness]:
    """By camera 1, 2, ...: the same shift at every instant."""
    return {str(k + 1): dict.fromkeys(INSTANTS, shift) for k, shift in enumerate(shifts)}


def widths(px: int) -> dict[str, int]:
    return {"1": px, "2": px}


def failed(gates: list[Gate]) -> list[Gate]:
    assert all(gate.essential for gate in gates)
    return [gate for gate in gates if not gate.passed]


def test_gates_say_which_camera_moved_and_when() -> None:
    still, moved = Shift(0.1, 100, 120), Shift(2.0, 90, 120)
    assert failed(stillness_gates(seen(still, still), widths(480))) == []
    (gate,) = failed(stillness_gates(seen(still, moved), widths(480)))
    assert gate.name == "camera_shift"
    assert "camera 2: start 2.00, middle 2.00, end 2.00" in gate.detail
    assert "camera 2 moved between its static clip and the pour" in gate.remedy
    during = seen(still, still)
    during["1"] = during["1"] | {"end": moved}
    (gate,) = failed(stillness_gates(during, widths(480)))
    assert "camera 1 moved during the pour: fasten it" in gate.remedy
    # Somebody stands before camera 2 in the middle of the pour: this is the same place, and it is said.
    hidden = seen(still, still)
    hidden["2"] = hidden["2"] | {"middle": Shift(None, 3, 9)}
    gates = stillness_gates(hidden, widths(480))
    (gate,) = [gate for gate in gates if not gate.passed]
    assert (gate.name, gate.essential) == ("shift_unmeasured", False)
    assert "camera 2 at the middle" in gate.detail
    # The limit grows with each camera's own picture: 2 px of 4K are an eighth of what they are at 480 px.
    assert failed(stillness_gates(seen(still, replace(moved, px=1.9)), widths(3840))) == []
    (gate,) = failed(stillness_gates(seen(replace(moved, px=1.9), replace(moved, px=1.5)), {"1": 3840, "2": 1920}))
    assert (gate.value, gate.limit) == (1.5, 0.96)
    assert "camera 2 moved" in gate.remedy
    assert "camera 1" not in gate.remedy
    assert failed(stillness_gates(seen(replace(moved, px=0.4), replace(moved, px=1.9)), {"1": 480, "2": 3840})) == []

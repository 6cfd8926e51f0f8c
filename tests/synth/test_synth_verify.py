"""Errors put into a preparation on purpose come out of `synth verify` in the right unit."""

from __future__ import annotations

import json
import shutil
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from splashbench.cli.main import main
from splashbench.errors import SplashbenchError
from splashbench.files import read_gray, write_json
from splashbench.scene import Camera, Scene, SceneMeta, write_scene
from splashbench.synth.imaging.lens import distort
from splashbench.synth.recording.truth import Truth
from splashbench.synth.recording.verification import verify_scene

SCALE = 7.0  # scene units per metre
TURN = Rotation.from_euler("xyz", [0.3, -0.8, 0.5]).as_matrix()
SHIFT = np.array([0.4, -1.0, 2.0])
METRE_ERROR = 1.02
SYNC_ERROR = {"3": 0.004, "7": -0.002}
FOCAL_ERROR = {"2": 1.01}


def to_scene(points: np.ndarray) -> np.ndarray:
    return SCALE * points @ TURN.T + SHIFT


def moved(w2c: np.ndarray) -> np.ndarray:
    """The pose of a camera of the true world in the scene's coordinates."""
    pose = np.eye(4)
    pose[:3, :3] = w2c[:3, :3] @ TURN.T
    pose[:3, 3] = SCALE * w2c[:3, 3] - pose[:3, :3] @ SHIFT
    return pose


@pytest.fixture
def prepared(small_session: Path, tmp_path: Path) -> Path:
    """What a preparation of the small session might have been, with some errors of known size."""
    truth = Truth(small_session)
    facts = truth.file.cameras
    times = np.linspace(truth.file.pour.start_s + 0.1, truth.file.pour.end_s - 0.05, 5)
    cameras, report = {}, {"reference": "1", "sync": {}, "intrinsics": {}, "poses": {}, "else": 1}
    indices = {}
    for name, camera in facts.items():
        w2c = moved(np.array(camera.w2c))
        cameras[name] = Camera(name, camera.width, camera.height, np.array(camera.K), w2c)
        start = camera.start_s + SYNC_ERROR.get(name, 0.0)
        report["sync"][name] = {"start_s": start, "clock_rate": camera.clock_rate, "confidence": 9.0}
        K = np.array(camera.K) * np.array([[FOCAL_ERROR.get(name, 1.0)] * 2 + [1.0]] * 2 + [[1.0] * 3])
        lens = {"K": K.tolist(), "distortion": camera.distortion, "width": camera.width, "height": camera.height}
        report["intrinsics"][name] = lens
        report["poses"][name] = {"w2c": w2c.tolist()}
        indices[name] = np.round((times - start) / camera.clock_rate * camera.fps).astype(int)

    def frames() -> Iterator[tuple[str, int, np.ndarray, np.ndarray]]:
        for name, camera in facts.items():
            u, v = np.meshgrid(np.arange(camera.width) + 0.5, np.arange(camera.height) + 0.5)
            K = np.array(camera.K)
            rays = np.stack([(u - K[0, 2]) / K[0, 0], (v - K[1, 2]) / K[1, 1]], axis=-1)
            raw = distort(rays, np.array(camera.distortion)) @ K[:2, :2].T + K[:2, 2]
            column, row = np.floor(raw).astype(int)[..., 0], np.floor(raw).astype(int)[..., 1]
            for t, index in enumerate(indices[name]):
                mask = read_gray(truth.mask_path(name, index)) > 127
                row, column = row.clip(0, camera.height - 1), column.clip(0, camera.width - 1)
                yield name, t, np.zeros((*mask.shape, 3), np.uint8), mask[row, column]

    own = {
        name: (report["sync"][name]["start_s"] + camera.clock_rate * indices[name] / camera.fps).tolist()
        for name, camera in facts.items()
    }
    directory = tmp_path / "scene"
    meta = SceneMeta(
        name="prepared", times=times.tolist(), camera_times=own, metres_per_unit=METRE_ERROR / SCALE, gravity=(0, -1, 0)
    )
    names = list(facts)
    write_scene(directory, cameras=cameras, train=names[:5], test=names[5:], n_frames=5, frames=frames(), meta=meta)
    write_json(directory / "prepare_report.json", report)
    return directory


def test_known_errors_are_found(small_session: Path, prepared: Path) -> None:
    found = verify_scene(small_session, prepared)
    for name, errors in found.cameras.items():
        assert errors.sync_error_ms == pytest.approx(1e3 * SYNC_ERROR.get(name, 0.0), abs=1e-6)
        assert errors.focal_error_percent == pytest.approx(100 * (FOCAL_ERROR.get(name, 1.0) - 1), abs=1e-6)
        # The wrong lens keeps a little weight in laying the frame, the others' poses are exact.
        assert errors.rotation_error_deg == pytest.approx(0, abs=1e-3)
        assert errors.position_error_mm == pytest.approx(0, abs=0.03)
        assert errors.mask_iou is not None
        if name not in FOCAL_ERROR:
            assert errors.mask_iou > 0.9  # nearest against bilinear sampling
    assert found.sync_error_ms == pytest.approx(4.0)
    assert found.scale_error_percent == pytest.approx(2.0, abs=5e-3)


def test_the_true_particles_arrive_in_the_scenes_coordinates(small_session: Path, prepared: Path) -> None:
    digest = Scene.open(prepared).digest
    found = verify_scene(small_session, prepared)
    scene = Scene.open(prepared)
    particles = scene.truth_particles()
    assert particles is not None
    assert scene.digest == digest
    assert found.particles_attached == particles.active.any(axis=0).sum() > 50
    positions, velocities, active = Truth(small_session).particles_at(scene.times)
    assert np.array_equal(active, particles.active)
    assert np.allclose(particles.positions[active], to_scene(positions[active]), atol=1e-4)
    assert particles.velocities is not None
    assert np.allclose(particles.velocities[active], SCALE * velocities[active] @ TURN.T, atol=1e-3)


def test_a_turned_and_shifted_camera_is_measured(small_session: Path, prepared: Path) -> None:
    path = prepared / "prepare_report.json"
    report = json.loads(path.read_text())
    w2c = np.array(report["poses"]["6"]["w2c"])
    turn = np.eye(4)
    turn[:3, :3] = Rotation.from_euler("z", 0.5, degrees=True).as_matrix()
    report["poses"]["6"]["w2c"] = (turn @ w2c).tolist()
    write_json(path, report)
    found = verify_scene(small_session, prepared, attach=False)
    assert found.cameras["6"].rotation_error_deg == pytest.approx(0.5, abs=1e-3)
    assert found.cameras["6"].position_error_mm == pytest.approx(0, abs=0.03)
    assert found.cameras["5"].rotation_error_deg == pytest.approx(0, abs=2e-3)
    assert not (prepared / "truth").exists()


def test_the_clock_is_judged_relative_to_the_reference_of_the_preparation(small_session: Path, prepared: Path) -> None:
    """Another camera may be the reference: times then are that camera's local times."""
    path = prepared / "prepare_report.json"
    report = json.loads(path.read_text())
    start, rate = report["sync"]["2"]["start_s"], report["sync"]["2"]["clock_rate"]
    for fit in report["sync"].values():
        fit["start_s"] = (fit["start_s"] - start) / rate
        fit["clock_rate"] /= rate
    report["reference"] = "2"
    write_json(path, report)
    found = verify_scene(small_session, prepared, attach=False)
    assert found.cameras["2"].sync_error_ms == pytest.approx(0, abs=1e-9)
    assert found.cameras["1"].sync_error_ms == pytest.approx(0, abs=1e-6)
    assert found.cameras["3"].sync_error_ms == pytest.approx(4.0, abs=1e-3)


def test_the_command_prints_json_and_writes_a_file(
    small_session: Path, prepared: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "verify.json"
    assert main(["synth", "verify", str(small_session), str(prepared), "--out", str(out), "--json"]) == 0
    printed = json.loads(capsys.readouterr().out)
    assert printed == json.loads(out.read_text())
    assert printed["cameras"]["3"]["sync_error_ms"] == pytest.approx(4.0)
    assert main(["synth", "verify", str(small_session), str(prepared), "--out", str(out)]) == 1
    assert main(["synth", "verify", str(small_session), str(prepared), "--out", str(out), "--replace"]) == 0


def test_a_real_session_has_no_truth(small_session: Path, prepared: Path, tmp_path: Path) -> None:
    real = tmp_path / "real"
    shutil.copytree(small_session, real, ignore=shutil.ignore_patterns("truth", "cameras", "sweep"))
    with pytest.raises(SplashbenchError, match=r"truth\.json does not exist"):
        verify_scene(real, prepared)


def test_another_sessions_scene_is_refused(small_session: Path, prepared: Path) -> None:
    path = prepared / "prepare_report.json"
    report = json.loads(path.read_text())
    del report["sync"]["5"]
    write_json(path, report)
    with pytest.raises(SplashbenchError, match="sync covers the cameras"):
        verify_scene(small_session, prepared)

"""The harness: whatever a method does, there is a submission with a status, and never a half-written one."""

import os
import uuid
from pathlib import Path

import numpy as np
import pytest

from splashbench.errors import SplashbenchError
from splashbench.files import read_json
from splashbench.harness.messages import lacks_memory
from splashbench.harness.runner import parse_overrides, run_method
from splashbench.scene import Scene
from splashbench.submission import Status, Submission, check_submission
from splashbench.synth.balls import write_balls_scene

METHODS = Path(__file__).with_name("example_methods.py")


def _run(name: str, scene: Path, out: Path, **options) -> Submission:
    return run_method(f"{METHODS}:{name}", scene, out, timing_frames=options.pop("timing_frames", 0), **options)


def test_a_good_method_is_measured_and_whole(balls_directory: Path, balls: Scene, tmp_path: Path) -> None:
    submission = _run("Good", balls_directory, tmp_path / "out", preset="blue", seed=3, timing_frames=4)
    assert submission.status == Status.OK
    assert submission.identity.seed == 3
    assert submission.identity.settings == {"blue": 1.0}
    assert submission.identity.scene_digest == balls.digest
    record = submission.record
    assert record.fit_seconds is not None
    assert record.peak_memory_bytes is not None
    assert record.peak_memory_bytes > 1 << 20
    assert record.render_fps is not None
    assert record.render_fps > 0
    assert record.particles_per_frame == 2
    # 1000 bytes of static background and the three of "1.0".
    assert (record.storage_bytes, record.dynamic_bytes) == (1003, 3)
    assert check_submission(tmp_path / "out", balls) == []
    rendering = submission.rendering("6", 5)
    assert rendering.shape == (64, 96, 3)
    assert (rendering == [0, 0, 255]).all()
    np.testing.assert_allclose(submission.alpha("7", 0), 128 / 255)


def test_views_are_rendered_when_their_photographs_were_taken(tmp_path: Path) -> None:
    scene = write_balls_scene(tmp_path / "late", delays={"7": 0.5})
    submission = _run("Clock", scene.directory, tmp_path / "out")
    for t in (0, 3, scene.n_frames - 1):
        for name, delay in (("6", 0.0), ("7", 0.5)):
            np.testing.assert_allclose(submission.rendering(name, t)[..., 2] / 255, scene.times[t] + delay, atol=2e-3)


def test_a_folder_without_scene_json_may_have_any_name(balls_copy: Path, tmp_path: Path) -> None:
    (balls_copy / "scene.json").unlink()
    submission = _run("Good", balls_copy.rename(tmp_path / "my balls (2)"), tmp_path / "out")
    assert (submission.status, submission.identity.scene) == (Status.OK, "my balls (2)")


@pytest.mark.parametrize(
    ("name", "status", "reason"),
    [
        ("Unsupported", Status.UNSUPPORTED, "needs eight cameras"),
        ("Crash", Status.CRASHED, "RuntimeError: the matrix is singular"),
        ("Die", Status.CRASHED, "exit code 7"),
        ("Killed", Status.OUT_OF_MEMORY, "signal 9"),
        ("OutOfMemory", Status.OUT_OF_MEMORY, "10 TiB"),
        ("OutOfDeviceMemory", Status.OUT_OF_MEMORY, "RuntimeError: CUDA out of memory"),
        ("NotFinite", Status.NOT_FINITE, "camera 6, timestep 3: the render has NaN"),
        ("WrongSize", Status.WRONG_SIZE, r"rgb is \(32, 48, 3\)"),
        ("Integers", Status.OUT_OF_RANGE, r"rgb is float32 from 0 to 63.75, not floats in \[0, 1\]"),
        ("TooFewFrames", Status.INCOMPLETE, "not a Render"),
    ],
)
def test_a_failing_method_gets_a_status_and_a_reason(
    balls_directory: Path, tmp_path: Path, name: str, status: Status, reason: str
) -> None:
    import re

    submission = _run(name, balls_directory, tmp_path / "out")
    assert submission.status == status
    assert re.search(reason, submission.reason)
    assert not (tmp_path / "out" / "renders").exists()
    assert not (tmp_path / "out" / "model").exists()
    assert check_submission(tmp_path / "out") == []


def test_a_hanging_method_is_stopped_with_all_its_processes(
    balls_directory: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    # Every process the run starts inherits this mark, also one that its parent has left behind.
    mark = uuid.uuid4().hex
    monkeypatch.setenv("SPLASHBENCH_TEST_MARK", mark)
    submission = _run("Hang", balls_directory, tmp_path / "out", timeout_seconds=4)
    assert submission.status == Status.TIMEOUT
    assert "over 4 s" in submission.reason
    left = [
        entry.name
        for entry in Path("/proc").iterdir()
        if entry.name.isdigit() and int(entry.name) != os.getpid() and mark.encode() in _environment(entry)
    ]
    assert left == []


def _environment(process: Path) -> bytes:
    try:
        return (process / "environ").read_bytes()
    except OSError:
        return b""


def test_no_test_image_lies_where_a_method_can_look(balls_directory: Path, tmp_path: Path) -> None:
    assert _run("Peek", balls_directory, tmp_path / "out").status == Status.OK


def test_an_existing_submission_is_not_overwritten(balls_directory: Path, tmp_path: Path) -> None:
    _run("Good", balls_directory, tmp_path / "out")
    with pytest.raises(SplashbenchError, match="exists already"):
        _run("Crash", balls_directory, tmp_path / "out")
    assert Submission.open(tmp_path / "out").status == Status.OK
    assert _run("Crash", balls_directory, tmp_path / "out", replace=True).status == Status.CRASHED


def test_wrong_names_and_settings_are_told_before_anything_runs(balls_directory: Path, tmp_path: Path) -> None:
    with pytest.raises(SplashbenchError, match="did you mean 'splashsplat'"):
        run_method("splashspat", balls_directory, tmp_path / "out")
    with pytest.raises(SplashbenchError, match="has no class 'Best'"):
        _run("Best", balls_directory, tmp_path / "out")
    with pytest.raises(SplashbenchError, match="no preset 'fast'; choose one of best, blue"):
        _run("Good", balls_directory, tmp_path / "out", preset="fast")
    with pytest.raises(SplashbenchError, match="method good runs on cpu, not on 'banana'"):
        _run("Good", balls_directory, tmp_path / "out", device="banana")
    for useless in ({"preset": "quick"}, {"exr": True}, {"seed": 1}, {"device": "cuda"}, {"timeout_seconds": 9.0}):
        with pytest.raises(SplashbenchError, match="the oracle is the truth itself"):
            run_method("oracle", balls_directory, tmp_path / "out", **useless)
    with pytest.raises(SplashbenchError, match="this method's settings: blue"):
        _run("Good", balls_directory, tmp_path / "out", overrides={"green": 1})
    assert list(tmp_path.iterdir()) == []


def test_the_oracle_is_the_truth(balls_directory: Path, balls: Scene, tmp_path: Path) -> None:
    submission = run_method("oracle", balls_directory, tmp_path / "oracle", oracle_geometry=lambda scene: None)
    assert submission.identity.control
    for camera in balls.test:
        assert (submission.rendering(camera, 4) == balls.image(camera, 4)).all()
        assert (submission.alpha(camera, 4) == balls.mask(camera, 4)).all()
    assert submission.particles() is not None
    assert submission.geometry() is None
    assert check_submission(tmp_path / "oracle", balls) == []


def test_overrides_are_parsed_into_nested_settings() -> None:
    assert parse_overrides(["a=1", "b.c=0.5", "b.d=text", "e=true"]) == {
        "a": 1,
        "b": {"c": 0.5, "d": "text"},
        "e": True,
    }
    with pytest.raises(SplashbenchError, match="not KEY=VALUE"):
        parse_overrides(["novalue"])


def test_the_log_of_a_crash_is_kept(balls_directory: Path, tmp_path: Path) -> None:
    _run("Crash", balls_directory, tmp_path / "out")
    assert any("singular" in line for line in read_json(tmp_path / "out" / "record.json")["log_tail"])


def test_a_mistyped_setting_names_the_near_one(balls_directory: Path, tmp_path: Path) -> None:
    with pytest.raises(SplashbenchError, match=r"setting iteratons: .*; did you mean iterations\?"):
        run_method("splashsplat", balls_directory, tmp_path / "out", overrides={"iteratons": 3})


@pytest.mark.parametrize(
    ("said", "lacks"),
    [
        ("CUDA out of memory. Tried to allocate 2.00 GiB", True),
        ("DefaultCPUAllocator: can't allocate memory: you tried to allocate 9 bytes", True),
        ("OpenCV(4.11) error: (-4:Insufficient memory) in function 'OutOfMemoryError'", True),
        ("Unable to allocate 2.00 TiB for an array with shape (9, 9)", True),
        ("[Errno 12] Cannot allocate memory", True),
        ("index 9 is out of bounds", False),
    ],
)
def test_the_words_of_libraries_for_no_memory(said: str, lacks: bool) -> None:
    assert lacks_memory(said) is lacks

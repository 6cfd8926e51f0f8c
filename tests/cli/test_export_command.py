"""`splashbench export` as it is typed: what it writes and prints, and one line for what it cannot do."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from splashbench.cli.main import main
from splashbench.export import Manifest
from splashbench.harness.runner import run_method
from splashbench.scene import Scene

Fails = Callable[..., str]

METHOD = f"{Path(__file__).parents[1] / 'export' / 'exact_balls.py'}:Exact"


@pytest.fixture(scope="module")
def exact(balls_directory: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    directory = tmp_path_factory.mktemp("submissions") / "exact"
    run_method(METHOD, balls_directory, directory, timing_frames=0)
    return directory


def export(submission: Path, out: Path, *words: object) -> list[str]:
    return ["export", str(submission), str(out), "--method", METHOD, *map(str, words)]


@pytest.mark.parametrize(
    ("words", "files"),
    [
        (["ply", "--up", "y-down", "--degree", 2], ["frames/frame0001.ply", "frames/frame0002.ply"]),
        (["ply", "--part", "background", "--backdrop"], ["background.ply"]),
        (["mesh", "--up", "z", "--metres"], ["frames/frame0001.ply", "frames/frame0002.ply"]),
        (["mesh", "--mesh-format", "obj"], ["frames/frame0001.obj", "frames/frame0002.obj"]),
        (["particles"], ["frames/frame0001.ply", "frames/frame0002.ply", "particles.npz"]),
        (["velocity", "--up", "z", "--gravity", 0.1, -1, 0], ["velocity.npz"]),
        (["nerfstudio", "--points", 30], ["transforms.json", "transforms_test.json", "points3d.ply"]),
    ],
)
def test_each_format_writes_its_files_and_says_what_they_are(
    exact: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], words: list, files: list[str]
) -> None:
    out = tmp_path / "out"
    assert main(export(exact, out, "--every", 5, "--json", "--format", *words)) == 0
    printed = capsys.readouterr()
    told = json.loads(printed.out)
    assert told["out"] == str(out)
    assert told["bytes"] == sum(path.stat().st_size for path in out.rglob("*") if path.is_file())
    assert told["files"] == files
    assert {path.relative_to(out).as_posix() for path in out.rglob("*") if path.is_file()} == {*files, "manifest.json"}
    manifest = Manifest.model_validate_json((out / "manifest.json").read_text())
    assert {key: told[key] for key in manifest.model_dump()} == manifest.model_dump(mode="json")
    lines = printed.err.splitlines()
    assert lines[:-1] == [f"note: {note}" for note in manifest.notes]
    assert lines[-1].startswith(f"{out}: {words[0]}, ")
    assert f"; {manifest.units}, " in lines[-1]


def test_the_instants_that_are_asked_for(exact: Path, tmp_path: Path, balls: Scene) -> None:
    for words, expected in (
        (["--times", "0.1:0.25"], balls.times[(balls.times >= 0.1) & (balls.times <= 0.25)]),
        (["--times", ":0.1", "--every", "2"], balls.times[balls.times <= 0.1][::2]),
        (["--times", "0.2:0.3", "--fps", "40"], [0.2, 0.225, 0.25, 0.275, 0.3]),
    ):
        assert main(export(exact, tmp_path / "out", "--format", "mesh", "--replace", *words)) == 0
        manifest = Manifest.model_validate_json((tmp_path / "out" / "manifest.json").read_text())
        np.testing.assert_allclose(manifest.times, expected)


def test_photographs_come_from_the_scene(exact: Path, tmp_path: Path, balls: Scene) -> None:
    words = ["--format", "nerfstudio", "--scene", balls.directory, "--every", "4"]
    assert main(export(exact, tmp_path / "out", *words)) == 0
    assert len(list((tmp_path / "out" / "images").iterdir())) == 2 * len(balls.train)


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["--format", "mesh", "--part", "liquid"], "--part goes with --format ply"),
        (["--format", "ply", "--mesh-format", "obj"], "--mesh-format goes with --format mesh"),
        (["--format", "mesh", "--backdrop"], "--backdrop goes with --format ply"),
        (["--format", "ply", "--points", "3"], "--points goes with --format nerfstudio"),
        (["--format", "mesh", "--gravity", "0", "-1", "0"], "--gravity goes with --up"),
        (["--format", "mesh", "--every", "2", "--fps", "3"], "not allowed with argument"),
        (["--format", "mesh", "--every", "0"], "is not a whole number"),
        (["--format", "mesh", "--fps", "nan"], "is not a number of frames"),
        (["--format", "mesh", "--fps", "1e7"], "is not a number of frames"),
        (["--format", "mesh", "--times", "now"], "is no interval of seconds"),
        (["--format", "mesh", "--times", "0:1:2"], "is no interval of seconds"),
        (["--format", "mesh", "--times", "nan:1"], "finite seconds"),
        (["--format", "ply", "--degree", "4"], "is not a whole number from 0 to 3"),
        (["--format", "usd"], "invalid choice"),
        ([], "required: --format"),
    ],
)
def test_wrong_usage_is_exit_2(
    exact: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], words: list[str], message: str
) -> None:
    with pytest.raises(SystemExit) as stop:
        main(export(exact, tmp_path / "out", *words))
    assert stop.value.code == 2
    assert message in capsys.readouterr().err
    assert not (tmp_path / "out").exists()


def test_what_cannot_be_is_one_line(exact: Path, tmp_path: Path, fails: Fails) -> None:
    out = tmp_path / "out"

    def refused(*words: object, submission: Path = exact, place: Path = out) -> str:
        return fails(*export(submission, place, "--format", *words))

    assert "is no submission" in refused("mesh", submission=tmp_path)
    assert "does not exist" in fails("export", exact, out, "--format", "mesh", "--method", "none.py:Exact")
    assert "the recording has no instant from 5 to 6 s" in refused("mesh", "--times", "5:6")
    assert "are more than 100000" in refused("mesh", "--fps", "999999")
    assert "known at the timesteps alone" in refused("particles", "--fps", "100")
    assert "three numbers that give a direction" in refused("mesh", "--up", "z", "--gravity", "0", "0", "0")
    assert "three numbers that give a direction" in refused("mesh", "--up", "z", "--gravity", "nan", "0", "0")
    assert "sealed" in refused("mesh", place=exact / "mesh")
    (tmp_path / "file").write_text("mine")
    assert "file" in refused("mesh", place=tmp_path / "file")
    assert "is a file" in refused("mesh", place=tmp_path / "file" / "below")
    (tmp_path / "photos").mkdir()
    (tmp_path / "photos" / "holiday.jpg").write_bytes(b"dear")
    assert "exists already" in refused("mesh", place=tmp_path / "photos")
    assert "it has no manifest.json" in refused("mesh", "--replace", place=tmp_path / "photos")
    assert sorted(path.name for path in tmp_path.iterdir()) == ["file", "photos"]


def test_a_method_that_is_not_installed_has_what_its_submission_holds(
    exact: Path, tmp_path: Path, fails: Fails
) -> None:
    for name in ("mesh", "particles"):  # of geometry.npz and particles.npz
        assert main(["export", str(exact), str(tmp_path / name), "--format", name]) == 0
    for name in ("ply", "velocity"):
        line = fails("export", exact, tmp_path / name, "--format", name)
        assert "method exact is not installed here; install it, or name it by --method" in line


def test_a_submission_without_a_model_says_what_it_has(truth: Path, tmp_path: Path, fails: Fails) -> None:
    assert main(["export", str(truth), str(tmp_path / "out"), "--format", "particles"]) == 0
    for name in ("ply", "mesh", "velocity"):
        assert "it keeps no model of oracle" in fails("export", truth, tmp_path / name, "--format", name)


def test_an_interrupted_export_leaves_nothing(exact: Path, tmp_path: Path) -> None:
    words = export(exact, tmp_path / "out", "--format", "mesh", "--fps", "100000")
    process = subprocess.Popen([sys.executable, "-m", "splashbench", *words], stderr=subprocess.PIPE, text=True)
    deadline = time.monotonic() + 60
    while not any(tmp_path.glob(".tmp-*-out/frames/*.ply")) and time.monotonic() < deadline:
        assert process.poll() is None
        time.sleep(0.05)
    os.kill(process.pid, signal.SIGINT)
    _, printed = process.communicate(timeout=30)
    assert process.returncode == 130
    assert "Traceback" not in printed
    assert list(tmp_path.iterdir()) == []


def test_a_full_disk_leaves_no_usd_file(exact: Path, tmp_path: Path) -> None:
    pytest.importorskip("pxr", reason="needs usd-core, which the extra [usd] installs")
    (place := tmp_path / "place").mkdir()
    # As large as a disk that is nearly full. Python would cache half a module, and load it from then on.
    code = (
        "import resource, sys; sys.dont_write_bytecode = True; "
        "resource.setrlimit(resource.RLIMIT_FSIZE, (20000, 20000)); "
        "from splashbench.cli.main import main; sys.exit(main(sys.argv[1:]))"
    )
    words = export(exact, place / "out", "--format", "mesh", "--mesh-format", "usd")
    done = subprocess.run([sys.executable, "-c", code, *words], capture_output=True, text=True, timeout=120)
    assert done.returncode == 1, done.stderr
    assert "could not be written: the disk is full; free some space" in done.stderr.splitlines()[-1]
    assert "Traceback" not in done.stderr
    assert list(place.iterdir()) == []

"""An external code, run by commands: whatever it does there is a complete submission with a status, or none."""

import functools
import json
import os
import runpy
import shlex
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import psutil
import pytest

from splashbench.cli.main import main
from splashbench.errors import SplashbenchError
from splashbench.files import read_json
from splashbench.harness.external import runner
from splashbench.harness.external.collection import collect
from splashbench.harness.external.runner import ExternalCode
from splashbench.harness.messages import Failure
from splashbench.observe import initial_points
from splashbench.scene import Scene
from splashbench.scene.export import export_scene
from splashbench.submission import Status, Submission, check_submission

CODE = Path(__file__).with_name("external_code.py")
IMPORTERS = Path(__file__).with_name("example_importers.py")
PYTHON = shlex.quote(sys.executable)
POINTS = 20
#: Seconds that a code hangs for; time enough to have begun, on a machine with much else to do.
LIMIT = 6.0
run_external = functools.partial(runner.run_external, initial_points=initial_points)


def _fit(behaviour: str, *rest: object) -> str:
    return shlex.join([sys.executable, str(CODE), "fit", behaviour, "{scene}", "{out}", *map(str, rest)])


def _render(behaviour: str) -> str:
    return shlex.join([sys.executable, str(CODE), "render", behaviour, "{out}", "{views}", "{into}"])


def _run(scene: Path, out: Path, fit: str = "good", render: str = "good", **options) -> Submission:
    code = ExternalCode("theirs", _fit(fit), "blender", render_command=_render(render), points=POINTS)
    return run_external(code, scene, out, **options)


@pytest.fixture(scope="module")
def exported(balls: Scene, tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("exported") / "out"
    export_scene(balls, out, "blender", initial_points(balls, 0))
    return out


def test_a_good_code_is_measured_checked_and_scored(
    balls_directory: Path, balls: Scene, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "out"
    arguments = ["run-external", str(balls_directory), str(out), "--name", "theirs", "--format", "blender"]
    arguments += ["--command", _fit("good", "{seed}", "{device}", "{frames}", "{seconds}", "a b"), "--mixed", "--json"]
    arguments += ["--render-command", _render("good"), "--seed", "4", "--device", "cuda:1", "--points", str(POINTS)]
    assert main(arguments) == 0
    summary = json.loads(capsys.readouterr().out)
    assert (summary["method"], summary["status"], summary["seed"], summary["device"]) == ("theirs", "ok", 4, "cuda:1")
    assert summary["settings"]["format"] == "blender"
    assert check_submission(out, balls) == []
    submission = Submission.open(out)
    assert submission.identity.mixed
    record = submission.record
    assert record.fit_seconds is not None
    assert record.fit_seconds > 0
    assert record.peak_memory_bytes is not None
    assert record.peak_memory_bytes > 1 << 20
    assert record.particles_per_frame == 2
    assert record.render_fps is None
    model = read_json(out / "model" / "model.json")
    assert model["arguments"] == ["4", "cuda:1", "8", str(float(balls.times[-1] - balls.times[0])), "a b"]
    # The link in the model stays behind, and is no byte of it.
    assert sorted(path.name for path in (out / "model").iterdir()) == ["model.json", "static"]
    size = (out / "model" / "model.json").stat().st_size
    assert (record.storage_bytes, record.dynamic_bytes) == (1000 + size, size)
    colour = np.mean([balls.image(name, t) for name in balls.train for t in range(8)], axis=(0, 1, 2))
    np.testing.assert_allclose(submission.rendering("7", 3)[10, 20], colour, atol=0.6)
    np.testing.assert_allclose(submission.alpha("6", 0), 0.2)
    assert main(["score", str(out), "--scene", str(balls_directory), "--out", str(tmp_path / "results")]) == 0
    result = read_json(next((tmp_path / "results").glob("*.json")))
    assert (result["method"], result["status"], result["mixed"]) == ("theirs", "ok", True)
    assert result["metrics"]["psnr"]["value"] > 5


def test_what_was_trained_before_is_rendered_by_a_command_that_gets_a_copy(
    balls_directory: Path, balls: Scene, tmp_path: Path
) -> None:
    first = _run(balls_directory, tmp_path / "first")
    trained = Path(shutil.copytree(tmp_path / "first" / "model", tmp_path / "trained"))
    before = sorted((path, path.stat().st_mtime_ns) for path in trained.rglob("*"))
    code = ExternalCode("theirs", "", "blender", trained=trained, render_command=_render("good"), points=POINTS)
    again = run_external(code, balls_directory, tmp_path / "again")
    assert check_submission(tmp_path / "again", balls) == []
    np.testing.assert_array_equal(again.rendering("7", 3), first.rendering("7", 3))
    assert (again.record.fit_seconds, again.record.peak_memory_bytes) == (None, None)
    assert again.record.storage_bytes == first.record.storage_bytes
    assert sorted((path, path.stat().st_mtime_ns) for path in trained.rglob("*")) == before
    for work in (trained / "work", tmp_path):
        with pytest.raises(SplashbenchError, match="lie within one another; give --work a place of its own"):
            run_external(code, balls_directory, tmp_path / "other" / "out", work=work)


@pytest.mark.parametrize(
    ("fit", "render", "status", "reason"),
    [
        ("crash", "good", Status.CRASHED, "the fit ended with exit code 1: the matrix is singular"),
        ("out_of_memory", "good", Status.OUT_OF_MEMORY, "CUDA out of memory"),
        ("killed", "good", Status.OUT_OF_MEMORY, "the fit was killed (signal 9)"),
        ("good", "crash", Status.CRASHED, "the render ended with exit code 1: no such layer"),
        ("good", "wrong_size", Status.WRONG_SIZE, "renders/6/000005.png is 48x32; the view is 96x64 pixels"),
        ("good", "missing", Status.INCOMPLETE, "renders/6/000003.png is missing (and 3 more)"),
        ("good", "not_finite", Status.NOT_FINITE, "particles.npz: positions has NaN"),
    ],
)
def test_a_failing_code_gets_a_status_and_a_reason(
    balls_directory: Path, balls: Scene, tmp_path: Path, fit: str, render: str, status: Status, reason: str
) -> None:
    submission = _run(balls_directory, tmp_path / "out", fit, render)
    assert submission.status == status
    assert submission.reason.startswith(reason) or reason in submission.reason
    assert str(tmp_path) not in submission.reason
    assert sorted(path.name for path in (tmp_path / "out").iterdir()) == [
        "SHA256SUMS",
        "cameras.json",
        "record.json",
        "submission.toml",
    ]
    assert check_submission(tmp_path / "out", balls) == []
    assert (submission.record.fit_seconds is None) == (fit != "good")


@pytest.mark.parametrize(
    ("behaviour", "reason"),
    [
        ("link", "renders/6/000000.png is a link, not a file"),
        ("folder_link", "renders/6 is a link, not a file"),
        ("damaged", "renders/6/000000.png is cut short or damaged"),
        ("deep", "renders/6/000000.png has more than 8 bits per channel"),
        ("short", "particles.npz has 7 instants, the scene 8"),
    ],
)
def test_what_is_handed_in_is_not_trusted(
    balls: Scene, tmp_path: Path, exported: Path, behaviour: str, reason: str
) -> None:
    into = tmp_path / "into"
    (tmp_path / "model.json").write_text('{"colour": [9, 8, 7]}')
    runpy.run_path(str(CODE))["render"](behaviour, str(tmp_path), str(exported / "test_views.json"), str(into))
    with pytest.raises(Failure) as stop:
        collect(into, tmp_path / "staging", balls)
    assert stop.value.status == Status.INCOMPLETE
    assert stop.value.reason.startswith(reason)


def test_a_code_that_changes_the_scene_is_refused(balls_copy: Path, tmp_path: Path) -> None:
    image = balls_copy / "ims" / "1" / "000000.png"
    spoil = shlex.join([sys.executable, "-c", f"open({str(image)!r}, 'ab').write(b' ')"])
    with pytest.raises(SplashbenchError, match="was changed while theirs ran"):
        run_external(ExternalCode("theirs", spoil, "blender", points=0), balls_copy, tmp_path / "out")
    assert not (tmp_path / "out").exists()


def test_a_failure_is_exit_1_and_keeps_the_last_lines(
    balls_directory: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    arguments = ["run-external", str(balls_directory), str(tmp_path / "out"), "--name", "theirs"]
    assert main([*arguments, "--format", "blender", "--command", _fit("crash"), "--points", "0"]) == 1
    note, error = capsys.readouterr().err.splitlines()
    assert note.startswith("note: principal points lie up to 2.7 pixels off the middle")
    assert error.startswith("error: theirs: crashed: the fit ended with exit code 1")
    assert read_json(tmp_path / "out" / "record.json")["log_tail"] == ["fitting crash", "the matrix is singular"]


def _wait_for(note: Path) -> list[int]:
    """Process ids in `note`, once it is there."""
    for _ in range(1200):
        if note.exists():
            return [int(word) for word in note.read_text().split()]
        time.sleep(0.05)
    raise AssertionError("the code never started")


def _alive(ids: list[int]) -> list[int]:
    """Which of `ids` are still running; a process that was just killed is given a moment to be gone."""
    gone_by = time.monotonic() + 10
    while True:
        left = [number for number in ids if psutil.pid_exists(number)]
        left = [number for number in left if psutil.Process(number).status() != psutil.STATUS_ZOMBIE]
        if not left or time.monotonic() > gone_by:
            return left
        time.sleep(0.05)


def test_a_hanging_code_is_stopped_with_all_it_started(balls_directory: Path, tmp_path: Path) -> None:
    code = ExternalCode("theirs", _fit("hang", tmp_path / "ids"), "blender", points=0)
    submission = run_external(code, balls_directory, tmp_path / "out", timeout_seconds=LIMIT)
    assert (submission.status, submission.reason) == (Status.TIMEOUT, "the fit took over 6 s")
    ids = _wait_for(tmp_path / "ids")
    assert len(ids) == 3
    assert _alive(ids) == []


def test_a_hanging_render_is_a_timeout_that_keeps_the_cost_of_the_fit(balls_directory: Path, tmp_path: Path) -> None:
    code = ExternalCode("theirs", "true", "blender", render_command="sleep 300", points=0)
    submission = run_external(code, balls_directory, tmp_path / "out", timeout_seconds=LIMIT)
    assert (submission.status, submission.reason) == (Status.TIMEOUT, "the render took over 6 s")
    assert submission.record.fit_seconds is not None


def test_what_a_good_code_leaves_running_ends_with_it(balls_directory: Path, tmp_path: Path) -> None:
    code = ExternalCode(
        "theirs", _fit("left_behind", tmp_path / "ids"), "blender", render_command=_render("good"), points=0
    )
    assert run_external(code, balls_directory, tmp_path / "out").status == Status.OK
    assert _alive(_wait_for(tmp_path / "ids")) == []


@pytest.mark.parametrize(("number", "status"), [(signal.SIGINT, 130), (signal.SIGTERM, 143)])
def test_a_run_that_is_stopped_ends_everything_and_leaves_nothing(
    balls_directory: Path, tmp_path: Path, number: int, status: int
) -> None:
    place = tmp_path / "place"
    place.mkdir()
    arguments = [sys.executable, "-m", "splashbench", "run-external", str(balls_directory), str(place / "out")]
    arguments += ["--name", "theirs", "--format", "blender", "--points", "0"]
    arguments += ["--command", _fit("hang", tmp_path / "ids")]
    scratch = tmp_path / "scratch"
    scratch.mkdir()
    process = subprocess.Popen(
        arguments,
        stderr=subprocess.PIPE,
        env={**os.environ, "TMPDIR": str(scratch)},
        preexec_fn=lambda: signal.signal(signal.SIGINT, signal.SIG_DFL),  # tests in the background ignore it
    )
    ids = _wait_for(tmp_path / "ids")
    process.send_signal(number)
    assert process.wait(60) == status
    assert process.stderr is not None
    assert b"nothing half-written was left" in process.stderr.read()
    process.stderr.close()
    assert _alive(ids) == []
    assert list(place.iterdir()) == []
    assert list(scratch.iterdir()) == []


def test_a_code_does_not_outlive_a_harness_that_is_killed(balls_directory: Path, tmp_path: Path) -> None:
    arguments = [sys.executable, "-m", "splashbench", "run-external", str(balls_directory), str(tmp_path / "out")]
    arguments += ["--name", "theirs", "--format", "blender", "--points", "0"]
    arguments += ["--command", _fit("hang", tmp_path / "ids")]
    process = subprocess.Popen(arguments, env={**os.environ, "TMPDIR": str(tmp_path)})
    ids = _wait_for(tmp_path / "ids")
    process.kill()
    process.wait()
    assert _alive(ids[:1]) == []
    for orphan in ids[1:]:  # of which no kernel tells the code's own parent
        os.kill(orphan, signal.SIGKILL)


def test_the_memory_of_what_a_code_starts_counts(balls_directory: Path, tmp_path: Path) -> None:
    record = _run(balls_directory, tmp_path / "out", "large").record
    assert record.peak_memory_bytes is not None
    assert record.peak_memory_bytes > 300_000_000
    assert record.fit_seconds is not None
    assert record.fit_seconds > 0.6


def test_one_command_may_fit_and_render(balls_directory: Path, balls: Scene, tmp_path: Path) -> None:
    both = f"{_fit('good')} && {_render('good')}"
    code = ExternalCode("theirs", both, "blender", shell=True, points=0)
    assert run_external(code, balls_directory, tmp_path / "out").status == Status.OK
    assert check_submission(tmp_path / "out", balls) == []


def test_a_shell_gets_its_values_quoted_and_only_when_asked(balls_directory: Path, tmp_path: Path) -> None:
    hostile = "cpu; touch /nonexistent/oops $HOME"
    text = "printf %s {device} > {out}/told; echo '${{x}}' ${HOME:+home} >> {out}/told; exit 3"
    code = ExternalCode("theirs", text, "blender", shell=True, points=0)
    run_external(code, balls_directory, tmp_path / "shell", device=hostile, work=tmp_path / "work")
    assert (tmp_path / "work" / "out" / "told").read_text() == f"{hostile}${{x}} home\n"
    echo = f'{PYTHON} -c "import sys; print(sys.argv[1:]); sys.exit(1)" {{device}} $HOME {{{{brace}}}} ; x'
    submission = run_external(
        ExternalCode("theirs", echo, "blender", points=0), balls_directory, tmp_path / "plain", device=hostile
    )
    assert submission.record.log_tail == [str([hostile, "$HOME", "{brace}", ";", "x"])]


def test_commands_run_where_they_are_told_and_the_work_is_kept(balls_directory: Path, tmp_path: Path) -> None:
    place = tmp_path / "repository"
    place.mkdir()
    script = place / "train.sh"
    script.write_text('#!/bin/sh\npwd > "$1/told"\ncat "$2/splashbench.json" >> /dev/null\n')
    script.chmod(0o755)
    code = ExternalCode("theirs", "./train.sh {out} {scene}", "nerfies", directory=place, points=0)
    submission = run_external(code, balls_directory, tmp_path / "out", work=tmp_path / "work")
    assert submission.status == Status.INCOMPLETE  # it rendered nothing
    assert Path((tmp_path / "work" / "out" / "told").read_text().strip()) == place.resolve()
    # The name of the parent is how Deformable-3DGS tells the kind of dataset.
    assert (tmp_path / "work" / "NeRF" / "balls" / "rgb" / "1x" / "1_000000.png").is_file()
    assert (tmp_path / "work" / "fit.log").is_file()
    with pytest.raises(SplashbenchError, match="is not empty"):
        run_external(code, balls_directory, tmp_path / "again", work=tmp_path / "work")
    with pytest.raises(SplashbenchError, match="lie within one another"):
        run_external(code, balls_directory, tmp_path / "again", work=tmp_path / "again" / "work")


def test_an_importer_reads_the_output_and_the_harness_renders_it(
    balls_directory: Path, balls: Scene, tmp_path: Path
) -> None:
    code = ExternalCode("theirs", _fit("good"), "blender", importer=f"{IMPORTERS}:Colours", points=0)
    submission = run_external(code, balls_directory, tmp_path / "out", timing_frames=3)
    assert submission.status == Status.OK
    assert check_submission(tmp_path / "out", balls) == []
    record = submission.record
    assert record.render_fps is not None
    assert record.timed_frames == 3
    assert record.fit_seconds is not None
    assert [path.name for path in (tmp_path / "out" / "model").iterdir()] == ["imported.json"]
    assert record.storage_bytes == (tmp_path / "out" / "model" / "imported.json").stat().st_size
    share = (balls.times[3] - balls.times[0]) / (balls.times[-1] - balls.times[0])
    np.testing.assert_allclose(submission.alpha("6", 3), share, atol=0.5 / 255 + 1e-6)


@pytest.mark.parametrize(
    ("importer", "status", "reason"),
    [
        ("Refuses", Status.CRASHED, "point_cloud.ply is missing; let the code save its last iteration"),
        ("NotFinite", Status.NOT_FINITE, "camera 6, timestep 0: the render has NaN or infinite pixels"),
    ],
)
def test_an_import_that_fails_is_a_status(
    balls_directory: Path, tmp_path: Path, importer: str, status: Status, reason: str
) -> None:
    code = ExternalCode("theirs", _fit("good"), "blender", importer=f"{IMPORTERS}:{importer}", points=0)
    submission = run_external(code, balls_directory, tmp_path / "out", timing_frames=0)
    assert (submission.status, submission.reason) == (status, reason)
    assert not (tmp_path / "out" / "model").exists()


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"command": "no_such_program {scene}"}, "--command: no_such_program is no program"),
        ({"command": "./train.sh {scene}"}, r"--command: ./train.sh is no program that can be run"),
        ({"command": "python {scen}"}, r"there is no placeholder \{scen\}; there are \{scene\}, \{out\}"),
        ({"command": "python 'train.py"}, "cannot be split into words"),
        ({"command": " "}, "--command is empty"),
        ({"render_command": "no_such_program"}, "--render-command: no_such_program is no program"),
        ({"importer": "no_such_code"}, r"there is no importer 'no_such_code' \(installed: "),
        ({"importer": f"{CODE}:fit"}, "is not a splashbench.harness.external.importers.Importer"),
        ({"importer": f"{IMPORTERS}:Colours", "format": "colmap"}, "reads what was trained on blender, not on colmap"),
        ({"name": "no name"}, "method 'no name': String should match"),
        ({"directory": Path("nowhere")}, "nowhere is not a folder"),
    ],
)
def test_what_cannot_run_is_told_before_anything_does(
    balls_directory: Path, tmp_path: Path, change: dict, message: str
) -> None:
    usual = {"name": "theirs", "command": f"{PYTHON} train.py {{scene}}", "format": "blender"}
    with pytest.raises(SplashbenchError, match=message):
        run_external(ExternalCode(**(usual | change)), balls_directory, tmp_path / "out")
    assert list(tmp_path.iterdir()) == []


NAMED = ["--name", "theirs", "--format", "colmap"]


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (["--command", "true", "--format", "colmap"], "the following arguments are required: --name"),
        (["--name", "theirs", "--format", "colmap"], "one of the arguments --command --trained is required"),
        (["--name", "theirs", "--command", "true"], "the following arguments are required: --format"),
        ([*NAMED, "--trained", "b", "--command", "c"], "--command: not allowed with argument --trained"),
        ([*NAMED, "--trained", "b"], "--trained needs --import or --render-command"),
        ([*NAMED, "--command", "b", "--render-command", "c", "--import", "d"], "--import: not allowed with argument"),
        ([*NAMED, "--command", "b", "--exr"], "--exr and --timing-frames need --import"),
        ([*NAMED, "--command", "b", "--timing-frames", "9"], "--exr and --timing-frames need --import"),
        ([*NAMED, "--command", "b", "--set", "a=1"], "unrecognized arguments: --set"),
        ([*NAMED, "--command", "b", "--with-test-images"], "unrecognized arguments: --with-test-images"),
    ],
)
def test_options_that_do_not_go_together_are_wrong_usage(
    options: list[str], message: str, capsys: pytest.CaptureFixture[str]
) -> None:
    with pytest.raises(SystemExit) as stop:
        main(["run-external", "scene", "out", *options])
    assert stop.value.code == 2
    assert message in capsys.readouterr().err


def test_a_command_that_is_no_text_is_told_before_it_runs(balls_directory: Path, tmp_path: Path) -> None:
    code = ExternalCode("theirs", "true \udcff", "blender", render_command=_render("good"), points=POINTS)
    with pytest.raises(SplashbenchError, match="is no UTF-8"):
        run_external(code, balls_directory, tmp_path / "out")
    assert list(tmp_path.iterdir()) == []

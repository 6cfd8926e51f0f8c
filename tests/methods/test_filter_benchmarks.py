"""benchmarks/filtered.py and silhouettes.py: what of a lead over mixed methods is the protocol's filter."""

from __future__ import annotations

import importlib.util
import json
import shutil
import sys
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest

from splashbench import toml
from splashbench.cli.main import main
from splashbench.scene import Scene
from splashbench.submission import Submission, seal
from splashbench_methods.splashsplat.method import SplashSplat

pytestmark = pytest.mark.slow

FOLDER = Path(__file__).resolve().parents[2] / "benchmarks"
SMALL = toml.load(Path(__file__).parent / "small_fits.toml")["splashsplat"]


def module_of(name: str) -> ModuleType:
    spec = importlib.util.spec_from_file_location(f"benchmark_{name}", FOLDER / f"{name}.py")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def run(name: str, monkeypatch: pytest.MonkeyPatch, *arguments: object) -> int:
    monkeypatch.setattr(sys, "argv", [f"{name}.py", *map(str, arguments)])
    return module_of(name).main()


@pytest.fixture(scope="module")
def runs(balls_directory: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder of submissions: splashsplat and the controls nothing and oracle."""
    folder = tmp_path_factory.mktemp("runs")
    words = [word for key, value in SMALL.items() for word in ("--set", f"{key}={value}")]
    for method, options in {"splashsplat": words, "nothing": [], "oracle": None}.items():
        more = [] if options is None else ["--preset", "quick", *options, "--timing-frames", "0"]
        assert main(["run", method, str(balls_directory), str(folder / method), *more]) == 0
    return folder


def test_the_filter_leaves_what_all_silhouettes_allow(runs: Path, balls: Scene) -> None:
    opacity_of = module_of("filtered").filtered_opacity
    training = balls.training()
    fitted = SplashSplat().load(runs / "splashsplat" / "model", training)
    (name, t), camera = (balls.test[0], 1), balls.cameras[balls.test[0]]
    seconds = float(balls.camera_times[name][t])
    whole = fitted.render(camera, seconds).alpha
    filtered = opacity_of(fitted, training, camera, t, seconds)
    assert 0.2 * whole.sum() < filtered.sum() < whole.sum()
    masks = training.mask
    training.mask = lambda view, frame: np.ones_like(masks(view, frame))  # type: ignore[method-assign]
    np.testing.assert_allclose(opacity_of(fitted, training, camera, t, seconds), whole, atol=1e-6)
    blind = training.train[-1]
    training.mask = lambda view, frame: masks(view, frame) & (view != blind)  # type: ignore[method-assign]
    assert opacity_of(fitted, training, camera, t, seconds).max() == 0


def test_copies_are_sound_mixed_and_scored(
    runs: Path,
    balls_directory: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    source = runs / "splashsplat"
    assert run("filtered", monkeypatch, source, "--scene", balls_directory, "--out", tmp_path) == 0
    copy = tmp_path / "splashsplat"
    assert main(["check", str(copy), "--scene", str(balls_directory)]) == 0
    submission, original = Submission.open(copy), Submission.open(source)
    assert submission.identity.mixed
    assert submission.identity.method == "splashsplat_filtered"
    assert submission.geometry() is None
    name = Scene.open(balls_directory).test[0]
    np.testing.assert_array_equal(submission.rendering(name, 2), original.rendering(name, 2))
    assert submission.alpha(name, 2).sum() < original.alpha(name, 2).sum()
    scored = {}
    for path in (copy, source):
        capsys.readouterr()
        words = ["score", str(path), "--scene", str(balls_directory), "--out", str(tmp_path / "results"), "--json"]
        assert main(words) == 0
        (result,) = json.loads(capsys.readouterr().out)["results"]
        scored[path] = result["metrics"]
    assert scored[copy]["psnr"] == scored[source]["psnr"]
    assert scored[copy]["spill"] < scored[source]["spill"]
    # The scorer filters the particles of what is mixed.
    assert scored[copy]["sigma_d"] != scored[source]["sigma_d"]
    assert scored[copy]["mu_d"] != scored[source]["mu_d"]


def test_what_cannot_be_filtered_is_refused_before_anything_is_written(
    runs: Path,
    balls_directory: Path,
    balls_copy: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    good, out = runs / "splashsplat", tmp_path / "out"
    bare = Path(shutil.copytree(good, tmp_path / "bare", ignore=shutil.ignore_patterns("model")))
    seal(bare, Submission.open(good).identity, Submission.open(good).record)
    mask = next((balls_copy / "seg").rglob("*.png"))
    mask.write_bytes(next(path for path in sorted(mask.parent.glob("*.png")) if path != mask).read_bytes())
    for scene, other, said in (
        (balls_directory, runs / "nothing", "give submissions of splashsplat"),
        (balls_directory, bare, "without --no-model"),
        (balls_directory, good, "the same name"),
        (balls_copy, bare, "another version of scene"),
    ):
        assert run("filtered", monkeypatch, good, other, "--scene", scene, "--out", out) == 1
        (line,) = capsys.readouterr().err.splitlines()
        assert said in line
    assert not out.exists()


def test_silhouettes_are_compared_with_the_control(
    runs: Path, balls_directory: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    words = [runs / "oracle", "--scene", balls_directory, "--reference", runs / "oracle"]
    assert run("silhouettes", monkeypatch, *words) == 1
    assert "give one of the control nothing" in capsys.readouterr().err
    with pytest.raises(SystemExit):
        run("silhouettes", monkeypatch, *words, "--every", "0")
    assert "0 is less than 1" in capsys.readouterr().err


def test_overlap_of_a_square_that_has_moved() -> None:
    overlap = module_of("silhouettes").overlap
    empty, moved = np.full((40, 40, 3), 100, np.uint8), np.full((40, 40, 3), 100, np.uint8)
    mask = np.zeros((40, 40), bool)
    mask[10:20, 10:20] = True
    moved[10:20, 15:25] = 130
    assert overlap(moved, empty, mask, 25, 8) == pytest.approx(50 / 150)
    assert overlap(moved, empty, mask, 35, 8) == 0
    moved[35:, 35:] = 255  # far off
    assert overlap(moved, empty, mask, 25, 8) == pytest.approx(50 / 150)
    moved[35:, 35:] = 100
    moved[10:20, 15:25] = 70
    assert overlap(moved, empty, mask, 25, 8) == pytest.approx(50 / 150)


def test_the_truth_overlaps_like_the_photographs(
    runs: Path, balls_directory: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    table = tmp_path / "table.md"
    words = [runs / "oracle", runs / "nothing", "--scene", balls_directory, "--reference", runs / "nothing"]
    assert run("silhouettes", monkeypatch, *words, "--every", 3, "--thresholds", 25, "--out", table) == 0
    rows = {line.split("|")[1].strip(): line.split("|")[5:7] for line in table.read_text().splitlines()}
    photographs, oracle, nothing = (rows[name] for name in ("photographs", "oracle", "nothing"))
    assert float(oracle[0]) == 1
    assert oracle[1] == photographs[1]
    assert float(oracle[1]) > 0.5
    assert [float(cell) for cell in nothing] == [0, 0]

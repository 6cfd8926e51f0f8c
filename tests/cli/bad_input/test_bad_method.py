"""Methods that cannot be used, settings that cannot be meant: one line before anything runs."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import pytest

from splashbench.cli.main import main
from splashbench.submission import Submission

METHODS = Path(__file__).parents[2] / "harness" / "example_methods.py"
GOOD = f"import sys\nsys.path.insert(0, {str(METHODS.parent)!r})\nfrom example_methods import Good\n"

Fails = Callable[..., str]


@pytest.mark.parametrize(
    ("source", "message"),
    [
        ("def broken(:\n", "SyntaxError"),
        ("\0\0", "cannot be imported"),
        ("import sys\nsys.exit(0)\n", "SystemExit"),
        ("M = 3\n", "subclass it"),
        ("", "has no class 'M'"),
        (GOOD + "class M(Good):\n    def __init__(self): raise ValueError('no licence')\n", "ValueError: no licence"),
        (GOOD + "class M(Good):\n    id = '../../x'\n", "method: String should match"),
        (GOOD + "class M(Good):\n    version = 2\n", "method_version: Input should be a valid string"),
        (GOOD + "class M(Good):\n    Config = 5\n", "no MethodConfig"),
    ],
)
def test_an_unusable_method_is_told_before_anything_runs(
    balls_directory: Path, tmp_path: Path, fails: Fails, source: str, message: str
) -> None:
    (tmp_path / "m.py").write_text(source)
    line = fails("run", f"{tmp_path / 'm.py'}:M", balls_directory, tmp_path / "out")
    assert message in line
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize(
    "options",
    [
        ["--preset", "fastest"],
        ["--set", "blue"],
        ["--set", "blue=NaN"],
        ["--set", "blue=1e999"],
        ["--set", "blue=[1]"],
        ["--set", "blue=" + "[" * 100_000],
        ["--set", "blue=1", "--set", "blue.dark=2"],
    ],
    ids=lambda options: " ".join(options)[:30],
)
def test_a_bad_setting_is_told_before_anything_runs(
    balls_directory: Path, tmp_path: Path, fails: Fails, options: list[str]
) -> None:
    fails("run", f"{METHODS}:Good", balls_directory, tmp_path / "out", *options)
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    "words",
    [
        ["run", "nothing", "SCENE", "OUT", "--timeout", "nan"],
        ["run", "nothing", "SCENE", "OUT", "--seed", "-1"],
        ["prepare", "SESSION", "OUT", "--timesteps", "1000000000"],
        ["synth", "scene", "balls", "OUT", "--size", "0x0"],
        ["synth", "scene", "balls", "OUT", "--size", "99999x99999"],
        ["synth", "scene", "balls", "OUT", "--seed", "-1"],
        ["synth", "session", "OUT", "--workers", "0"],
        ["demo", "OUT", "--seed", "-1"],
    ],
    ids=" ".join,
)
def test_impossible_numbers_are_wrong_usage(words: list[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    with pytest.raises(SystemExit) as stop:
        main(words)
    assert stop.value.code == 2
    assert list(tmp_path.iterdir()) == []


def test_binary_garbage_in_the_log_is_one_printable_line(balls_directory: Path, tmp_path: Path, fails: Fails) -> None:
    body = "import os\nclass M(Good):\n    def fit(self, scene, config, run):\n"
    body += "        os.write(1, bytes(range(256)) * 99)\n        os._exit(3)\n"
    (tmp_path / "m.py").write_text(GOOD + body)
    line = fails("run", f"{tmp_path / 'm.py'}:M", balls_directory, tmp_path / "out")
    assert "exit code 3" in line
    assert Submission.open(tmp_path / "out").status == "crashed"


@pytest.mark.parametrize("damage", ["path.write_bytes(b'x')", "__import__('shutil').rmtree(path.resolve().parents[2])"])
def test_a_method_that_changes_the_scene_is_found_out(
    balls_copy: Path, tmp_path: Path, fails: Fails, damage: str
) -> None:
    body = "class M(Good):\n    def fit(self, scene, config, run):\n"
    body += f"        path = scene.directory / 'ims' / '1' / '000000.png'\n        {damage}\n"
    body += "        return super().fit(scene, config, run)\n"
    (tmp_path / "m.py").write_text(GOOD + body)
    line = fails("run", f"{tmp_path / 'm.py'}:M", balls_copy, tmp_path / "out", "--timing-frames", "0")
    assert f"{balls_copy} was changed while good ran" in line
    assert not (tmp_path / "out").exists()

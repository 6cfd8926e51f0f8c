"""`splashbench run` and `run-external` hand every option on to the harness."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

from splashbench.cli.main import main
from splashbench.errors import SplashbenchError
from splashbench.harness.checkpoints import MARKS
from splashbench.harness.runner import TIMING_FRAMES
from splashbench.submission import Budget

COMMON: list[Any] = ["--seed", 3, "--device", "cuda", "--timeout", 60, "--exr", "--no-model", "--replace"]
COMMON_KEYWORDS = {
    "seed": 3,
    "device": "cuda",
    "timeout_seconds": 60.0,
    "exr": True,
    "keep_model": False,
    "replace": True,
}
DEFAULTS = {"seed": 0, "timeout_seconds": None, "exr": False, "keep_model": True, "replace": False}


def _handed_on(
    monkeypatch: pytest.MonkeyPatch, function: str, words: list[Any]
) -> tuple[tuple[Any, ...], dict[str, Any]]:
    """The arguments that `function` of the harness gets from the command `words`; it does not run."""
    calls: list[tuple[tuple[Any, ...], dict[str, Any]]] = []

    def note(*arguments: Any, **keywords: Any) -> None:
        calls.append((arguments, keywords))
        raise SplashbenchError("noted")

    monkeypatch.setattr(function, note)
    assert main([str(word) for word in words]) == 1
    (call,) = calls
    return call


def test_options_of_run(monkeypatch: pytest.MonkeyPatch) -> None:
    function = "splashbench.harness.runner.run_method"
    arguments, keywords = _handed_on(monkeypatch, function, ["run", "nothing", "SCENE", "OUT"])
    assert arguments == ("nothing", Path("SCENE"), Path("OUT"))
    assert keywords.pop("oracle_geometry")
    assert keywords.pop("tell")
    none = {"preset": None, "overrides": {}, "timing_frames": TIMING_FRAMES, "withheld": None}
    none["checkpoints"], none["budget"] = None, None
    assert keywords == DEFAULTS | none | {"device": "auto"}
    words = ["--preset", "quick", "--set", "a.b=1", "--set", "c=x", "--withhold", "odd", "--timing-frames", 0]
    words += ["--checkpoints", "--budget-seconds", 60, "--budget-mb", 1.5]
    _, keywords = _handed_on(monkeypatch, function, ["run", "nothing", "SCENE", "OUT", *COMMON, *words])
    del keywords["oracle_geometry"], keywords["tell"]
    own = {"preset": "quick", "overrides": {"a": {"b": 1}, "c": "x"}, "timing_frames": 0, "withheld": "odd"}
    own["checkpoints"], own["budget"] = MARKS, Budget(seconds=60, storage_bytes=1_500_000)
    assert keywords == COMMON_KEYWORDS | own


def test_options_of_run_external(monkeypatch: pytest.MonkeyPatch, balls_directory: Path) -> None:
    function = "splashbench.harness.external.runner.run_external"
    start = ["run-external", balls_directory, "OUT", "--name", "theirs", "--format", "blender"]
    (code, *places), keywords = _handed_on(monkeypatch, function, [*start, "--command", "true"])
    assert places == [balls_directory, Path("OUT")]
    assert (code.name, code.command, code.trained, code.format, code.version) == (
        "theirs",
        "true",
        None,
        "blender",
        "1",
    )
    assert (code.mixed, code.shell, code.blank_test_images, code.masks) == (False, False, False, False)
    assert (code.render_command, code.importer, code.directory, code.points) == (None, None, Path(), 2000)
    assert callable(keywords.pop("initial_points"))
    assert keywords == DEFAULTS | {"device": "cpu", "preset": None, "timing_frames": TIMING_FRAMES, "work": None}

    words = ["--trained", "model", "--import", "a", "--method-version", "2b", "--mixed", "--shell", "--masks"]
    words += ["--blank-test-images", "--directory", "code", "--points", "0", "--preset", "long", "--work", "kept"]
    (code, *_), keywords = _handed_on(monkeypatch, function, [*start, *words, *COMMON, "--timing-frames", 9])
    assert (code.command, code.trained, code.version) == ("", Path("model"), "2b")
    assert (code.mixed, code.shell, code.blank_test_images, code.masks) == (True, True, True, True)
    assert (code.render_command, code.importer, code.directory, code.points) == (None, "a", Path("code"), 0)
    del keywords["initial_points"]
    assert keywords == COMMON_KEYWORDS | {"preset": "long", "timing_frames": 9, "work": Path("kept")}

    (code, *_), _ = _handed_on(monkeypatch, function, [*start, "--command", "true", "--render-command", "false"])
    assert code.render_command == "false"

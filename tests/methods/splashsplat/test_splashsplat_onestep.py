"""benchmarks/transport.py: one step of transport, predictors side by side."""

from __future__ import annotations

import importlib.util
import json
import sys
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest

from splashbench.scene import Scene

SMALL = ["--presets", "quick", "--set", "hull_cells=40", "--set", "transport_cells=32", "--set", "control_cells=8"]


@pytest.fixture(scope="module")
def benchmark_module() -> ModuleType:
    path = Path(__file__).resolve().parents[3] / "benchmarks" / "transport.py"
    spec = importlib.util.spec_from_file_location("benchmark_transport", path)
    module = importlib.util.module_from_spec(spec)
    sys.modules[spec.name] = module  # dataclasses look their module up
    spec.loader.exec_module(module)
    return module


def run(module: ModuleType, monkeypatch: pytest.MonkeyPatch, *arguments: str) -> int:
    monkeypatch.setattr(sys, "argv", ["transport.py", *arguments])
    return module.main()


def test_it_compares_predictors_on_balls_in_flight(benchmark_module, monkeypatch, balls_directory, tmp_path, capsys):
    json_file, markdown_file = tmp_path / "t.json", tmp_path / "t.md"
    chosen = ["--predictors", "ours", "no motion", "FLIP", "--every", "3", "--spacings", "1", "2"]
    files = ["--json", str(json_file), "--markdown", str(markdown_file)]
    assert run(benchmark_module, monkeypatch, str(balls_directory), *SMALL, *chosen, *files) == 0
    printed = capsys.readouterr().out
    assert printed.strip() == markdown_file.read_text().strip()
    assert "| no motion |" in printed
    single, double = json.loads(json_file.read_text())["results"]
    assert single["scene"] == double["scene"] == "balls"
    assert single["frames"] == [0, 3, 6]  # of the steps 0 to 6
    assert double["frames"] == [0]  # frames 0, 2, 4, 6 make three steps
    for result in (single, double):
        for figures in result["predictors"].values():
            assert 0 <= figures["validity"] <= 1
            assert figures["escape"] >= 0
            assert len(figures["per_step"]["validity"]) == len(result["frames"])
    # The longer the step, the farther from where it was the liquid is.
    assert double["predictors"]["no motion"]["escape"] > single["predictors"]["no motion"]["escape"]


def test_a_predictor_that_knows_the_motion_keeps_carriers_valid(benchmark_module, monkeypatch, balls: Scene):
    """Validity and escape of the truth: each carrier goes with the ball it is next to."""

    def oracle(state):
        grid = state.surroundings.grid
        truth = balls.truth_particles()
        now, then = truth.positions[state.t], truth.positions[state.t + 1]
        places = grid.to_scene(state.carriers)
        nearest = np.linalg.norm(places[:, None] - now[None], axis=-1).argmin(axis=1)
        return grid.to_voxels(places + then[nearest] - now[nearest])

    monkeypatch.setitem(benchmark_module.PREDICTORS, "oracle", oracle)
    config = benchmark_module.SplashSplatConfig.preset("quick", {"hull_cells": 40, "transport_cells": 32})
    scene = benchmark_module.Thinned(balls, 1)
    figures = benchmark_module.compare(scene, config, ["oracle", "no motion"], every=2, seed=0)["predictors"]
    assert figures["oracle"]["validity"] > 0.9
    assert figures["oracle"]["validity"] > figures["no motion"]["validity"] + 0.1
    assert figures["oracle"]["escape"] < 0.5 * figures["no motion"]["escape"]


def test_bad_input_is_told_in_a_line(benchmark_module, monkeypatch, tmp_path, balls_copy, capsys):
    assert run(benchmark_module, monkeypatch, str(tmp_path / "nowhere"), *SMALL) == 1
    assert "nowhere is not a folder" in capsys.readouterr().err
    meta = json.loads((balls_copy / "scene.json").read_text())
    (balls_copy / "scene.json").write_text(json.dumps(meta | {"gravity": None}))
    assert run(benchmark_module, monkeypatch, str(balls_copy), *SMALL, "--predictors", "FLIP") == 1
    assert "FLIP needs gravity" in capsys.readouterr().err
    with pytest.raises(SystemExit):
        run(benchmark_module, monkeypatch, str(balls_copy), "--spacings", "0")
    assert "--spacings and --every must be at least 1" in capsys.readouterr().err

"""The whole road on imitations: 20 released scenes, one of them 4K, and a NeuroFluid scene, up to the leaderboard."""

from __future__ import annotations

import csv
import importlib.util
import json
from dataclasses import replace
from pathlib import Path
from types import ModuleType
from typing import Any

import pytest

from splashbench.cli.main import main
from splashbench.files import image_size
from splashbench.manifest import load_scenes
from splashbench.synth.release import imitations

from ..scene.conftest import AZIMUTHS, write_view

ROAD = Path(__file__).parents[2] / "benchmarks" / "released_road.py"
LARGE, LARGE_SIZE = "bowl_001", (3840, 2160)
# As small as the preset `paper` is of use: its own has 3000 iterations, and 20 000 for the background.
TINY_PAPER = (
    "splashsplat:paper:iterations=20,hull_cells=48,transport_cells=32,control_cells=8,velocity_steps=5,"
    "background_preset=quick"
)


def road() -> ModuleType:
    """benchmarks/released_road.py, which serves an archive as the drive does."""
    spec = importlib.util.spec_from_file_location("released_road", ROAD)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def run(capsys: pytest.CaptureFixture[str], out: Path, scenes: Path | str, method: str) -> dict[str, Any]:
    """`splashbench benchmark run`; the facts that it prints."""
    capsys.readouterr()
    assert main(["benchmark", "run", str(out), "--scenes", str(scenes), "--methods", method, "--json"]) == 0
    text = capsys.readouterr().out
    facts: dict[str, Any] = json.loads(text[text.index('{\n "out"') :])
    return facts


def rows(out: Path) -> list[dict[str, str]]:
    with (out / "leaderboard" / "leaderboard.csv").open(newline="") as stream:
        return list(csv.DictReader(stream))


def peaks(out: Path, scene: str) -> dict[str, int]:
    """Peak memory of the runs of a scene in bytes, by method, as their records say."""
    results = [json.loads(path.read_text()) for path in (out / "results").glob("*.json")]
    return {each["method"]: each["metrics"]["peak_memory_bytes"]["value"] for each in results if each["scene"] == scene}


@pytest.mark.slow
def test_twenty_scenes_from_the_drive_to_the_leaderboard(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    for name in ("no_proxy", "NO_PROXY"):  # a proxy of the developer's knows nothing of this server
        monkeypatch.setenv(name, "127.0.0.1,localhost")
    scenes = [
        replace(each, size=LARGE_SIZE, frames=2) if each.name == LARGE else replace(each, size=(96, 64), frames=3)
        for each in imitations()
    ]
    # The archive is made in another process: what this one has taken its children would seem to take.
    archive, real, out = tmp_path / "served.zip", tmp_path / "real", tmp_path / "out"
    road().make_archive(archive, scenes)
    with road().drive(archive) as url:
        assert main(["download", "scenes", str(real), "--url", url, "--variant", "full", "crop"]) == 0
    assert image_size(real / "real_scene" / LARGE / "ims" / "1" / "000000.jpg") == LARGE_SIZE
    assert len(json.loads((real / "scenes.json").read_text())["scenes"]) == 40

    # The crops, which are scored: every scene has a row of the method and one of the control, without a failure.
    facts = run(capsys, out, "all", "nearest_camera")
    assert (facts["made"], facts["failed"]) == (40, 0)
    pairs = sorted((row["method"], row["scene"]) for row in rows(out))
    assert pairs == sorted((method, scene) for method in ("nearest_camera", "nothing") for scene in load_scenes())
    assert {row["status"] for row in rows(out)} == {"ok"}
    before = {path: path.read_bytes() for path in (out / "results").glob("*.json")}

    # Again: nothing is made, and no figure changes.
    facts = run(capsys, out, "all", "nearest_camera")
    assert (facts["made"], facts["failed"]) == (0, 0)
    assert {path: path.read_bytes() for path in (out / "results").glob("*.json")} == before
    assert len(rows(out)) == 40

    # As recorded: 4K within 2 GiB, the control's fit included.
    facts = run(capsys, tmp_path / "large", real / "real_scene" / LARGE, "nearest_camera")
    assert (facts["made"], facts["failed"]) == (2, 0)
    measured = peaks(tmp_path / "large", LARGE)
    assert sorted(measured) == ["nearest_camera", "nothing"]
    assert 0 < max(measured.values()) < 2 << 30, measured
    assert max(peaks(out, LARGE).values()) < 2 << 30


@pytest.mark.slow
def test_a_neurofluid_scene_takes_the_preset_of_the_paper(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    given, out = tmp_path / "given" / "watersphere", tmp_path / "out"
    for view in AZIMUTHS:
        write_view(given, view, "test" if view == "view_5" else "train", range(3), size=32)
    scenes = tmp_path / "scenes"
    assert main(["download", "neurofluid", "WaterSphere", str(scenes), "--from", str(given.parent)]) == 0
    facts = run(capsys, out, scenes, TINY_PAPER)
    assert (facts["made"], facts["failed"]) == (2, 0)
    found = {row["method"]: row for row in rows(out)}
    assert sorted(found) == ["nothing", "splashsplat"]
    assert {row["scene"] for row in found.values()} == {"WaterSphere"}
    assert found["splashsplat"]["preset"] == "paper"
    assert {row["status"] for row in found.values()} == {"ok"}
    assert float(found["splashsplat"]["psnr"]) > 10

"""`splashbench score` and `splashbench leaderboard` from end to end, on the oracle and a run that failed."""

import argparse
import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from splashbench.cli import leaderboard, score
from splashbench.errors import SplashbenchError
from splashbench.files import read_image, write_png
from splashbench.harness.oracle import write_oracle
from splashbench.scene import Scene
from splashbench.score import Result
from splashbench.submission import Identity, Record, Status, Submission, seal, write_view


def command(*words: str | Path) -> int:
    parser = argparse.ArgumentParser()
    subparsers = parser.add_subparsers(required=True)
    score.register(subparsers)
    leaderboard.register(subparsers)
    arguments = parser.parse_args([str(word) for word in words])
    return int(arguments.handler(arguments))


@pytest.fixture(autouse=True)
def _no_weights_from_outside(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("SPLASHBENCH_LPIPS_WEIGHTS", raising=False)


@pytest.fixture(scope="module")
def runs(balls: Scene, tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    """The oracle, the control `nothing`, and a run that failed."""
    folder = tmp_path_factory.mktemp("runs")
    write_oracle(balls, folder / "oracle")
    common = {"scene": balls.name, "scene_digest": balls.digest}
    for t in range(balls.n_frames):
        for name in balls.test:
            grey = np.full(balls.image(name, t).shape, 150, np.uint8)
            write_view(folder / "nothing", name, t, grey, grey[..., 0] * 0)
    seal(folder / "nothing", Identity(method="nothing", control=True, **common), Record(fit_seconds=1.0))
    (folder / "failed").mkdir()
    record = Record(status=Status.CRASHED, reason="NaN in the loss")
    seal(folder / "failed", Identity(method="unlucky", **common), record)
    return {name: folder / name for name in ("oracle", "nothing", "failed")}


def test_scores_become_a_leaderboard(runs: dict[str, Path], balls: Scene, tmp_path: Path, capsys: Any) -> None:
    results, sheet = tmp_path / "results", tmp_path / "sheet.png"
    words: list[str | Path] = ["score", *runs.values(), "--scene", balls.directory, "--out", results]
    assert command(*words, "--reference", runs["nothing"], "--sheet", sheet, "--json") == 0
    out, err = capsys.readouterr()
    answer = json.loads(out)
    assert [entry["status"] for entry in answer["results"]] == ["ok", "ok", "crashed"]
    assert answer["results"][0]["metrics"]["psnr"] == 100.0
    assert answer["results"][0]["metrics"]["dpsnr_bg"] > 50
    assert answer["results"][1]["metrics"]["dpsnr_bg"] == 0.0
    assert "unlucky failed: NaN in the loss" in err
    assert "null lpips: no LPIPS weights" in err
    files = sorted(path.name for path in results.glob("*.json"))
    assert [name.rpartition("__")[0] for name in files] == [
        "nothing__balls__best__seed0",
        "oracle__balls__truth__seed0",
        "unlucky__balls__best__seed0",
    ]
    assert Result.load(results / files[2]).reason == "NaN in the loss"
    assert read_image(sheet).std() > 10
    # Pictures lie beside the results of runs that have any.
    pictures = sorted(path.name for path in results.glob("*.jpg"))
    assert pictures == [name.replace(".json", ".jpg") for name in files[:2]]
    assert {path.suffix for path in results.iterdir()} == {".json", ".jpg"}
    assert read_image(results / pictures[0]).std() > 10

    assert command("leaderboard", results, tmp_path / "board", "--json") == 0
    answer = json.loads(capsys.readouterr().out)
    assert (answer["results"], answer["failed_runs"]) == (3, 1)
    names = {"index.html", "leaderboard.csv", "leaderboard.md", "speed_accuracy.png", "speed_accuracy.svg"}
    assert {path.name for path in (tmp_path / "board").iterdir()} == names


def test_a_tampered_submission_stops_everything_before_scoring(
    runs: dict[str, Path], balls: Scene, tmp_path: Path
) -> None:
    import shutil

    copy = Path(shutil.copytree(runs["oracle"], tmp_path / "copy"))
    (copy / "record.json").write_text("{}")
    with pytest.raises(SplashbenchError, match="refused"):
        command("score", runs["oracle"], copy, "--scene", balls.directory, "--out", tmp_path / "results")
    assert not (tmp_path / "results").exists()


def test_settings_of_the_protocol_can_be_changed_and_are_checked(
    runs: dict[str, Path], balls: Scene, tmp_path: Path, capsys: Any
) -> None:
    words: list[str | Path] = ["score", runs["nothing"], "--scene", balls.directory, "--out", tmp_path]
    assert command(*words, "--set", "outside_mask=truth", "--json") == 0
    assert json.loads(capsys.readouterr().out)["protocol"].startswith("v1+")
    with pytest.raises(SplashbenchError, match="--set nonsense: the protocol has no such setting; there are version"):
        command(*words, "--set", "nonsense=1")
    with pytest.raises(SplashbenchError, match="not KEY=VALUE"):
        command(*words, "--set", "outside_mask")


def test_the_submission_opened_is_the_one_scored(runs: dict[str, Path], balls: Scene, tmp_path: Path) -> None:
    assert command("score", runs["oracle"], "--scene", balls.directory, "--out", tmp_path) == 0
    (path,) = tmp_path.glob("*.json")
    result = Result.load(path)
    assert result.digests.submission == Submission.open(runs["oracle"]).digest
    assert result.digests.scene == balls.digest


def test_what_a_verification_has_no_use_for_is_refused(
    runs: dict[str, Path], balls: Scene, tmp_path: Path, capsys: Any
) -> None:
    words = ["score", tmp_path / "a.json", "--scene", balls.directory, "--verify"]
    for flag, value in (("--out", tmp_path), ("--sheet", tmp_path / "a.png"), ("--set", "outside_mask=truth")):
        with pytest.raises(SystemExit):
            command(*words, flag, value)
        assert f"{flag} is not for --verify" in capsys.readouterr().err


def test_a_verification_uses_the_reference(runs: dict[str, Path], balls: Scene, tmp_path: Path, capsys: Any) -> None:
    results, reference = tmp_path / "results", runs["nothing"]
    words = ["--scene", balls.directory, "--reference", reference]
    assert command("score", runs["oracle"], *words, "--out", results) == 0
    (result,) = results.glob("*.json")
    verify = ["score", result, "--scene", balls.directory, "--submissions", runs["oracle"], "--verify"]
    assert command(*verify) == 0
    assert "for want of weights or of the reference: dpsnr_bg" in capsys.readouterr().err
    assert command(*verify, "--reference", reference) == 0
    assert "dpsnr_bg" not in capsys.readouterr().err


def test_what_a_run_was_told_is_what_its_scene_stated_then(balls_directory: Path, tmp_path: Path) -> None:
    """Container masks may come later: no digest is of them."""
    import shutil

    place = Path(shutil.copytree(balls_directory, tmp_path / "balls"))
    before = Scene.open(place)
    told_before = before.stated
    assert "container masks" not in told_before
    write_oracle(before, tmp_path / "oracle")
    (place / "container_mask").mkdir()
    for name in before.train:
        write_png(place / "container_mask" / f"{name}.png", before.mask(name, 0).astype("uint8") * 255)
    after = Scene.open(place)
    assert "container masks" in after.stated
    assert after.digest == before.digest
    words = ["--scene", place, "--out", tmp_path / "results"]
    assert command("score", tmp_path / "oracle", *words) == 0
    write_oracle(after, tmp_path / "told")
    assert command("score", tmp_path / "told", *words) == 0
    told = {Result.load(path).told for path in (tmp_path / "results").glob("*.json")}
    assert told == {told_before, after.stated}
    # Neither replaces the other.
    assert command("leaderboard", tmp_path / "results", tmp_path / "board") == 0
    assert (tmp_path / "board" / "leaderboard.csv").read_text().count("oracle,") == 2

"""`splashbench benchmark init | check | site`: a repository of results becomes a site, as its workflow does it."""

from __future__ import annotations

import json
import os
import re
import shutil
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

from splashbench.benchmark import repository
from splashbench.benchmark.repository import WORKFLOW, init_benchmark, read_benchmark, read_entries
from splashbench.cli.main import main
from splashbench.errors import SplashbenchError
from splashbench.files import list_files, sha256_file
from splashbench.scene import Scene
from splashbench.version import __version__

FACTS = 'title = "Grey"\nauthors = "A. Author"\ncode = "https://example.org/grey"\n'


@pytest.fixture
def benchmark(real: Path, made: Path, tmp_path: Path) -> Path:
    """A benchmark of two scenes with one entry."""
    folder = tmp_path / "benchmark"
    scenes = [Scene.open(path) for path in sorted((real / "real_scene_crop").iterdir())]
    init_benchmark(folder, "Pours <b>", scenes)
    hand_in(folder, "grey", made)
    return folder


def hand_in(folder: Path, name: str, made: Path, method: str = "grey", facts: str = FACTS) -> Path:
    place = folder / "entries" / name
    place.mkdir(parents=True)
    (place / "entry.toml").write_text(facts)
    for path in (made / "results").glob(f"{method}__*.json"):
        shutil.copy(path, place)
    return place


def site(folder: Path, out: Path, *words: str) -> int:
    return main(["benchmark", "site", str(folder), str(out), *words])


def test_a_repository_of_results_becomes_a_site(benchmark: Path, made: Path, tmp_path: Path) -> None:
    hand_in(benchmark, "photograph", made, "nearest_camera", FACTS.replace("Grey", "Nearest <script>"))
    out = tmp_path / "site"
    assert main(["benchmark", "check", str(benchmark)]) == 0
    assert site(benchmark, out) == 0
    page = (out / "index.html").read_text()
    assert "Pours &lt;b&gt;" in page
    assert "Nearest &lt;script&gt;" in page
    assert 'href="https://example.org/grey"' in page
    assert "reported" in page
    facts = json.loads((out / "benchmark_site.json").read_text())
    assert [(each["entry"], each["scenes"]) for each in facts["entries"]] == [("photograph", 2), ("grey", 2)]
    rows = [json.loads(path.read_text())["metrics"]["psnr"]["value"] for path in (made / "results").glob("grey__*")]
    assert facts["entries"][1]["figures"]["psnr"] == pytest.approx(sum(rows) / 2, abs=0.01)
    assert "grey" in (out / "leaderboard" / "index.html").read_text()
    assert re.findall(r"https?://[^\"' )]+", page) == ["https://example.org/grey"] * 2


def test_the_same_entries_give_the_same_bytes(benchmark: Path, tmp_path: Path) -> None:
    for name in ("a", "b", "a"):
        assert site(benchmark, tmp_path / name) == 0
    trees = [
        {name: sha256_file(tmp_path / place / name) for name in list_files(tmp_path / place).names}
        for place in ("a", "b")
    ]
    assert trees[0] == trees[1]


def test_the_workflow_step_by_step(benchmark: Path, tmp_path: Path) -> None:
    """Every command of the workflow, in a fresh clone, as the runner would; what is installed is this very version."""
    yaml = pytest.importorskip("yaml")
    git = ["git", "-c", "user.name=A", "-c", "user.email=a@example.org", "-c", "init.defaultBranch=main"]
    for words in (["init", "-q"], ["add", "."], ["commit", "-q", "-m", "A first entry"]):
        subprocess.run([*git, *words], cwd=benchmark, check=True)
    clone = tmp_path / "clone"
    subprocess.run([*git, "clone", "-q", str(benchmark), str(clone)], check=True)
    workflow = yaml.safe_load((clone / WORKFLOW).read_text())
    assert set(workflow[True]) == {"pull_request", "push", "workflow_dispatch"}  # "on" is a truth value in YAML 1.1
    assert workflow["jobs"]["publish"]["needs"] == "site"
    steps = workflow["jobs"]["site"]["steps"]
    assert [step["uses"].partition("@")[0] for step in steps if "uses" in step] == [
        "actions/checkout",
        "actions/setup-python",
        "actions/upload-pages-artifact",
    ]
    commands = [step["run"] for step in steps if "run" in step]
    assert commands[0] == f'python -m pip install "splashbench=={__version__}"'
    binaries = f"{Path(sys.executable).parent}:{os.environ['PATH']}"
    for command in commands[1:]:
        subprocess.run(["sh", "-ec", command], cwd=clone, check=True, env={**os.environ, "PATH": binaries})
    (upload,) = [step for step in steps if "upload-pages-artifact" in step.get("uses", "")]
    assert (clone / upload["with"]["path"] / "index.html").is_file()
    assert subprocess.run(["git", "status", "--porcelain"], cwd=clone, capture_output=True, check=True).stdout == b""


def _no_result(entry: Path, made: Path) -> None:
    for path in entry.glob("*.json"):
        path.unlink()


def _edited(entry: Path, made: Path) -> None:
    path = next(entry.glob("*.json"))
    data = json.loads(path.read_text())
    data["metrics"]["psnr"]["value"] += 3
    path.write_text(json.dumps(data))


def _other_scene(entry: Path, made: Path) -> None:
    path = next(entry.glob("*.json"))
    path.write_text(path.read_text().replace('"bowl_001"', '"bowl_003"').replace('"tank_002"', '"bowl_003"'))


def _other_bytes(entry: Path, made: Path) -> None:
    path = next(entry.glob("*.json"))
    data = json.loads(path.read_text())
    data["digests"]["scene"] = "0" * 64
    path.write_text(json.dumps(data))


def _link(entry: Path, made: Path) -> None:
    (entry / "more.json").symlink_to("/etc/passwd")


def _no_facts(entry: Path, made: Path) -> None:
    (entry / "entry.toml").unlink()


def _script(entry: Path, made: Path) -> None:
    (entry / "entry.toml").write_text(FACTS.replace("https://example.org/grey", "javascript:alert(1)"))


def _twice(entry: Path, made: Path) -> None:
    hand_in(entry.parent.parent, "zebra", made)
    shutil.rmtree(entry)
    hand_in(entry.parent.parent, "aardvark", made)


@pytest.mark.parametrize(
    ("spoil", "fault"),
    [
        (_no_result, "holds no result"),
        (_edited, "is not the mean of its views"),
        (_other_scene, "which benchmark.toml does not name"),
        (_other_bytes, "is of another"),
        (_link, "is a link"),
        (_no_facts, "entry.toml is missing"),
        (_script, "must be an address"),
        (_twice, "are of one method, settings, scene and seed"),
    ],
)
def test_an_entry_with_a_fault_is_named_and_left_out(
    spoil: Any, fault: str, benchmark: Path, made: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    hand_in(benchmark, "photograph", made, "nearest_camera")
    spoil(benchmark / "entries" / "grey", made)
    assert main(["benchmark", "check", str(benchmark)]) == 1
    assert fault in capsys.readouterr().err
    assert site(benchmark, tmp_path / "site") == 0
    facts = json.loads((tmp_path / "site" / "benchmark_site.json").read_text())
    assert len(facts["left_out"]) == 1
    assert "photograph" in [each["entry"] for each in facts["entries"]]
    assert "Left out" in (tmp_path / "site" / "index.html").read_text()


def test_submissions_are_scored_again_where_the_scenes_are(
    benchmark: Path, real: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    scene = real / "real_scene_crop" / "bowl_001"
    entry = benchmark / "entries" / "hull"
    entry.mkdir()
    (entry / "entry.toml").write_text(FACTS.replace("Grey", "Hull"))
    words = ["--preset", "quick", "--timing-frames", "0", "--no-model"]
    assert main(["run", "hull_points", str(scene), str(entry / "bowl_001"), *words]) == 0
    assert main(["benchmark", "check", str(benchmark)]) == 1
    assert "holds submissions and no result" in capsys.readouterr().err
    assert site(benchmark, tmp_path / "site", "--scenes", str(real / "real_scene_crop")) == 0
    facts = json.loads((tmp_path / "site" / "benchmark_site.json").read_text())
    by_entry = {each["entry"]: each for each in facts["entries"]}
    assert by_entry["hull"]["scenes"] == 1
    assert by_entry["hull"]["verified"] != "reported"
    assert by_entry["hull"]["figures"]["psnr"] is None  # one of two scenes has no mean


def test_a_new_benchmark_has_no_entries_and_a_site_all_the_same(tmp_path: Path) -> None:
    folder = tmp_path / "repository"
    folder.mkdir()
    subprocess.run(["git", "init", "-q"], cwd=folder, check=True)
    assert main(["benchmark", "init", str(folder), "--title", "Pours"]) == 0
    benchmark = read_benchmark(folder)
    assert len(benchmark.scenes) == 20
    assert benchmark.paper == "real_20"
    assert read_entries(folder, benchmark) == []
    assert site(folder, tmp_path / "site") == 0
    page = (tmp_path / "site" / "index.html").read_text()
    assert "Nothing was handed in yet" in page
    assert "As the paper reports it" in page
    assert "20.13" in page
    with pytest.raises(SplashbenchError, match="holds files"):
        init_benchmark(folder, "Again")


def test_a_folder_of_something_else_is_not_taken_for_a_site(
    benchmark: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "home").mkdir()
    (tmp_path / "home" / "letter.txt").write_text("dear")
    assert site(benchmark, tmp_path / "home") == 1
    assert "holds files that are no site's" in capsys.readouterr().err
    assert site(tmp_path / "home", tmp_path / "site") == 1
    assert "benchmark.toml is missing; make a benchmark with" in capsys.readouterr().err


@pytest.mark.parametrize("how", ["file", "link", "too_large"])
def test_what_is_no_entry_is_named(
    how: str, benchmark: Path, made: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    entries = benchmark / "entries"
    if how == "file":
        shutil.copy(next((made / "results").glob("nearest_camera__*")), entries / "mine.json")
    elif how == "link":
        (entries / "mine").symlink_to(tmp_path / "nowhere")
    else:
        monkeypatch.setattr(repository, "MAX_BYTES", 10)
    (entries / "README.md").write_text("Notes beside the entries.\n")
    faulty = [entry for entry in read_entries(benchmark, read_benchmark(benchmark)) if entry.faults]
    (entry,) = faulty
    assert (len(entry.faults), entry.results) == (1, {})
    assert {"file": "is no folder", "link": "is a link", "too_large": "MiB, more than"}[how] in entry.faults[0]


def test_submissions_that_cannot_be_scored_are_named_and_left_out(benchmark: Path, real: Path, tmp_path: Path) -> None:
    entry = benchmark / "entries" / "hull"
    (entry / "run").mkdir(parents=True)
    (entry / "entry.toml").write_text(FACTS.replace("Grey", "Hull"))
    (entry / "run" / "submission.toml").write_text("schema_version = 1\n")
    assert site(benchmark, tmp_path / "site", "--scenes", str(real)) == 0
    facts = json.loads((tmp_path / "site" / "benchmark_site.json").read_text())
    assert [each["entry"] for each in facts["entries"]] == ["grey"]
    (fault,) = facts["left_out"]["hull"]
    assert fault.startswith("entries/hull/run cannot be scored: ")
    assert str(tmp_path) not in (tmp_path / "site" / "index.html").read_text()


def test_a_benchmark_that_could_not_be_read_again_is_not_made(tmp_path: Path) -> None:
    with pytest.raises(SplashbenchError, match="title"):
        init_benchmark(tmp_path / "new", "x" * 101)
    assert not (tmp_path / "new").exists()

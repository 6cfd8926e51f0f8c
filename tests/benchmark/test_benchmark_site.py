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
from splashbench.benchmark.repository import (
    WORKFLOW,
    init_benchmark,
    read_benchmark,
    read_entries,
    result_fault,
    workflow_fault,
)
from splashbench.cli.main import main
from splashbench.errors import SplashbenchError
from splashbench.files import list_files, sha256_file
from splashbench.scene import Scene

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


#: For a pip that is not to reach any index, with what is installed here to build by.
OFFLINE = {
    "PIP_NO_INDEX": "1",
    "PIP_NO_DEPS": "1",
    "PIP_NO_BUILD_ISOLATION": "false",
    "PIP_DISABLE_PIP_VERSION_CHECK": "1",
}
GIT = ["git", "-c", "user.name=A", "-c", "user.email=a@example.org", "-c", "init.defaultBranch=main"]


def commit(folder: Path) -> None:
    for words in (["init", "-q"], ["add", "."], ["commit", "-q", "-m", "A first entry"]):
        subprocess.run([*GIT, *words], cwd=folder, check=True)


def stand_in(folder: Path) -> Path:
    """The source of a package that is called splashbench and does nothing."""
    (folder / "splashbench").mkdir(parents=True)
    (folder / "splashbench" / "__init__.py").write_text("STAND_IN = True\n")
    (folder / "pyproject.toml").write_text(
        '[build-system]\nrequires = ["setuptools"]\nbuild-backend = "setuptools.build_meta"\n'
        '[project]\nname = "splashbench"\nversion = "9.9"\n[tool.setuptools]\npackages = ["splashbench"]\n'
    )
    return folder


def as_a_shell(command: str, place: Path, **environment: str) -> None:
    """Run a command as a workflow's step; what is installed here comes first."""
    binaries = f"{Path(sys.executable).parent}:{os.environ['PATH']}"
    subprocess.run(
        ["bash", "-eo", "pipefail", "-c", command],
        cwd=place,
        check=True,
        env={**os.environ, "PATH": binaries, **environment},
    )


def install_command(folder: Path) -> str:
    yaml = pytest.importorskip("yaml")
    steps = yaml.safe_load((folder / WORKFLOW).read_text())["jobs"]["site"]["steps"]
    (command,) = [step["run"] for step in steps if step.get("name") == "Install"]
    return command


def test_the_workflow_step_by_step(benchmark: Path, tmp_path: Path) -> None:
    """Every command of the workflow, in a fresh clone, as the runner would; the wheel is a stand-in's."""
    yaml = pytest.importorskip("yaml")
    pytest.importorskip("setuptools")
    source = stand_in(tmp_path / "source")
    (how,) = re.findall(r"`(python -m pip wheel .*?)`", (benchmark / "README.md").read_text())
    as_a_shell(how.replace("SPLASHBENCH", str(source)), benchmark, **OFFLINE)
    commit(benchmark)
    clone = tmp_path / "clone"
    subprocess.run([*GIT, "clone", "-q", str(benchmark), str(clone)], check=True)
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
    assert commands[0] == install_command(clone)
    assert commands[0] in (clone / "README.md").read_text()
    target = tmp_path / "target"
    as_a_shell(commands[0], clone, **OFFLINE, PIP_TARGET=str(target))
    assert (target / "splashbench" / "__init__.py").read_text() == "STAND_IN = True\n"
    for command in commands[1:]:
        as_a_shell(command, clone)
    (upload,) = [step for step in steps if "upload-pages-artifact" in step.get("uses", "")]
    assert (clone / upload["with"]["path"] / "index.html").is_file()
    assert subprocess.run(["git", "status", "--porcelain"], cwd=clone, capture_output=True, check=True).stdout == b""


def test_a_tag_of_a_repository_is_what_the_workflow_installs(tmp_path: Path) -> None:
    pytest.importorskip("setuptools")
    source, target, folder = stand_in(tmp_path / "source"), tmp_path / "target", tmp_path / "benchmark"
    commit(source)
    subprocess.run([*GIT, "tag", "v9.9"], cwd=source, check=True)
    (source / "splashbench" / "__init__.py").write_text("LATER = True\n")
    subprocess.run([*GIT, "commit", "-q", "-a", "-m", "Later"], cwd=source, check=True)
    address = "https://example.org/group/splashbench.git"
    assert main(["benchmark", "init", str(folder), "--install", f"git+{address}@v9.9"]) == 0
    command = install_command(folder)
    assert command in (folder / "README.md").read_text()
    assert not (folder / "wheels").exists()
    # git takes the repository beside for that address.
    config = {
        "GIT_CONFIG_COUNT": "1",
        "GIT_CONFIG_KEY_0": f"url.{source.as_uri()}.insteadOf",
        "GIT_CONFIG_VALUE_0": address,
    }
    as_a_shell(command, folder, **OFFLINE, **config, PIP_TARGET=str(target))
    assert (target / "splashbench" / "__init__.py").read_text() == "STAND_IN = True\n"


def test_a_missing_wheel_is_told(benchmark: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["benchmark", "check", str(benchmark), "--json"]) == 0
    told = capsys.readouterr()
    warning = [line for line in told.err.splitlines() if line.startswith("warning: ")]
    assert len(warning) == 1
    assert "installs ./wheels/splashbench-*.whl, of which there is none; keep one wheel there" in warning[0]
    assert json.loads(told.out)["workflow"] in warning[0]
    (benchmark / "wheels" / "splashbench-9.8-py3-none-any.whl").touch()
    assert workflow_fault(benchmark) == ""
    (benchmark / "wheels" / "splashbench-9.9-py3-none-any.whl").touch()
    assert "there are 2" in workflow_fault(benchmark)


def test_a_wheel_of_another_name_is_installed_by_its_path(tmp_path: Path) -> None:
    folder = tmp_path / "benchmark"
    assert main(["benchmark", "init", str(folder), "--install", "tools/splashbench-9.9-py3-none-any.whl"]) == 0
    assert install_command(folder) == "python -m pip install ./tools/splashbench-9.9-py3-none-any.whl"
    assert "there is none" in workflow_fault(folder)
    (folder / "tools").mkdir()
    (folder / "tools" / "splashbench-9.9-py3-none-any.whl").touch()
    assert workflow_fault(folder) == ""


@pytest.mark.parametrize(
    "words",
    [
        "splashbench",  # of an index, where anybody may take the name
        "splashbench==1.0",
        "splashbench @ git+https://example.org/a/b@v1",
        "git+https://example.org/a/b",  # whatever is there by then
        "git+http://example.org/a/b@v1",
        "git+https://user:secret@example.org/a/b@v1",
        "git+https://example.org/a/b@v1; curl example.org",
        "git+https://example.org/a/b@v1\n        run: id",
        "git+https://example.org/a/b@v1\n",
        "git+https://example.org/a/b@$(id)",
        "git+https://example.org/a/b@${{ secrets.TOKEN }}",
        "git+https://example.org/a/b@`id`",
        "git+https://example.org/a/b@--upload-pack=id",
        'git+https://example.org/a/b@v1" "x',
        "git+https://example.org/a/b@v1 'x'",
        "-r wheels/a.whl",
        "-rwheels/a.whl",
        "--index-url=https://example.org/a.whl",
        "../a.whl",
        "/tmp/a.whl",
        "wheels/../../a.whl",
        "wheels/a b.whl",
        "wheels/*.whl",
        "https://example.org/a.whl",
        "wheels/a.tar.gz",
        "wheels/" + "a" * 300 + ".whl",
        "",
    ],
)
def test_what_must_not_stand_in_a_workflow_is_refused(
    words: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["benchmark", "init", str(tmp_path / "new"), f"--install={words}"]) == 1
    (line,) = capsys.readouterr().err.splitlines()
    assert line.startswith("error: --install ")
    assert "cannot stand in a workflow; give git+https://HOST/PATH@TAG" in line
    assert not (tmp_path / "new").exists()


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


@pytest.mark.slow
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
    # What `download scenes` fills: the scenes lie two folders below.
    assert site(benchmark, tmp_path / "site", "--scenes", str(real)) == 0
    facts = json.loads((tmp_path / "site" / "benchmark_site.json").read_text())
    by_entry = {each["entry"]: each for each in facts["entries"]}
    assert by_entry["hull"]["scenes"] == 1
    assert by_entry["hull"]["verified"] == "confirmed"
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


@pytest.mark.parametrize("words", ['"splashbench==0.2.0"', "splashbench", "'splashbench[test]'"])
def test_a_workflow_that_asks_an_index_is_told(words: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """As `init` once wrote it."""
    folder = tmp_path / "mine"
    init_benchmark(folder, "Mine", install="git+https://example.org/a/splashbench@v1")
    assert main(["benchmark", "check", str(folder)]) == 0
    assert "warning" not in capsys.readouterr().err
    path = folder / WORKFLOW
    path.write_text(path.read_text().replace("git+https://example.org/a/splashbench@v1", words))
    assert main(["benchmark", "check", str(folder)]) == 0
    warnings = [line for line in capsys.readouterr().err.splitlines() if line.startswith("warning: ")]
    assert len(warnings) == 1
    assert "asks a package index for splashbench, which none has" in warnings[0]


def test_a_result_of_another_protocol_does_not_count_whatever_it_states(benchmark: Path) -> None:
    here = read_benchmark(benchmark)
    (entry,) = read_entries(benchmark, here)
    result = next(iter(entry.results.values()))
    assert result_fault(result, here) == ""
    changed = result.protocol.model_copy(update={"opacity_threshold": 0.05})
    # Its digests still say v1: what they say is held against the settings beside them.
    forged = result.model_copy(update={"protocol": changed})
    assert "another protocol" in result_fault(forged, here)
    assert "digests.protocol is not that of its protocol" in list(forged.faults())

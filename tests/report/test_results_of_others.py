"""Results of strangers: a bad one costs its row alone, is named, and can be found out by scoring again."""

import json
import os
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from splashbench.cli.main import main
from splashbench.errors import SplashbenchError
from splashbench.harness.oracle import write_oracle
from splashbench.report import charts
from splashbench.report.anytime import chases, foremost
from splashbench.report.groups import groups
from splashbench.report.results import ResultFile, load_results, read_results
from splashbench.report.speed_accuracy import machines
from splashbench.report.table import leaderboard_table, to_csv
from splashbench.report.table_markdown import to_markdown
from splashbench.scene import Scene
from splashbench.score.result import MAX_CLAIMS, MetricValue, Result
from splashbench.score.verification import Evidence

Edit = Callable[[dict[str, Any]], object]


def _edit(path: Path, change: Edit) -> None:
    data = json.loads(path.read_text())
    change(data)
    path.write_text(json.dumps(data))


def _figure(name: str, value: Any) -> Edit:
    return lambda data: data["metrics"][name].update(value=value, reason=None)


@pytest.mark.parametrize(
    ("change", "said"),
    [
        (_figure("miou", 5), "metrics.miou is 5, which no run has (0 to 1)"),
        (_figure("ssim", 1e308), "metrics.ssim is 1e+308"),
        (_figure("psnr", 101.0), "metrics.psnr is 101, which no run has (0 to 100)"),
        (_figure("psnr", float("nan")), "metrics.psnr.value"),
        (_figure("storage_bytes", -5), "metrics.storage_bytes is -5"),
        (_figure("fit_seconds", float("inf")), "metrics.fit_seconds.value"),
        (lambda d: d.update(status="superb"), "status is 'superb', which no run has"),
        (lambda d: d.update(status="crashed"), "has a value, yet the run ended with status crashed"),
        (lambda d: d.update(stages={"fit": -1}), "stages.fit"),
        (lambda d: d.update(claimed={"psnr": float("nan")}), "claimed.psnr"),
        (lambda d: d.update(claimed={f"c{n}": 1.0 for n in range(MAX_CLAIMS + 1)}), "claimed has 1001 figures"),
        (lambda d: d.update(method="a\x1b[31mb"), "method has control characters"),
        (lambda d: d.update(preset="b" * 300), "preset has 300 letters"),
        (lambda d: d.update(withheld="[x](http://evil)"), "withheld"),
        (lambda d: d["metrics"]["psnr"].update(views={"6": {"value": 3.0, "frames": [3.0]}}), "not the mean of its"),
        (
            lambda d: d["metrics"]["psnr"].update(views={"6": {"value": 20.0, "frames": [float("nan")]}}),
            "metrics.psnr.views.6.frames.0",
        ),
        (lambda d: d.update(checkpoints=[{"seconds": 1.0, "metrics": {"miou": 2.0}}]), "checkpoints.0.miou is 2"),
        (lambda d: d.update(checkpoints=[{"seconds": 1.0, "storage_bytes": 10**400}]), "storage_bytes"),
        (lambda d: d["protocol"].update(opacity_threshold=0.05), "digests.protocol is not that of its protocol"),
    ],
)
def test_what_scoring_never_writes_costs_one_row_and_is_named(
    folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], change: Edit, said: str
) -> None:
    path = next(folder.glob("alpha__bowl__best__seed0__*"))
    _edit(path, change)
    with pytest.raises(SplashbenchError) as error:
        Result.load(path)
    assert said in str(error.value)
    assert path.name in str(error.value)
    reading = read_results(folder)
    assert [each.path for each in reading.left_out] == [path.name]
    assert said in reading.left_out[0].reason
    assert len(reading.sources) == 16
    assert main(["leaderboard", str(folder), str(tmp_path / "board"), "--json"]) == 0
    captured = capsys.readouterr()
    assert json.loads(captured.out)["left_out"][0]["file"] == path.name
    assert f"warning: {path.name} is left out: " in captured.err
    document = (tmp_path / "board" / "leaderboard.md").read_text()
    assert path.name in document.partition("## Files that are in no table")[2]
    assert "Files that are in no table: 1" in (tmp_path / "board" / "index.html").read_text()


def test_two_runs_with_one_seed_cost_that_row_alone(tmp_path: Path, make_result: Any) -> None:
    old = make_result("alpha", 0, psnr=20.0)
    new = old.model_copy(update={"digests": old.digests.model_copy(update={"submission": "f" * 64})})
    for result in (old, new, make_result("beta", 0, psnr=19.0)):
        result.save(tmp_path)
    reading = read_results(tmp_path)
    assert [source.result.method for source in reading.sources] == ["beta"]
    assert len(reading.left_out) == 2
    assert all("two runs of alpha with one seed" in each.reason for each in reading.left_out)


def test_a_copy_with_more_and_other_figures_does_not_take_the_place(tmp_path: Path, make_result: Any) -> None:
    make_result("alpha", psnr=20.0).save(tmp_path / "true")
    make_result("alpha", psnr=35.0, lpips=0.001).save(tmp_path / "forged")
    make_result("beta", psnr=19.0).save(tmp_path)
    reading = read_results(tmp_path)
    assert [source.result.method for source in reading.sources] == ["beta"]
    assert [each.path.split("/")[0] for each in reading.left_out] == ["forged", "true"]
    assert "contradict each other: psnr" in reading.left_out[0].reason


def test_a_folder_without_any_usable_result_names_the_first(tmp_path: Path) -> None:
    (tmp_path / "notes.json").write_text('{"psnr": 99}')
    with pytest.raises(SplashbenchError, match=r"notes.json: "):
        read_results(tmp_path)


@pytest.fixture(scope="module")
def scored(balls: Scene, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with the oracle's submission and, beside it, its result."""
    place = tmp_path_factory.mktemp("scored")
    write_oracle(balls, place / "oracle")
    words = ["score", str(place / "oracle"), "--scene", str(balls.directory), "--out", str(place / "results")]
    assert main(words) == 0
    return place


@pytest.fixture
def copy(scored: Path, tmp_path: Path) -> Path:
    return Path(shutil.copytree(scored, tmp_path / "copy"))


def test_a_result_that_was_edited_is_found_by_scoring_again(copy: Path, balls: Scene) -> None:
    (path,) = (copy / "results").glob("*.json")
    evidence = Evidence([copy], [balls.directory])
    found = evidence.verify(Result.load(path), path.parent)
    assert (found.verdict, found.differences) == ("confirmed", ())
    _edit(path, lambda d: (d.update(control=False, method="mine"), d["metrics"]["spill"].update(value=0.5, views={})))
    found = evidence.verify(Result.load(path), path.parent)
    assert found.verdict == "differs"
    assert [str(each) for each in found.differences] == [
        "method mine, verified oracle",
        "control False, verified True",
        "spill 0.5000, verified 0.0000",
    ]
    assert Evidence([], [balls.directory]).verify(Result.load(path), path.parent).verdict == "not verified"


def test_a_submission_beside_its_result_is_found(copy: Path, balls: Scene) -> None:
    (path,) = (copy / "results").glob("*.json")
    shutil.move(str(copy / "oracle"), copy / "results" / "oracle")
    assert Evidence([], [balls.directory]).verify(Result.load(path), path.parent).verdict == "confirmed"
    # The documents in it are no results.
    assert len(load_results(copy / "results")) == 1


def test_tables_have_the_claimed_figure_behind_the_verified_one(
    copy: Path, balls: Scene, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (path,) = (copy / "results").glob("*.json")
    _edit(path, lambda d: d["metrics"]["psnr"].update(value=77.0, views={}))
    _edit(path, lambda d: d["metrics"]["fit_seconds"].update(value=3))
    words = ["leaderboard", str(copy / "results"), str(tmp_path / "board"), "--verify", "--submissions", str(copy)]
    assert main([*words, "--scenes", str(balls.directory.parent), "--json"]) == 0
    captured = capsys.readouterr()
    (verified,) = json.loads(captured.out)["verified"]
    assert verified["verdict"] == "differs"
    assert "states otherwise: psnr 77.00, verified 100.00" in captured.err
    text = (tmp_path / "board" / "leaderboard.md").read_text()
    assert "100.00 (claimed 77.00)" in text
    assert "| differs |" in text
    csv = (tmp_path / "board" / "leaderboard.csv").read_text()
    assert csv.splitlines()[0].endswith("verified,stated_otherwise")
    assert "psnr 77.00, verified 100.00; fit_seconds 3.0, verified none" in csv
    assert "100.00 (claimed 77.00)" in (tmp_path / "board" / "index.html").read_text()


def test_a_forged_copy_gives_way_to_the_verified_one(copy: Path, balls: Scene) -> None:
    (path,) = (copy / "results").glob("*.json")
    forged = shutil.copy(path, path.with_name("forged.json"))
    _edit(Path(forged), lambda d: d["metrics"]["psnr"].update(value=50.0, views={}))
    assert len(read_results(copy / "results", Evidence([copy], [balls.directory]).verify).sources) == 1
    reading = read_results(copy / "results", Evidence([copy], [balls.directory]).verify)
    assert [source.path for source in reading.sources] == [path.name]
    assert [each.path for each in reading.left_out] == ["forged.json"]
    assert "psnr 50.00, verified 100.00" in reading.left_out[0].reason


def test_score_verifies_results(copy: Path, balls: Scene, capsys: pytest.CaptureFixture[str]) -> None:
    (path,) = (copy / "results").glob("*.json")
    words = ["score", "--verify", str(path), "--scene", str(balls.directory), "--submissions", str(copy)]
    assert main(words) == 0
    assert "confirmed" in capsys.readouterr().err
    _edit(path, lambda d: d["metrics"]["psnr"].update(value=50.0, views={}))
    assert main([*words, "--json"]) == 1
    captured = capsys.readouterr()
    assert json.loads(captured.out)["results"][0]["differences"] == [
        {"name": "psnr", "stated": "50.00", "verified": "100.00"}
    ]
    assert "error: 1 of 1 results" in captured.err


@pytest.mark.parametrize("target", [None, "SHA256SUMS"], ids=["pipe", "link to itself"])
def test_another_submission_that_cannot_be_read_spoils_no_verification(
    target: str | None, copy: Path, balls: Scene
) -> None:
    (path,) = (copy / "results").glob("*.json")
    sums = copy / "another" / "SHA256SUMS"
    sums.parent.mkdir()
    if target is None:
        os.mkfifo(sums)
    else:
        sums.symlink_to(target)
    assert Evidence([copy], [balls.directory]).verify(Result.load(path), path.parent).verdict == "confirmed"


def test_score_says_what_goes_with_verify(balls: Scene, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    words = ["score", "submission", "--scene", str(balls.directory)]
    for more, said in (([], "required: --out"), (["--out", "a", "--submissions", str(tmp_path)], "is for --verify")):
        with pytest.raises(SystemExit) as exit_:
            main([*words, *more])
        assert exit_.value.code == 2
        assert said in capsys.readouterr().err


def test_text_of_strangers_is_text_in_every_file(make_result: Any, tmp_path: Path) -> None:
    formula, link = "=HYPERLINK(0)", "[x](http://evil.example) ![y](z) # h `c` *b*"
    make_result("alpha", scene=formula, preset="@SUM(1)", psnr=20.0).save(tmp_path)
    make_result("beta", scene=link, cpu="+1+1|cmd", psnr=19.0, dpsnr_bg=-2.5).save(tmp_path)
    make_result("gamma", scene="s", status="crashed", reason="\t-1+1\n\x1b[2J# title").save(tmp_path)
    sources = load_results(tmp_path)
    table = leaderboard_table(sources)
    text = to_csv(table)
    cells = [cell for line in text.splitlines() for cell in line.split(",")]
    assert "'=HYPERLINK(0)" in cells
    assert "'@SUM(1)" in cells
    assert "-2.50" in cells
    assert not [cell for cell in cells if cell.strip('"').startswith(("=", "+", "@", "\t"))]
    assert "\x1b" not in text
    page = to_markdown(table, sources)
    assert "\\[x\\](http\\://evil.example) !\\[y\\](z) # h \\`c\\` \\*b\\*" in page
    assert "](http" not in page.replace("\\]", "")
    assert "\x1b" not in page
    assert [line for line in page.splitlines() if line.startswith("#") and "title" in line] == []


def test_of_many_methods_and_machines_a_part_is_drawn_and_the_chart_says_so(make_result: Any) -> None:
    """What grows with the square of the methods is of the best 30; the chart has 8 machines, with 24 methods each."""
    results = [make_result(f"m{n}", psnr=20.0 + n / 100, lpips=0.1, fit_seconds=9.0) for n in range(40)]
    results += [make_result("m0", cpu=f"cpu {n}", psnr=20.0, lpips=0.1, fit_seconds=9.0) for n in range(10)]
    sources = [ResultFile(f"{n}.json", result) for n, result in enumerate(results)]
    group = max(groups(sources), key=lambda group: len(group.entries))
    best = {f"m{n}" for n in range(10, 40)}
    assert {entry.label for entry in foremost(group, "psnr")} == best
    assert {chase.label for chase in chases(group, "psnr")} == best
    drawn, note = charts._drawn(machines(sources))
    assert sorted(len(machine.entries) for machine in drawn) == [1, 1, 1, 1, 1, 1, 1, 24]
    assert note == "Not drawn, but in the tables: 3 more machines and 16 more methods."
    assert charts._drawn(machines(sources[:5]))[1] == ""


def test_with_paper_says_when_it_adds_nothing(
    make_result: Any, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    make_result("alpha", psnr=20.0, fit_seconds=9.0).save(tmp_path / "results")
    words = ["leaderboard", str(tmp_path / "results"), str(tmp_path / "board"), "--with-paper"]
    assert main(words) == 0
    assert "--with-paper adds nothing to the tables" in capsys.readouterr().err
    make_result("alpha", scene="watersphere", psnr=20.0, fit_seconds=9.0).save(tmp_path / "results")
    assert main(words) == 0
    assert "adds nothing" not in capsys.readouterr().err


def test_of_two_scores_of_one_submission_the_fuller_one_counts_in_whatever_order(
    tmp_path: Path, make_result: Any
) -> None:
    """What an older score did not note, and what it lacked weights or truth for, contradicts nothing."""
    full = make_result("alpha", told=("times",), psnr=20.0, lpips=0.1, sdf_iou=0.8)
    old = full.model_copy(
        update={"told": None, "metrics": {**full.metrics, "lpips": MetricValue(), "sdf_iou": MetricValue()}}
    )
    for number, pair in enumerate(((full, old), (old, full))):
        folder = tmp_path / str(number)
        for name, result in zip("ab", pair):
            (folder / name).mkdir(parents=True)
            result.save(folder / name)
        (kept,) = load_results(folder)
        assert kept.result.told == ("times",)
        assert kept.result.value("lpips") == pytest.approx(0.1)

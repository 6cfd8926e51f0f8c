"""Tables from results made by hand: means, spreads and differences with known answers, and nothing that flatters."""

from __future__ import annotations

import csv
import hashlib
import io
from pathlib import Path

import pytest

from splashbench.files import read_json, write_model
from splashbench.score import METRICS, PROTOCOL_V1, Result
from splashbench.score.notation import FILTER_MARK, FILTER_NOTE
from splashbench.score.result import Digests, metric_value
from splashbench.study.job import RunEntry, Store
from splashbench.study.plan import PlannedRun, StudyPlan, make_plan
from splashbench.study.report import runs_csv, table_csv, write_report
from splashbench.study.spec import StudySpec, load_spec
from splashbench.study.table import Table, _paper_figures, make_table
from splashbench.study.table_markdown import to_markdown
from splashbench.submission import Record
from splashbench.synth.balls import write_balls_scene

METHOD = f"{Path(__file__).with_name('study_methods.py')}:Grey"
COMMAND = "splashbench study run greys.toml out"
# PSNR by variant, scene and seed; a crash is None.
PSNR: dict[str, dict[str, list[float | None]]] = {
    "full": {"a": [20.0, 21.0, 22.0], "b": [30.0, 31.0, 32.0]},
    "dark": {"a": [18.0, 19.5, 20.0], "b": [28.0, 29.5, 30.0]},
    "per_frame": {"a": [25.0, 26.0, 27.0], "b": [25.0, None, 27.0]},
}


@pytest.fixture(scope="module")
def plan(tmp_path_factory: pytest.TempPathFactory) -> StudyPlan:
    scenes = {name: tmp_path_factory.mktemp("two") / name for name in ("a", "b")}
    for seed, directory in enumerate(scenes.values()):
        write_balls_scene(directory, size=(24, 16), n_frames=2, seed=seed)
    spec = {
        "name": "greys",
        "title": "Greys | compared",
        "method": METHOD,
        "seeds": [0, 1, 2],
        "scenes": [{"path": str(path), "name": name} for name, path in scenes.items()],
        "metrics": ["psnr", "delta_e", "sigma_mu_ratio", "dynamic_bytes", "fit_seconds"],
        "baseline": "full",
        "base": {"wobble": 0.01},
        "reference": False,
        "paper": {"scene_set": "ablation_10"},
        "variants": [
            {"name": "full", "paper": "splashsplat"},
            {"name": "dark", "settings": {"grey": 0.1}, "note": "a note"},
            {"name": "per_frame", "preset": "dark", "settings": {"log": "x"}, "paper": "splashsplat[per_frame]"},
        ],
    }
    return make_plan(StudySpec.model_validate(spec))


@pytest.fixture
def store(plan: StudyPlan, tmp_path: Path) -> Store:
    """The folder of a study with every run made; one crashed."""
    return _made(plan, tmp_path)


def _made(plan: StudyPlan, directory: Path, mixed: str = "") -> Store:
    """mixed: the variant that is said to be of a mixed method."""
    store = Store(directory)
    for run in plan.runs:
        _put(store, run, PSNR[run.variant.name][run.scene.name][run.seed], run.variant.name == mixed)
    return store


def _put(store: Store, run: PlannedRun, psnr: float | None, mixed: bool) -> None:
    values = {"psnr": psnr, "sigma_d": 30.0, "mu_d": 120.0, "dynamic_bytes": 2_500_000.0, "fit_seconds": 60.0}
    if run.scene.name == "b":
        values["delta_e"] = 0.3  # scene a lacks what it needs
    if psnr is None:
        values = {}
    result = Result(
        method="grey",
        method_version="3",
        scene="balls",
        seed=run.seed,
        preset=run.preset,
        status="crashed" if psnr is None else "ok",
        reason="it | broke" if psnr is None else "",
        protocol=PROTOCOL_V1,
        digests=Digests(
            scene="0" * 64,
            submission=hashlib.sha256(run.digest.encode()).hexdigest(),
            protocol=PROTOCOL_V1.digest,
        ),
        metrics={name: metric_value(name, values.get(name), f"no {name}") for name in METRICS},
        hardware={"cpu": "test processor", "cores": 2},
        mixed=mixed,
    )
    entry = RunEntry(
        digest=run.digest,
        title=run.digest[:8],
        status=result.status,
        reason=result.reason,
        result=result.save(store.results).name,
        record=Record(fit_seconds=60.0, reused={"background": 40.0}),
    )
    write_model(store.entry_path(run.digest), entry)


@pytest.fixture
def table(plan: StudyPlan, store: Store) -> Table:
    return make_table(plan, store)


def test_means_spreads_and_paired_differences(table: Table) -> None:
    full, dark, _ = (row.cells["psnr"] for row in table.rows)
    assert full.seeds == (25.0, 26.0, 27.0)
    assert (full.mean, full.std) == (26.0, 1.0)
    assert (full.difference, full.difference_std) == (None, None)
    # Seed by seed: -2, -1.5, -2. The seeds' own spread of 1 dB is not in it.
    assert dark.difference == pytest.approx(-5.5 / 3)
    assert dark.difference_std == pytest.approx(0.2887, abs=1e-4)


def test_costs_of_a_gpu_and_of_a_processor_have_no_mean(plan: StudyPlan, store: Store) -> None:
    first = next(run for run in plan.runs if run.variant.name == "dark")
    entry = store.entry(first.digest)
    assert entry is not None
    result = store.result(entry)
    assert result is not None
    hardware = {**result.hardware, "gpu": "a card"}
    write_model(store.results / str(entry.result), result.model_copy(update={"hardware": hardware}))
    table = make_table(plan, store)
    full, dark, _ = table.rows
    assert (full.on_gpu_and_processor, dark.on_gpu_and_processor) == (False, True)
    assert full.cells["fit_seconds"].mean == 60.0
    assert dark.cells["fit_seconds"].mean is None
    assert dark.cells["psnr"].mean is not None
    assert dark.cells["dynamic_bytes"].mean == 2_500_000.0
    text = to_markdown(table, COMMAND)
    assert "some runs were made on a GPU and others not; make all of them on one kind (dark)" in text


def test_a_seed_that_lacks_a_scene_has_no_mean(table: Table) -> None:
    row = table.rows[2]
    cell = row.cells["psnr"]
    # Seed 1 crashed on scene b; its 26 dB on scene a alone is no mean over scenes.
    assert cell.seeds == (25.0, 27.0)
    assert (cell.difference, cell.difference_std) == (0.0, 0.0)
    assert [run.status for run in row.failed] == ["crashed"]
    assert not row.complete


def test_a_metric_is_averaged_over_the_scenes_that_can_have_it(table: Table) -> None:
    assert table.scenes_of["delta_e"] == ("b",)
    assert table.rows[0].cells["delta_e"].mean == pytest.approx(0.3)
    assert table.rows[0].cells["sigma_mu_ratio"].mean == pytest.approx(0.25)


def test_runs_that_are_not_made_leave_gaps_and_no_means(plan: StudyPlan, store: Store) -> None:
    (gone,) = [run for run in plan.runs if (run.variant.name, run.scene.name, run.seed) == ("dark", "b", 0)]
    store.entry_path(gone.digest).unlink()
    row = make_table(plan, store).rows[1]
    assert row.count("not run") == 1
    assert row.cells["psnr"].seeds == (24.5, 25.0)


def test_a_study_without_any_run_says_so_and_has_no_figures(plan: StudyPlan, tmp_path: Path) -> None:
    table = make_table(plan, Store(tmp_path))
    text = to_markdown(table, COMMAND)
    assert "- Runs: 0 ok, 0 failed, 18 not run yet" in text
    assert ": over " not in text  # which lists the scenes of a metric that some lack
    assert "| full | 0 of 6 | – | – | – | – | – |" in text
    assert table_csv(table).splitlines()[1] == f"full,0,0,6{20 * ','},false"
    assert runs_csv(table).splitlines()[1].startswith(f"a,full,0,not run,{6 * ','},")


def test_markdown_says_what_was_run_and_what_came_of_it(table: Table) -> None:
    text = to_markdown(table, COMMAND)
    for line in (
        "# Study greys: Greys | compared",
        COMMAND,
        "- Settings of every row of it, the budget: wobble = 0.01",
        "- Seeds: 0, 1, 2",
        "- Runs: 17 ok, 1 failed",
        "- ΔE: over b only",
        "| full | 6 | **26.00 ± 1.00** | 0.300 ± 0.000 | 0.250 ± 0.000 | 2.50 ± 0.00 | 60.0 ± 0.0 |",
        "| per_frame | 5 of 6 | 26.00 ± 1.41 |",
        "| dark | 6 | -1.83 ± 0.29 | 0.000 ± 0.000 |",
        "| dark | best | grey = 0.1 | – | a note |",
        "- per_frame, seed 1, b: crashed: it | broke",
        "- ΔE: no delta_e (full, dark, per_frame)",
        "- Machine: test processor, 2 cores",
        "- a: 2 frames of 5 training and 2 test views, 24x16 pixels",
    ):
        assert line in text
    assert "its time is in each row's all the same" in text


def test_the_paper_s_figures_stand_by_themselves(table: Table) -> None:
    text = to_markdown(table, COMMAND)
    measured, reported = text.split("## As reported by the paper")
    assert "20.31" not in measured
    assert "| full | 20.31 |" in reported
    assert "| per_frame | 20.06 |" in reported
    assert "Not measured here" in reported
    assert table.rows[1].paper == {}


def test_the_paper_s_storage_is_given_in_bytes() -> None:
    paper = _paper_figures(load_spec("sensitivity", scenes=["anywhere"]))
    assert paper["full"]["dynamic_bytes"] == pytest.approx(17e6)


def test_the_reference_s_row_holds_the_runs_on_unchanged_scenes_alone(plan: StudyPlan) -> None:
    changed = [
        {"name": "views", "train_views": 4},
        {"name": "raw", "perturbation": [{"kind": "empty_masks", "share": 0.5}]},
    ]
    spec = plan.spec.model_dump() | {"reference": {}, "variants": [{"name": "full"}, *changed], "paper": None}
    with_reference = make_plan(StudySpec.model_validate(spec))
    places = [(run.scene.name, run.seed) for run in with_reference.reference_row]
    assert places == [(scene.name, seed) for seed in spec["seeds"] for scene in plan.scenes]
    assert len(with_reference.references) == 3 * len(places)


def test_csv_and_json_hold_the_same_figures(table: Table, tmp_path: Path) -> None:
    files = write_report(table, tmp_path / "report", COMMAND)
    assert [path.name for path in files] == [
        *("table.md", "table.csv", "runs.csv", "table.json", "chart.png", "chart.svg")
    ]
    rows = list(csv.DictReader(io.StringIO(table_csv(table))))
    assert [row["variant"] for row in rows] == ["full", "dark", "per_frame"]
    assert float(rows[1]["psnr_difference"]) == pytest.approx(-5.5 / 3)
    assert rows[0]["psnr_difference"] == ""
    said = read_json(tmp_path / "report" / "table.json")
    assert said["rows"][1]["figures"]["psnr"]["difference"] == pytest.approx(-5.5 / 3)
    assert said["rows"][0]["paper"] == {"psnr": 20.31}
    runs = list(csv.DictReader(io.StringIO(runs_csv(table))))
    assert len(runs) == 18
    assert {run["reused_seconds"] for run in runs} == {"40"}
    (failed,) = [run for run in runs if run["status"] != "ok"]
    assert (failed["variant"], failed["seed"], failed["psnr"], failed["reason"]) == ("per_frame", "1", "", "it | broke")


def test_figures_of_mixed_methods_that_rest_on_the_filter_are_marked(plan: StudyPlan, tmp_path: Path) -> None:
    table = make_table(plan, _made(plan, tmp_path / "store", mixed="dark"))
    text = to_markdown(table, COMMAND)
    assert FILTER_NOTE in text
    figures, differences = (
        next(line for line in part.splitlines() if line.startswith("| dark"))
        for part in (text, text.split("## Difference to")[1])
    )
    for line in (figures, differences):
        # Delta E and sigma_D over mu_D are of particles; PSNR, storage and time are not.
        cells = [cell.strip() for cell in line.strip(" |").split("|")]
        assert [FILTER_MARK in cell for cell in cells] == [False, False, False, True, True, False, False]
    assert FILTER_MARK not in next(line for line in text.splitlines() if line.startswith("| full"))
    files = write_report(table, tmp_path / "report", COMMAND)
    assert FILTER_NOTE[:20] in files[-1].read_text()
    assert [row["mixed"] for row in csv.DictReader(io.StringIO(table_csv(table)))] == ["false", "true", "false"]
    assert {row["mixed"] for row in csv.DictReader(io.StringIO(runs_csv(table))) if row["variant"] == "dark"} == {
        "true"
    }
    said = read_json(tmp_path / "report" / "table.json")
    assert [row["mixed"] for row in said["rows"]] == [False, True, False]
    assert {name for name, facts in said["metrics"].items() if facts["filtered"]} == {"delta_e", "sigma_mu_ratio"}


def test_no_mark_stands_where_no_method_is_mixed(table: Table, tmp_path: Path) -> None:
    assert FILTER_MARK not in to_markdown(table, COMMAND)
    assert FILTER_NOTE[:20] not in write_report(table, tmp_path / "report", COMMAND)[-1].read_text()


def test_the_chart_depends_on_the_results_alone(table: Table, tmp_path: Path) -> None:
    for name in ("one", "two"):
        write_report(table, tmp_path / name, COMMAND)
    for file in ("chart.png", "chart.svg"):
        assert (tmp_path / "one" / file).read_bytes() == (tmp_path / "two" / file).read_bytes()
    text = (tmp_path / "one" / "chart.svg").read_text()
    assert text.startswith("<?xml")

"""The leaderboard's page: what it holds, that it needs nothing but itself, and how it behaves in a browser."""

import json
import re
import shutil
import subprocess
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from splashbench.cli.main import main
from splashbench.files import read_image
from splashbench.report.page import PAGE, leaderboard_page
from splashbench.report.page.content import command
from splashbench.report.results import load_results
from splashbench.report.statistics import pareto_mask
from splashbench.report.table import leaderboard_table, to_csv
from splashbench.score.result import CheckpointScore, Result
from splashbench.score.settings import PROTOCOL_V1

BROWSERS = ("chromium", "chromium-browser", "google-chrome")
CHOOSE = """
const choose = (id, value) => {
  const box = document.getElementById(id);
  box.value = value;
  box.dispatchEvent(new Event("change"));
};
"""
#: Goes before the page's own script: collects what it complains of.
WATCH = """<script>
window.faults = [];
addEventListener("error", event => faults.push(String(event.message)));
addEventListener("unhandledrejection", event => faults.push(String(event.reason)));
console.error = (...words) => faults.push(words.join(" "));
</script>"""


def course(*states: tuple[float, float]) -> tuple[CheckpointScore, ...]:
    """Checkpoints at (seconds, PSNR)."""
    return tuple(
        CheckpointScore(seconds=s, metrics={"psnr": psnr, "lpips": 1 / psnr, "miou": psnr / 40}) for s, psnr in states
    )


@pytest.fixture
def results(make_result: Any, tmp_path: Path) -> Path:
    """Three methods and `nothing` on two scenes with two seeds, a failed run, and one on another machine."""
    directory = tmp_path / "results"
    figures: dict[str, Any] = {"lpips": 0.05, "miou": 0.7, "peak_memory_bytes": 2.0**30, "storage_bytes": 3e6}
    for s, scene in enumerate(("bowl", "tank")):
        for seed in range(2):
            shift = s + 0.1 * seed
            for method, psnr, seconds, states in (
                ("fast", 22.0, 9.0, course((5.1, 20.0 + shift))),
                ("good", 28.0, 80.0, course((6.0, 15.0), (11.0, 24.0 + shift), (41.0, 27.0 + shift))),
                ("slow", 26.0, 300.0, course((41.0, 21.0), (170.0, 25.0))),
            ):
                make_result(
                    method,
                    seed,
                    scene,
                    psnr=psnr + shift,
                    fit_seconds=seconds,
                    checkpoints=states,
                    told=("times",),
                    stages={"fit": seconds - 1, "rest": 1.0},
                    overrides=("iterations=7",) if method == "fast" else (),
                    **{**figures, "storage_bytes": 1e6 * seconds},
                ).save(directory)
        make_result("nothing", 0, scene, control=True, psnr=12.0, fit_seconds=3.0, told=("times",)).save(directory)
    make_result("broken", 0, "bowl", status="crashed", reason="no memory", told=("times",)).save(directory)
    make_result("good", 0, "bowl", cpu="another", psnr=50.0, fit_seconds=1.0, told=("times",), **figures).save(
        directory
    )
    return directory


def page_of(results: Path, with_paper: bool = False) -> str:
    sources = load_results(results)
    return leaderboard_page(leaderboard_table(sources), sources, with_paper)


def data_of(page: str) -> dict[str, Any]:
    found = re.search(r'<script type="application/json" id="data">(.*?)</script>', page, re.DOTALL)
    assert found is not None
    return json.loads(found[1])


def test_the_page_needs_nothing_but_itself_and_is_always_the_same(results: Path) -> None:
    page = page_of(results)
    assert page == page_of(results)
    assert len(page) < 8 << 20
    # Beside the chart library, which names addresses that it never asks for here.
    own = re.sub(r"<script>/\*\*?!?.*?plotly.*?</script>", "", page, count=1, flags=re.DOTALL | re.IGNORECASE)
    assert len(own) < len(page) / 10
    assert re.findall(r"""(?:src|href)\s*=|@import|url\(|fetch\(|XMLHttpRequest|https?://""", own) == []


def test_names_from_strangers_stay_text(make_result: Any, tmp_path: Path) -> None:
    hostile = "</script><img src=x onerror=alert(1)>"
    make_result("alpha", scene=hostile, reason=hostile, psnr=20.0, fit_seconds=9.0).save(tmp_path / "results")
    make_result(
        "beta", scene=hostile, notes={hostile: hostile}, overrides=(f"a={hostile}",), psnr=2.0, fit_seconds=9.0
    ).save(tmp_path / "results")
    page = page_of(tmp_path / "results")
    assert "<img src=x" not in page
    assert data_of(page)["rows"][0]["scene"] == hostile


def test_failed_runs_and_machines_are_kept_apart(results: Path) -> None:
    data = data_of(page_of(results))
    assert len(data["groups"]) == 2
    here = data["groups"][1]
    assert here["machine"].startswith("test processor")
    assert here["told"] == "times"
    # It ran on one scene of two, so that its means could not be compared.
    assert here["left_out"] == ["broken"]
    assert here["shared_scenes"] == ["bowl", "tank"]
    assert "another" in data["groups"][0]["machine"]
    assert [row["status"] for row in data["rows"]].count("crashed") == 1


def test_means_are_over_scenes_that_methods_have_in_common(make_result: Any, tmp_path: Path) -> None:
    for method, scenes in (("a", "abcd"), ("b", "abc"), ("c", "abc"), ("d", "d")):
        for scene in scenes:
            psnr = 20.0 + "abcd".index(scene) + "abcd".index(method) / 10
            make_result(method, scene=scene, psnr=psnr, fit_seconds=9.0).save(tmp_path / "results")
    make_result("a", 1, scene="a", status="timeout", reason="over 60 s").save(tmp_path / "results")
    (here,) = data_of(page_of(tmp_path / "results"))["groups"]
    assert (here["shared_scenes"], here["left_out"]) == (["a", "b", "c"], ["d"])
    figures = {label: entry["figures"]["psnr"]["value"] for label, entry in here["estimates"].items()}
    # Without the control `nothing` the run that failed cannot be charged: it is counted, and its method on no front.
    assert figures == {"a": pytest.approx(21.0), "b": pytest.approx(21.1), "c": pytest.approx(21.2)}
    assert (here["estimates"]["a"]["runs"], here["estimates"]["a"]["failed"]) == (4, 1)
    assert here["scenes"] == ["a", "b", "c", "d"]


def test_a_failed_run_has_the_quality_of_nothing(results: Path, make_result: Any) -> None:
    next(path for path in results.glob("good__bowl__*") if "test processor" in path.read_text()).unlink()
    make_result("good", 7, scene="bowl", status="out_of_memory", reason="killed", told=("times",)).save(results)
    here = data_of(page_of(results))["groups"][-1]
    entry = here["estimates"]["good"]
    assert entry["failed"] == 1
    assert entry["figures"]["psnr"]["runs"] == 4
    # Of 12, 28 or 28.1, 29 and 29.1 dB the middle two.
    assert 28.4 < entry["figures"]["psnr"]["value"] < 28.6


def test_odd_results_do_not_stop_the_page(make_result: Any, tmp_path: Path) -> None:
    folder = tmp_path / "results"
    make_result("a", fit_seconds=0.0, psnr=20.0, settings={"rate": float("nan")}).save(folder)
    make_result("b", fit_seconds=9.0, psnr=21.0).save(folder)
    make_result("b", 1, scene="tank", fit_seconds=9.0).save(folder)
    make_result("constructor", scene="far", fit_seconds=9.0, psnr=3.0).save(folder)
    path = next(folder.glob("a__*"))
    path.write_text(path.read_text().replace('"rate": null', '"rate": NaN'))
    data = data_of(page_of(folder))
    assert {"rate": "NaN"} in data["settings"].values() or {"rate": None} in data["settings"].values()
    assert len(data["rows"]) == 4


def test_one_submission_scored_by_two_protocols_is_two_runs(make_result: Any, tmp_path: Path) -> None:
    first: Result = make_result("a", psnr=20.0, fit_seconds=9.0)
    changed = PROTOCOL_V1.model_copy(update={"opacity_threshold": 0.3})
    digests = first.digests.model_copy(update={"protocol": changed.digest})
    metrics = {**first.metrics, "psnr": first.metrics["psnr"].model_copy(update={"value": 30.0})}
    first.save(tmp_path / "results")
    second = first.model_copy(update={"protocol": changed, "digests": digests, "metrics": metrics})
    second.save(tmp_path / "results")
    data = data_of(page_of(tmp_path / "results"))
    for row in data["rows"]:
        (number,) = row["runs"]
        assert data["runs"][number]["figures"]["psnr"] == row["cells"]["psnr"][0]
        assert data["runs"][number]["group"] == row["group"]


def test_what_scenes_told_is_never_mixed_in_a_row(make_result: Any, tmp_path: Path) -> None:
    make_result("a", 0, psnr=20.0, told=None).save(tmp_path / "results")
    make_result("a", 1, psnr=22.0, told=("times", "gravity")).save(tmp_path / "results")
    rows = data_of(page_of(tmp_path / "results"))["rows"]
    assert {(row["told"], row["cells"]["psnr"][0]) for row in rows} == {("not noted", 20.0), ("times, gravity", 22.0)}


def test_who_leads_when(results: Path) -> None:
    here = data_of(page_of(results))["groups"][1]
    leaders = {s["seconds"]: [place["label"] for place in s["ranking"]] for s in here["standings"]["psnr"]}
    # At 10 s `good` has 15 dB and `fast` is done; `slow` begins at 41 s.
    assert leaders == {10: ["fast", "good"], 60: ["good", "fast", "slow"], 300: ["good", "slow", "fast"]}
    at_ten = here["standings"]["psnr"][0]
    assert at_ten["ranking"][0]["value"] == pytest.approx(22.55)
    assert at_ten["lead"]["difference"]["value"] == pytest.approx(7.55)
    assert at_ten["lead"]["scenes"] == 2
    assert at_ten["lead"]["probability"] is None


def test_curves_begin_where_every_run_has_a_value(results: Path) -> None:
    here = data_of(page_of(results))["groups"][1]
    curves = {curve["label"]: curve for curve in here["curves"]["psnr"]}
    # `nothing` was run on both scenes, so that each curve begins with what it shows.
    assert curves["slow"]["y"][0] == pytest.approx(12.0)
    assert curves["slow"]["y"][-1] == pytest.approx(26.55)
    assert curves["good"]["x"][-1] == 80
    assert "broken" not in curves


def test_without_the_control_nothing_a_curve_begins_later(results: Path) -> None:
    for path in results.glob("nothing__*"):
        path.unlink()
    here = data_of(page_of(results))["groups"][1]
    slow = next(curve for curve in here["curves"]["psnr"] if curve["label"] == "slow")
    assert slow["x"][0] >= 41


def test_the_time_to_the_others_quality_charges_failures(results: Path) -> None:
    here = data_of(page_of(results))["groups"][1]
    chases = {(chase["label"], chase["target"]): chase for chase in here["chases"]["psnr"]}
    # `good` passes the 22.05 dB that `fast` ends with on the first scene at 11 s: 11 of 9 seconds.
    assert chases["good", "fast"]["ratio"] == pytest.approx(11 / 9, rel=1e-3)
    assert chases["fast", "good"]["ratio"] is None
    assert chases["fast", "good"]["reached"] == 0
    assert chases["broken", "fast"]["ratio"] is None


def test_the_command_makes_the_run_again(make_result: Any) -> None:
    result: Result = make_result("alpha", 3, "my bowl", overrides=("a=1", "b=x y"), checkpoints=course((5.0, 20.0)))
    assert command(result) == (
        "splashbench run alpha 'scenes/my bowl' OUT --preset best --seed 3 --checkpoints --set a=1 --set 'b=x y'"
    )


def test_pictures_are_embedded_where_they_lie_beside_results(results: Path, tmp_path: Path) -> None:
    from splashbench.files import write_image

    sources = load_results(results)
    first, second = (results / source.path for source in sources[:2])
    write_image(first.with_suffix(".jpg"), np.full((40, 60, 3), 90, np.uint8))
    second.with_suffix(".jpg").write_bytes(b"<svg onload=alert(1)>")
    assert main(["leaderboard", str(results), str(tmp_path / "board")]) == 0
    data = data_of((tmp_path / "board" / PAGE).read_text())
    sheets = {run["file"]: run["sheet"] for run in data["runs"]}
    assert sheets[first.name].startswith("data:image/jpeg;base64,")
    assert sheets[second.name] is None


# --- in a browser


@pytest.fixture(scope="module")
def browser() -> str:
    for name in BROWSERS:
        if found := shutil.which(name):
            return found
    pytest.skip(f"needs a browser, one of {', '.join(BROWSERS)} (Debian: apt install chromium)")


def browse(browser: str, page: str, folder: Path, script: str, *options: str) -> Any:
    """What `script`, which ends in `return ...`, returns once the page has been drawn."""
    path = folder / "page.html"
    after = f"""<script>
addEventListener("load", async () => {{
  await new Promise(resolve => setTimeout(resolve, 300));
  let outcome;
  try {{ outcome = await (async () => {{ {script} }})(); }} catch (error) {{ outcome = {{ error: String(error) }}; }}
  const box = document.createElement("pre");
  box.id = "outcome";
  box.textContent = btoa(unescape(encodeURIComponent(JSON.stringify({{ outcome, faults }}))));
  document.body.append(box);
}});
</script>"""
    path.write_text(page.replace("<body>", f"<body>{WATCH}").replace("</body>", f"{after}</body>"), encoding="utf-8")
    profile = f"--user-data-dir={folder / 'profile'}"
    words = ["--headless=new", "--no-sandbox", "--disable-gpu", profile, "--virtual-time-budget=15000", *options]
    done = subprocess.run(
        [browser, *words, "--dump-dom", path.as_uri()], capture_output=True, text=True, timeout=120, check=False
    )
    found = re.search(r'<pre id="outcome">([A-Za-z0-9+/=]*)</pre>', done.stdout)
    assert found is not None, done.stderr[-2000:]
    import base64

    answer = json.loads(base64.b64decode(found[1]))
    assert answer["faults"] == []
    assert "error" not in (answer["outcome"] or {}), answer["outcome"]
    return answer["outcome"]


SORTED = """
const header = name => document.querySelector(`#rows th[data-column=${name}] button`);
const column = n => [...document.querySelectorAll("#rows tbody tr")].map(row => row.cells[n].textContent);
header("psnr").click();
const falling = column(5);
header("psnr").click();
const rising = column(5);
header("scene").click();
return { falling, rising, scenes: column(0), sort: document.querySelector("#rows th[data-column=scene]").ariaSort };
"""


def test_headings_sort_and_what_has_no_figure_comes_last(results: Path, browser: str, tmp_path: Path) -> None:
    found = browse(browser, page_of(results), tmp_path, SORTED)
    for name, order in (("falling", sorted), ("rising", lambda values: sorted(values)[::-1])):
        cells = found[name]
        assert cells[-1] == "–"
        values = [float(cell) for cell in cells[:-1]]
        assert len(values) == 9
        assert values == order(values)[::-1]
    assert found["scenes"] == sorted(found["scenes"])
    assert found["sort"] == "ascending"


FILTERED = """
const count = () => document.querySelectorAll("#rows tbody tr").length;
const all = count();
choose("filter-scene", "tank");
const tank = count();
document.getElementById("filter-controls").click();
const methods = count();
choose("filter-scene", "");
choose("filter-status", "crashed");
const failed = count();
choose("filter-status", "");
const search = document.getElementById("search");
search.value = "GOOD"; search.dispatchEvent(new Event("input"));
return { all, tank, methods, failed, good: count(), said: document.getElementById("table-count").textContent };
"""


def test_filters_work_together(results: Path, browser: str, tmp_path: Path) -> None:
    found = browse(browser, page_of(results), tmp_path, CHOOSE + FILTERED)
    assert found == {"all": 10, "tank": 4, "methods": 3, "failed": 1, "good": 3, "said": "3 of 10 rows"}


DRAWN = """
choose("group", "1");
const answer = { fronts: {} };
const wanted = ["fit_seconds", "storage_bytes"].flatMap(x => ["psnr", "lpips"].flatMap(
  y => ["all scenes", "bowl"].map(scene => [x, y, scene])));
for (const [x, y, scene] of wanted) {
  choose("cost-x", x); choose("cost-y", y); choose("cost-scene", scene);
  answer.fronts[[x, y, scene].join(" ")] = document.getElementById("cost").front;
}
choose("cost-y", "psnr");
await new Promise(resolve => setTimeout(resolve, 300));
answer.marks = document.querySelectorAll("#cost .scatterlayer .point").length;
answer.lines = document.querySelectorAll("#anytime .scatterlayer .js-line").length;
choose("anytime-scene", "tank");
await new Promise(resolve => setTimeout(resolve, 300));
answer.seeds = document.querySelectorAll("#anytime .scatterlayer .js-line").length;
const picture = await Plotly.toImage("anytime", { format: "png", width: 300, height: 200 });
const image = new Image(); image.src = picture; await image.decode();
const canvas = Object.assign(document.createElement("canvas"), { width: 300, height: 200 });
const pen = canvas.getContext("2d");
pen.drawImage(image, 0, 0);
answer.colours = new Set(new Uint32Array(pen.getImageData(0, 0, 300, 200).data.buffer)).size;
answer.cards = [...document.querySelectorAll(".card dd")].map(cell => cell.firstChild.textContent);
return answer;
"""


def test_charts_are_drawn_and_their_front_is_the_pareto_front(results: Path, browser: str, tmp_path: Path) -> None:
    page = page_of(results)
    found = browse(browser, page, tmp_path, CHOOSE + DRAWN)
    data = data_of(page)
    for choice, front in found["fronts"].items():
        x, y, scene = choice.split(" ", 2)
        points = {}
        for label, entry in data["groups"][1]["estimates"].items():
            runs = [r for r in data["runs"] if r["group"] == 1 and r["label"] == label and r["scene"] == scene]
            if scene == "all scenes" and x in entry["figures"]:
                points[label] = [entry["figures"][name]["value"] for name in (x, y)]
            elif runs and x in runs[0]["figures"]:
                points[label] = [float(np.median([r["figures"][name] for r in runs])) for name in (x, y)]
        sign = np.array([1 if data["metrics"][name]["better"] == "lower" else -1 for name in (x, y)])
        kept = pareto_mask(np.array(list(points.values())) * sign)
        assert set(front) == {label for label, keep in zip(points, kept) if keep}, choice
    assert found["marks"] == 3
    assert found["lines"] >= 3
    assert found["seeds"] == 6
    assert found["colours"] > 20
    assert found["cards"][0].startswith("fast, 22.55")


DETAILS = """
const row = [...document.querySelectorAll("#rows tbody tr")].find(
  row => row.cells[1].textContent === "fast" && row.cells[0].textContent === "bowl");
const open = row.cells[0].querySelector("button");
open.focus();
const focused = document.activeElement === open;
open.click();
const box = document.getElementById("details");
const text = box.textContent, shown = box.open;
document.getElementById("details-close").click();
return { focused, text, shown, closed: !box.open, stages: box.querySelectorAll(".stages span").length };
"""


def test_a_row_opens_its_command_and_record(results: Path, browser: str, tmp_path: Path) -> None:
    found = browse(browser, page_of(results), tmp_path, DETAILS)
    assert found["focused"]
    assert found["shown"]
    assert found["closed"]
    assert (
        "splashbench run fast scenes/bowl OUT --preset best --seed 1 --checkpoints --set iterations=7" in found["text"]
    )
    assert "told: times" in found["text"]
    assert found["stages"] == 4


def test_strangers_names_are_shown_as_text(make_result: Any, browser: str, tmp_path: Path) -> None:
    hostile = "</script><img src=x onerror=\"faults.push('ran')\"><b>"
    for method in ("alpha", "beta"):
        make_result(
            method, scene=hostile, psnr=20.0, fit_seconds=9.0, checkpoints=course((5.0, 3.0)), notes={"a": hostile}
        ).save(tmp_path / "results")
    script = """document.querySelector("#rows tbody button").click();
    await new Promise(resolve => setTimeout(resolve, 300));
    return { images: document.querySelectorAll("img").length, bold: document.querySelectorAll("b").length,
      text: document.querySelector("#rows tbody tr").cells[0].textContent };"""
    assert browse(browser, page_of(tmp_path / "results"), tmp_path, script) == {
        "images": 0,
        "bold": 0,
        "text": hostile,
    }


def test_the_dark_page_is_dark_and_its_picture_is_not_empty(results: Path, browser: str, tmp_path: Path) -> None:
    script = "return getComputedStyle(document.body).backgroundColor;"
    light = browse(browser, page_of(results), tmp_path, script)
    dark = browse(browser, page_of(results), tmp_path, script, "--blink-settings=preferredColorScheme=0")
    assert light == "rgb(255, 255, 255)"
    assert dark == "rgb(20, 23, 26)"
    shot = tmp_path / "shot.png"
    words = ["--headless=new", "--no-sandbox", "--disable-gpu", "--window-size=1200,1600", "--virtual-time-budget=5000"]
    subprocess.run(
        [
            browser,
            *words,
            f"--user-data-dir={tmp_path / 'p'}",
            f"--screenshot={shot}",
            (tmp_path / "page.html").as_uri(),
        ],
        capture_output=True,
        timeout=120,
        check=True,
    )
    assert read_image(shot)[400:1400].std() > 10


def test_the_paper_stands_apart_and_hollow(results: Path, browser: str, tmp_path: Path) -> None:
    script = 'return document.getElementById("paper").data.map(trace => trace.marker.symbol);'
    symbols = browse(browser, page_of(results, with_paper=True), tmp_path, script)
    assert len(symbols) >= 4
    assert all(symbol.endswith("-open") for symbol in symbols)


def test_the_committed_page_is_what_its_results_give() -> None:
    folder = Path(__file__).parents[2] / "leaderboards" / "told_nothing"
    if not folder.is_dir():
        pytest.skip("the page of the project's runs lies in its repository alone")
    sources = load_results(folder / "results")
    table = leaderboard_table(sources)
    assert (folder / "leaderboard.csv").read_text(encoding="utf-8") == to_csv(table), "run `make leaderboard`"
    committed = data_of((folder / PAGE).read_text(encoding="utf-8"))
    made = data_of(leaderboard_page(table, sources))
    # Figures are rounded to six digits; another numpy may differ in the last.
    for kept, new in zip(committed["groups"], made["groups"], strict=True):
        assert kept["shared_scenes"] == new["shared_scenes"]
        for label, entry in new["estimates"].items():
            for name, found in entry["figures"].items():
                assert kept["estimates"][label]["figures"][name]["value"] == pytest.approx(found["value"], rel=1e-4)
    assert len(committed["runs"]) == len(made["runs"]) == len(sources)
    assert any(run["sheet"] for run in committed["runs"])

"""The leaderboard's page in a browser: it sorts, filters, draws and opens what it is asked for, without a complaint."""

import base64
import json
import re
import shutil
import subprocess
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from splashbench.files import read_image

PageOf = Callable[..., str]
DataOf = Callable[[str], dict[str, Any]]
Course = Callable[..., Any]
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


def test_headings_sort_and_what_has_no_figure_comes_last(
    results: Path, browser: str, tmp_path: Path, page_of: PageOf
) -> None:
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


def test_filters_work_together(results: Path, browser: str, tmp_path: Path, page_of: PageOf) -> None:
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


def test_charts_are_drawn_and_their_front_is_the_pareto_front(
    results: Path, browser: str, tmp_path: Path, page_of: PageOf, data_of: DataOf
) -> None:
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
        costs = {label: np.array(point) * sign for label, point in points.items()}
        beaten = {
            label
            for label, cost in costs.items()
            if any((other <= cost).all() and (other < cost).any() for other in costs.values())
        }
        assert set(front) == set(costs) - beaten, choice
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


def test_a_row_opens_its_command_and_record(results: Path, browser: str, tmp_path: Path, page_of: PageOf) -> None:
    found = browse(browser, page_of(results), tmp_path, DETAILS)
    assert found["focused"]
    assert found["shown"]
    assert found["closed"]
    assert (
        "splashbench run fast scenes/bowl OUT --preset best --seed 1 --checkpoints --set iterations=7" in found["text"]
    )
    assert "told: times" in found["text"]
    assert found["stages"] == 4


def test_strangers_names_are_shown_as_text(
    make_result: Any, browser: str, tmp_path: Path, page_of: PageOf, course: Course
) -> None:
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


def test_the_dark_page_is_dark_and_its_picture_is_not_empty(
    results: Path, browser: str, tmp_path: Path, page_of: PageOf
) -> None:
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


def test_the_paper_stands_apart_and_hollow(results: Path, browser: str, tmp_path: Path, page_of: PageOf) -> None:
    script = 'return document.getElementById("paper").data.map(trace => trace.marker.symbol);'
    symbols = browse(browser, page_of(results, with_paper=True), tmp_path, script)
    assert len(symbols) >= 4
    assert all(symbol.endswith("-open") for symbol in symbols)

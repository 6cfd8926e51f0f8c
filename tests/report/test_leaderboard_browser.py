"""The leaderboard's page in a browser: it sorts, filters, draws and opens what it is asked for, without a complaint."""

import json
import shutil
import subprocess
from collections.abc import Callable
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from queue import Empty, Queue
from threading import Thread
from typing import Any

import numpy as np
import pytest

from splashbench.files import read_image
from splashbench.submission import Decision, Rung

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


class Answers(ThreadingHTTPServer):
    """Serves one page, and keeps what its script reports."""

    def __init__(self, page: str) -> None:
        super().__init__(("127.0.0.1", 0), Exchange)
        self.page = page.encode()
        self.reports: Queue[bytes] = Queue()


class Exchange(BaseHTTPRequestHandler):
    server: Answers

    def do_GET(self) -> None:
        self.send_response(200 if self.path == "/" else 404)
        self.send_header("Content-Type", "text/html; charset=utf-8")
        self.end_headers()
        if self.path == "/":
            self.wfile.write(self.server.page)

    def do_POST(self) -> None:
        self.server.reports.put(self.rfile.read(int(self.headers["Content-Length"])))
        self.send_response(204)
        self.end_headers()

    def log_message(self, *_: Any) -> None:
        pass


def browse(browser: str, page: str, folder: Path, script: str, *options: str) -> Any:
    """What `script`, which ends in `return ...`, returns once the page has been drawn.

    The script reports to a server of the test's own, in real time: a browser's virtual time runs out on a busy machine.
    """
    (folder / "page.html").write_text(page, encoding="utf-8")
    after = f"""<script>
const until = async (what, seconds = 60) => {{
  for (let i = 0; i < seconds * 20; i++) {{
    if (what()) return;
    await new Promise(resolve => setTimeout(resolve, 50));
  }}
  throw new Error(`never came: ${{what}}`);
}};
addEventListener("load", async () => {{
  let outcome;
  try {{ outcome = await (async () => {{ {script} }})(); }} catch (error) {{ outcome = {{ error: String(error) }}; }}
  fetch("/", {{ method: "POST", body: JSON.stringify({{ outcome, faults }}) }});
}});
</script>"""
    watched = page.replace("<body>", f"<body>{WATCH}").replace("</body>", f"{after}</body>")
    words = ["--headless=new", "--no-sandbox", "--disable-gpu", f"--user-data-dir={folder / 'profile'}", *options]
    with Answers(watched) as server:
        Thread(target=server.serve_forever, daemon=True).start()
        process = subprocess.Popen(
            [browser, *words, f"http://127.0.0.1:{server.server_port}/"],
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
        )
        try:
            answer = json.loads(server.reports.get(timeout=120))
        except Empty:
            pytest.fail("the browser reported nothing within two minutes")
        finally:
            process.terminate()
            process.wait(30)
            server.shutdown()
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
const count = marks => document.querySelectorAll(marks).length;
await until(() => count("#cost .scatterlayer .point") === 3);
await until(() => count("#anytime .scatterlayer .js-line") >= 3);
choose("anytime-scene", "tank");
await until(() => count("#anytime .scatterlayer .js-line") === 6);
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
        "splashbench run fast scenes/bowl OUT --preset best --seed 1 --device cpu --checkpoints --set iterations=7"
        in found["text"]
    )
    assert "told: times" in found["text"]
    assert found["stages"] == 4


def test_a_run_shows_its_decisions_as_text(make_result: Any, browser: str, tmp_path: Path, page_of: PageOf) -> None:
    hostile = "<img src=x onerror=\"faults.push('ran')\"><b>"
    rungs = [Rung(value=f"{n} steps", bought=n < 2, gain=0.5, reason=hostile) for n in range(3)]
    decisions = [Decision(name=hostile, basis="withheld", chosen="1 steps", because=hostile, rungs=rungs)]
    make_result("alpha", decisions=decisions * 21, psnr=20.0, fit_seconds=9.0).save(tmp_path / "results")
    script = """document.querySelector("#rows tbody button").click();
    const box = document.getElementById("details"), first = box.querySelector(".decision");
    await new Promise(resolve => setTimeout(resolve, 300));
    return { images: document.querySelectorAll("img, b").length, decisions: box.querySelectorAll(".decision").length,
      held: first.querySelector("tr.held").cells[0].textContent, rows: first.querySelectorAll("tr").length,
      last: first.querySelectorAll("tr")[3].cells[2].textContent, more: box.textContent.includes("left out: 1") };"""
    assert browse(browser, page_of(tmp_path / "results"), tmp_path, script) == {
        "images": 0,
        "decisions": 20,
        "held": "1 steps",
        "rows": 4,
        "last": f"refused: {hostile}",
        "more": True,
    }


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


@pytest.mark.slow
def test_the_dark_page_is_dark_and_its_picture_is_not_empty(
    results: Path, browser: str, tmp_path: Path, page_of: PageOf
) -> None:
    script = "return getComputedStyle(document.body).backgroundColor;"
    light = browse(browser, page_of(results), tmp_path, script)
    dark = browse(browser, page_of(results), tmp_path, script, "--blink-settings=preferredColorScheme=0")
    assert light == "rgb(255, 255, 255)"
    assert dark == "rgb(20, 23, 26)"
    shot = tmp_path / "shot.png"
    words = ["--headless=new", "--no-sandbox", "--disable-gpu", "--window-size=1200,1600"]
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

"""What `splashbench leaderboard` costs as results grow in number: seconds, memory, size of the page.

    python benchmarks/leaderboard.py                                # 1,250 to 10,000 results
    python benchmarks/leaderboard.py --counts 100 200 400           # fewer, in seconds
    python benchmarks/leaderboard.py --markdown TABLE.md --json FILE

Results are made, as `splashbench score` writes them: ten methods and the control `nothing` on 20 scenes, as many seeds
as it takes; two test views of 50 frames, twelve checkpoints, a decision; one run in fifty has failed. The command runs
in a process of its own and writes into an empty folder.

    wall seconds        from the start of the process to its end
    processor seconds   of the process; holds on a busy machine, where wall seconds do not
    peak memory         largest resident memory of the process
    page                size of index.html
    growth              slope of log processor seconds over log results: from the row above, and fitted to all rows;
                        1 is linear, 2 is quadratic. The start of Python and its packages makes it smaller.

Exits with 1 where the command fails, or where the fitted growth is above 1.15.
"""

from __future__ import annotations

import argparse
import hashlib
import json
import os
import subprocess
import sys
import tempfile
import time
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np

from splashbench.errors import SplashbenchError
from splashbench.files import write_json, write_text
from splashbench.harness import hardware
from splashbench.score.metrics import METRICS
from splashbench.score.ranges import MEANS_OF_FRAMES, MEANS_OF_VIEWS
from splashbench.score.result import CheckpointScore, Digests, MetricValue, Result, ViewValues, mean, metric_value
from splashbench.score.settings import PROTOCOL_V1
from splashbench.submission.decisions import Decision, Rung

SCENES, METHODS, FRAMES, CHECKPOINTS = 20, 10, 50, 12
VIEWS = ("cam05", "cam06")
CONTROL = "nothing"
FAILED_SHARE = 0.02
#: Fitted growth that is promised at most.
PROMISED = 1.15
# Centre and spread of each figure, so that all lie within their ranges.
_FIGURES = {
    "psnr": (25.0, 2.0), "dpsnr_bg": (6.0, 1.0), "ssim": (0.97, 0.004), "ssim_fg": (0.9, 0.01),
    "lpips": (0.05, 0.005), "spill": (0.3, 0.03), "spill_rgb": (0.8, 0.05), "jitter_error": (0.02, 0.001),
    "sigma_d": (420.0, 20.0), "mu_d": (2600.0, 90.0), "uniformity": (0.2, 0.01), "miou": (0.8, 0.02),
    "fit_seconds": (240.0, 20.0), "render_fps": (9.0, 0.5), "peak_memory_bytes": (2e9, 1e8),
    "storage_bytes": (8e6, 1e5), "dynamic_bytes": (8e6, 1e5), "primitives_per_frame": (25e3, 100.0),
    "particles_per_frame": (4e3, 50.0),
}  # fmt: skip


@dataclass
class Row:
    """A number of results, and what the command took for them."""

    results: int
    results_bytes: int
    wall_seconds: float
    processor_seconds: float
    peak_memory_bytes: int
    page_bytes: int
    growth: float | None = None


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument(
        "--counts", type=int, nargs="+", default=[1250, 2500, 5000, 10000], metavar="N", help="numbers of results"
    )
    parser.add_argument("--markdown", type=Path, metavar="FILE", help="write the table to this file")
    parser.add_argument("--json", type=Path, metavar="FILE", help="write the rows to this file")
    arguments = parser.parse_args()
    if min(arguments.counts) < 1 or len(set(arguments.counts)) < 2:
        parser.error("--counts needs two numbers or more, each 1 or more: growth is between them")
    rows: list[Row] = []
    with tempfile.TemporaryDirectory(ignore_cleanup_errors=True) as folder:
        results, made = Path(folder, "results"), 0
        for count in sorted(set(arguments.counts)):
            for n in range(made, count):
                made_result(n).save(results)
            made = count
            row = measure(results, Path(folder, f"out_{count}"), count)
            row.growth = _growth([rows[-1], row]) if rows else None
            rows.append(row)
            print(f"{count} results: {row.processor_seconds:.1f} processor seconds", file=sys.stderr, flush=True)
    growth = _growth(rows)
    text = table(rows, growth)
    print(text)
    if arguments.markdown:
        write_text(arguments.markdown, text)
    if arguments.json:
        rows_json = [asdict(row) for row in rows]
        write_json(arguments.json, {"machine": hardware.describe(), "growth": growth, "rows": rows_json})
    return 0 if growth <= PROMISED else 1


def made_result(number: int) -> Result:
    """Result `number`, counted from 0: methods change first, then scenes, then seeds."""
    rest, m = divmod(number, METHODS + 1)
    seed, s = divmod(rest, SCENES)
    rng = np.random.default_rng([m, s, seed])
    control = m == METHODS
    method = CONTROL if control else f"method_{m}"
    failed = not control and rng.random() < FAILED_SHARE
    digest = hashlib.sha256(f"{method} {s} {seed}".encode()).hexdigest()
    return Result(
        method=method,
        method_version="3",
        scene=f"scene_{s:03d}",
        seed=seed,
        preset="best",
        settings={f"setting_{i}": (m + 1) * i for i in range(24)},
        told=("times", "container masks", "sparse points"),
        control=control,
        mixed=m % 3 == 1,
        status="crashed" if failed else "ok",
        reason="ValueError: no voxel is inside every mask" if failed else "",
        protocol=PROTOCOL_V1,
        digests=Digests(scene=f"{s:064x}", submission=digest, protocol=PROTOCOL_V1.digest),
        metrics={name: _metric(name, rng, 1 + 0.02 * (m - 5), failed) for name in METRICS},
        checkpoints=() if failed or control else _checkpoints(rng),
        stages={"start": 3.0 + rng.random(), "fit": 220.0 + 20 * rng.random()},
        notes={"background": "median of the training views"},
        decisions=[] if control else [_decision(rng)],
        hardware={"cpu": "AMD EPYC", "cores": 2, "memory_gib": 23.5, "system": "Linux x86_64", "python": "3.11.7"},
        times_source="scene.json",
        versions={"splashbench": "0.2.0", "python": "3.11.7", "numpy": "2.4.6", "torch": "2.13.0+cpu"},
    )


def _metric(name: str, rng: np.random.Generator, level: float, failed: bool) -> MetricValue:
    """A figure with its frames, as scoring stores them; `level` is the method's own."""
    if name not in _FIGURES or failed:
        return metric_value(name, None, "the run crashed" if failed else "the scene has no true particles")
    centre, spread = _FIGURES[name]
    if METRICS[name].unit == "" and centre < 1:  # shares stay below 1
        level = 1 + (level - 1) / 10

    def frames() -> list[float | None]:
        return [float(value) for value in centre * level + spread * rng.uniform(-1, 1, FRAMES)]

    if name in MEANS_OF_VIEWS:
        views = {view: ViewValues(value=mean(values), frames=tuple(values)) for view in VIEWS for values in [frames()]}
        return metric_value(name, mean([view.value for view in views.values()]), views=views)
    values = frames()
    return metric_value(name, mean(values), frames=tuple(values) if name in MEANS_OF_FRAMES else ())


def _checkpoints(rng: np.random.Generator) -> tuple[CheckpointScore, ...]:
    """The image metrics on their way: worse by a fifth at first, nearly the final figures at the end."""
    found = []
    for k in range(CHECKPOINTS):
        far = 0.2 * (1 - k / CHECKPOINTS)
        metrics: dict[str, float | None] = {}
        for name in (*MEANS_OF_VIEWS, "jitter_error"):
            centre, spread = _FIGURES[name]
            worse = 1 - far if METRICS[name].better == "higher" else 1 + far
            metrics[name] = float(centre * worse + spread * rng.uniform(-0.1, 0.1))
        found.append(CheckpointScore(seconds=5 * 2 ** (k / 2) + rng.random(), storage_bytes=6_442_254, metrics=metrics))
    return tuple(found)


def _decision(rng: np.random.Generator) -> Decision:
    rungs = [
        Rung(value=f"{points} points", bought=points < 32000, quality=22 + rng.random(), gain=0.3, standard_error=0.1)
        for points in (2000, 8000, 32000)
    ]
    because = "32000 points gain less than .1 dB"
    return Decision(name="points", basis="withheld", chosen="8000 points", because=because, measure="dB", rungs=rungs)


def measure(results: Path, out: Path, count: int) -> Row:
    """Run `splashbench leaderboard RESULTS OUT` on `count` results. Raises SplashbenchError where it fails."""
    command = [sys.executable, "-m", "splashbench", "leaderboard", str(results), str(out), "--json"]
    with tempfile.TemporaryFile() as told, tempfile.TemporaryFile() as said:
        begin = time.monotonic()
        process = subprocess.Popen(command, stdout=told, stderr=said)
        _, status, usage = os.wait4(process.pid, 0)
        wall = time.monotonic() - begin
        process.returncode = os.waitstatus_to_exitcode(status)
        told.seek(0)
        said.seek(0)
        if process.returncode != 0:
            raise SplashbenchError(f"splashbench leaderboard failed: {said.read().decode(errors='replace')[-500:]}")
        summary = json.load(told)
    if summary["results"] != count or summary["left_out"]:
        raise SplashbenchError(f"{summary['results']} of {count} results were used, for {summary['left_out'][:1]}")
    return Row(
        results=count,
        results_bytes=sum(path.stat().st_size for path in results.iterdir()),
        wall_seconds=wall,
        processor_seconds=usage.ru_utime + usage.ru_stime,
        peak_memory_bytes=usage.ru_maxrss * 1024,  # KiB on Linux
        page_bytes=(out / "index.html").stat().st_size,
    )


def _growth(rows: list[Row]) -> float:
    """Slope of log processor seconds over log results, by least squares."""
    counts, seconds = zip(*((row.results, row.processor_seconds) for row in rows))
    return float(np.polyfit(np.log(counts), np.log(seconds), 1)[0])


def table(rows: list[Row], growth: float) -> str:
    lines = [
        "| results | in MB | wall, s | processor, s | peak memory, MB | page, MB | growth |",
        "|---|---|---|---|---|---|---|",
    ]
    for row in rows:
        cells: list[Any] = [row.results, f"{row.results_bytes / 1e6:.0f}"]
        cells += [f"{row.wall_seconds:.1f}", f"{row.processor_seconds:.1f}"]
        cells += [f"{row.peak_memory_bytes / 1e6:.0f}", f"{row.page_bytes / 1e6:.1f}"]
        cells += ["" if row.growth is None else f"{row.growth:.2f}"]
        lines.append(f"| {' | '.join(map(str, cells))} |")
    return "\n".join([*lines, "", f"Growth, fitted to all rows: {growth:.2f}."]) + "\n"


if __name__ == "__main__":
    sys.exit(main())

"""What a run of a study costs beyond its method: many runs of a method that does nothing, here and on Ray.

    python benchmarks/jobs.py                                 # 1,000 runs, two at once, here
    python benchmarks/jobs.py --jobs 100 --places here ray    # on Ray too (with the extra cluster)
    python benchmarks/jobs.py --markdown TABLE.md --json FILE

The scene is the smallest there is: balls in front of seven cameras, two frames, 24x16 pixels. The method has one grey
for every view. A run is the whole thing: its copy of the scene, two processes of the method, scoring, the result.

    seconds a run       of the wall clock, from the first run's start to the last one's end, over the number of runs
    processor seconds   of all processes, over the number of runs; holds on a busy machine, where the first does not
    start               seconds until the first run starts: Ray, the check of machines, the import of what runs need

Exits with 1 where a run fails, or where the processor seconds of a run are above one second for each core.
"""

from __future__ import annotations

import argparse
import contextlib
import os
import sys
import tempfile
import threading
import time
import uuid
from dataclasses import asdict, dataclass
from pathlib import Path

import psutil

from splashbench import toml
from splashbench.files import write_json, write_text
from splashbench.processes import marked_processes
from splashbench.study.execution import ExecutionOptions, carry_out_plan
from splashbench.study.job import Store
from splashbench.study.plan import make_plan
from splashbench.study.spec import load_spec
from splashbench.synth.balls import write_balls_scene

_MARK = "SPLASHBENCH_BENCHMARK"
#: Seconds a run that are promised.
PROMISED = 1.0

METHOD = """
import numpy as np
from typing import ClassVar
from splashbench.harness.contract import Fitted, Method, MethodConfig, Render


class Settings(MethodConfig):
    presets: ClassVar[dict] = {"best": {}}


class Nothing(Method):
    id, title, version, Config = "no_op", "one grey", "1", Settings

    def fit(self, scene, config, run):
        return Grey()

    def load(self, directory, scene):
        return Grey()


class Grey(Fitted):
    def render(self, camera, time):
        size = (camera.height, camera.width)
        return Render(np.full((*size, 3), 0.5, np.float32), np.ones(size, np.float32))

    def particles(self):
        return None

    def save(self, directory):
        (directory / "grey").write_text("0.5")
"""


@dataclass
class Row:
    """A place, and what runs cost there."""

    place: str
    runs: int
    at_once: int
    seconds_a_run: float
    processor_seconds_a_run: float
    start_seconds: float
    failed: int


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--jobs", type=int, default=1000, help="number of runs (default: 1000)")
    parser.add_argument("--at-once", type=int, default=2, help="runs at the same time (default: 2)")
    parser.add_argument("--places", nargs="+", choices=["here", "ray"], default=["here"], help="where (default: here)")
    parser.add_argument("--markdown", type=Path, help="write the table to this file")
    parser.add_argument("--json", type=Path, help="write the rows to this file")
    arguments = parser.parse_args()
    os.environ.setdefault("OMP_NUM_THREADS", "1")
    rows = [measure(place, arguments.jobs, arguments.at_once) for place in arguments.places]
    text = table(rows)
    print(text)
    if arguments.markdown:
        write_text(arguments.markdown, text)
    if arguments.json:
        write_json(arguments.json, [asdict(row) for row in rows])
    good = all(row.failed == 0 and row.processor_seconds_a_run <= PROMISED * row.at_once for row in rows)
    return 0 if good else 1


def measure(place: str, runs: int, at_once: int) -> Row:
    """Make `runs` runs in a folder that is gone afterwards."""
    with tempfile.TemporaryDirectory(ignore_cleanup_errors=True) as folder:
        plan = make_plan(load_spec(_spec(Path(folder), runs)))
        starts: list[float] = []

        def tell(line: str) -> None:
            if line.startswith("run "):
                starts.append(time.monotonic())
                if len(starts) % 100 == 0:
                    print(f"{place}: {len(starts)} of {runs}", file=sys.stderr, flush=True)

        options = ExecutionOptions(jobs=at_once, on=None if place == "here" else "ray", tell=tell)
        watch = _ProcessorTime()
        watch.start()
        begin = time.monotonic()
        carry_out_plan(plan, Path(folder, "out"), options)
        end = time.monotonic()
        processor = watch.stop()
        store = Store(Path(folder, "out"))
        entries = [store.entry(run.digest) for run in plan.runs]
        failed = sum(entry is None or entry.status != "ok" for entry in entries)
        seconds = [end - starts[0], starts[0] - begin]
        return Row(place, runs, at_once, seconds[0] / runs, processor / runs, seconds[1], failed)


class _ProcessorTime(threading.Thread):
    """Processor seconds of all processes that have a mark in their environment, and of what they have waited for.

    They are looked at every second, since most are gone in the end: workers, which have waited for every run, and
    Ray's own.
    """

    def __init__(self) -> None:
        super().__init__(daemon=True)
        self._mark, self._ended = uuid.uuid4().hex, threading.Event()
        os.environ[_MARK] = self._mark
        self._own = psutil.Process()
        self._before, self._most = _of(self._own), 0.0

    def run(self) -> None:
        while not self._ended.wait(1.0):
            total = _of(self._own)
            for process in marked_processes(_MARK, self._mark):
                with contextlib.suppress(psutil.Error):
                    total += _of(process)
            self._most = max(self._most, total)

    def stop(self) -> float:
        """Processor seconds since this was made."""
        self._ended.set()
        self.join()
        return self._most - self._before


def _of(process: psutil.Process) -> float:
    times = process.cpu_times()
    return float(times.user + times.system + times.children_user + times.children_system)


def _spec(folder: Path, runs: int) -> str:
    (folder / "no_op.py").write_text(METHOD, encoding="utf-8")
    write_balls_scene(folder / "balls", n_frames=2, size=(24, 16))
    spec = {
        "name": "no_op",
        "method": f"{folder / 'no_op.py'}:Nothing",
        "seeds": list(range(runs)),
        "scenes": [str(folder / "balls")],
        "metrics": ["psnr"],
        "baseline": "full",
        "reference": False,
        "variants": [{"name": "full"}],
    }
    (folder / "study.toml").write_text(toml.dumps(spec), encoding="utf-8")
    return str(folder / "study.toml")


def table(rows: list[Row]) -> str:
    lines = [
        "| where | runs | at once | seconds a run | processor seconds a run | start, s | failed |",
        "|---|---|---|---|---|---|---|",
    ]
    for row in rows:
        lines.append(
            f"| {row.place} | {row.runs} | {row.at_once} | {row.seconds_a_run:.2f} | "
            f"{row.processor_seconds_a_run:.2f} | {row.start_seconds:.1f} | {row.failed} |"
        )
    return "\n".join(lines) + "\n"


if __name__ == "__main__":
    sys.exit(main())

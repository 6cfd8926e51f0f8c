"""Read many damaged and hostile files, and tell of every traceback, hang and gigabyte.

    python benchmarks/fuzz.py --count 1000                    # of each kind
    python benchmarks/fuzz.py --count 100000 --kinds toml json npz
    python benchmarks/fuzz.py --kinds npz --case 1234         # one case again

Batches run in child processes with limits of memory and, for each case, of time. The exit status is 1 where anything
was found. fuzz_cases.py makes the cases; tests/fuzz/ runs a few of each kind.
"""

from __future__ import annotations

import argparse
import json
import os
import resource
import signal
import subprocess
import sys
import tempfile
import time
import traceback
from pathlib import Path

import fuzz_cases

from splashbench.prepare.media.reading import end_children

MAX_SECONDS, MAX_MEMORY_BYTES = 60, 6 << 30
_BATCH = {"mesh": 1000, "media": 500, "submission": 200, "scene": 200}
_LARGE_BATCH = 5000


def batch(kind: str, start: int, stop: int, progress: Path) -> int:
    """Carry out cases in this process; prints one JSON object. progress: a file that names the case under way."""
    findings, slowest = [], 0.0
    with tempfile.TemporaryDirectory() as folder:
        corpus = fuzz_cases.Corpus(Path(folder))
        fuzz_cases.outcome(kind, start, corpus)  # imports and compilation are not the case's time
        resource.setrlimit(resource.RLIMIT_AS, (MAX_MEMORY_BYTES, MAX_MEMORY_BYTES))
        for number in range(start, stop):
            progress.write_text(str(number))
            signal.alarm(MAX_SECONDS)
            began = time.perf_counter()
            try:
                fault = fuzz_cases.outcome(kind, number, corpus)
            except BaseException:
                fault = traceback.format_exc(limit=-6)
            slowest = max(slowest, time.perf_counter() - began)
            if fault:
                findings.append([number, fault])
        signal.alarm(0)
    end_children()
    peak = max(resource.getrusage(who).ru_maxrss for who in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN)) * 1024
    print(json.dumps({"findings": findings, "slowest_seconds": slowest, "peak_bytes": peak}))
    return 0


def run(kind: str, count: int, first: int, until: float) -> dict:
    """Cases `first` to `first + count` of `kind`, as far as the time goes: what was found, and the worst figures."""
    total = {"cases": 0, "slowest_seconds": 0.0, "peak_bytes": 0, "findings": []}
    start, stop = first, first + count
    while start < stop and time.time() < until:
        end = min(stop, start + _BATCH.get(kind, _LARGE_BATCH))
        with tempfile.TemporaryDirectory() as folder:
            progress = Path(folder, "case")
            command = [sys.executable, __file__, "--batch", kind, str(start), str(end), str(progress)]
            done = subprocess.run(
                command, capture_output=True, text=True, env=os.environ | {"OPENBLAS_NUM_THREADS": "1"}
            )
            if done.returncode == 0:
                told = json.loads(done.stdout.splitlines()[-1])
                total["findings"] += told["findings"]
                for name in ("slowest_seconds", "peak_bytes"):
                    total[name] = max(total[name], told[name])
            else:  # it was ended: by the alarm, or for want of memory
                at = int(progress.read_text()) if progress.exists() else start
                total["findings"].append([at, f"ended with {done.returncode}: {done.stderr[-1000:]}"])
                end = at + 1
        total["cases"] += end - start
        start = end
    return total


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--kinds", nargs="+", choices=[*fuzz_cases.CASES], default=[*fuzz_cases.CASES])
    parser.add_argument("--count", type=int, default=1000, help="cases of each kind")
    parser.add_argument("--first", type=int, default=0, help="number of the first case")
    parser.add_argument("--minutes", type=float, default=1e6, help="stop after so long")
    parser.add_argument("--case", type=int, help="this case alone")
    parser.add_argument("--json", type=Path, help="write the figures into this file")
    parser.add_argument("--batch", nargs=4, help=argparse.SUPPRESS)
    arguments = parser.parse_args()
    if arguments.batch:
        kind, start, stop, progress = arguments.batch
        return batch(kind, int(start), int(stop), Path(progress))
    first, count = (arguments.first, arguments.count) if arguments.case is None else (arguments.case, 1)
    until, totals = time.time() + 60 * arguments.minutes, {}
    for kind in arguments.kinds:
        began = time.time()
        total = totals[kind] = run(kind, count, first, until)
        print(
            f"{kind:10} {total['cases']:7} cases in {time.time() - began:.0f} s, "
            f"slowest {total['slowest_seconds']:.2f} s, peak {total['peak_bytes'] >> 20} MiB, "
            f"{len(total['findings'])} findings",
            flush=True,
        )
        for number, fault in total["findings"][:20]:
            print(f"  case {number}: {fault}", flush=True)
        if arguments.json:
            arguments.json.write_text(json.dumps(totals, indent=1) + "\n")
    return 1 if any(total["findings"] for total in totals.values()) else 0


if __name__ == "__main__":
    sys.exit(main())

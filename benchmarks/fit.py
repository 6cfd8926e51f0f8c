"""How long a method takes from scene to finished submission, by stage, and how much memory it holds.

    python benchmarks/fit.py SCENE... [--method ID] [--presets best paper] [--set KEY=VALUE] [--json FILE]
    python benchmarks/fit.py scenes/opaque_bowl --presets best quick --json fit.json

whole      wall time of the command `splashbench run`: starting, fitting, rendering the test views, writing
fit        wall time of the fit, what the leaderboard calls fit_seconds
stages     parts of the fit, as the method tells them; some may run at the same time, and some lies between them
peak       largest resident memory of the process tree, GiB

Runs follow one another; other load on the machine is in every time, and the load average at each run's start is noted.
With --iterations-of N the fit is stopped early, at N iterations, and the appearance's time is extrapolated to the
preset's own number: the table says so.
"""

from __future__ import annotations

import argparse
import os
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

from splashbench.errors import SplashbenchError
from splashbench.files import write_json, write_text
from splashbench.harness import hardware
from splashbench.harness.discovery import load_method
from splashbench.harness.runner import parse_overrides, run_method
from splashbench.scene import Scene


def measure(
    method: str, scene: Path, preset: str, overrides: dict[str, Any], iterations: int | None, seed: int
) -> dict[str, Any]:
    """One run, with its figures; raises SplashbenchError where it fails."""
    full = load_method(method).Config.preset(preset, overrides)
    shortened = dict(overrides)
    if iterations is not None:
        shortened["iterations"] = iterations
    load = os.getloadavg()[0]
    with tempfile.TemporaryDirectory(prefix="splashbench-") as scratch:
        start = time.perf_counter()
        submission = run_method(
            method, scene, Path(scratch, "run"), preset=preset, overrides=shortened, timing_frames=0, seed=seed
        )
        whole = time.perf_counter() - start
    record = submission.record
    if record.status.value != "ok":
        raise SplashbenchError(f"{method} on {scene}: {record.status.value}: {record.reason}")
    stages = dict(record.stages)
    added = 0.0
    if iterations is not None:
        added = stages.get("appearance", 0.0) * (full.iterations / iterations - 1)
        stages["appearance"] = stages.get("appearance", 0.0) + added
    opened = Scene.open(scene)
    camera = opened.cameras[opened.train[0]]
    return {
        "scene": scene.resolve().name,
        "size": f"{camera.width}x{camera.height}",
        "frames": opened.n_frames,
        "preset": preset,
        "settings": overrides,
        "iterations_run": iterations,
        "whole_seconds": whole + added,
        "fit_seconds": (record.fit_seconds or 0.0) + added,
        "stages": stages,
        "peak_memory_bytes": record.peak_memory_bytes,
        "storage_bytes": record.storage_bytes,
        "particles_per_frame": record.particles_per_frame,
        "load_average": load,
    }


def table(results: list[dict[str, Any]]) -> str:
    """Markdown: a row per run."""
    names = list(dict.fromkeys(name for result in results for name in result["stages"]))
    head = ["scene", "size", "frames", "preset", "whole s", "fit s", *[f"{n} s" for n in names], "peak GiB", "load"]
    lines = ["| " + " | ".join(head) + " |", "|---" * len(head) + "|"]
    for result in results:
        stages = [f"{result['stages'][name]:.0f}" if name in result["stages"] else "–" for name in names]
        preset = result["preset"] + ("" if result["iterations_run"] is None else " (extrapolated)")
        peak = result["peak_memory_bytes"]
        cells = [result["scene"], result["size"], str(result["frames"]), preset]
        cells += [f"{result['whole_seconds']:.0f}", f"{result['fit_seconds']:.0f}", *stages]
        cells += ["–" if peak is None else f"{peak / 2**30:.2f}", f"{result['load_average']:.1f}"]
        lines.append("| " + " | ".join(cells) + " |")
    return "\n".join(lines) + "\n"


def main() -> int:
    """Print the table, and write the files asked for."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("scenes", type=Path, nargs="+", metavar="SCENE", help="folders of scenes")
    parser.add_argument("--method", default="splashsplat", metavar="ID")
    parser.add_argument("--presets", nargs="+", default=["best"], metavar="NAME", help="of the method (default: best)")
    parser.add_argument("--set", action="append", default=[], metavar="KEY=VALUE", help="a setting over the preset's")
    parser.add_argument("--iterations-of", type=int, metavar="N", help="stop the appearance at N and extrapolate")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--json", type=Path, metavar="FILE", help="write every figure here")
    parser.add_argument("--markdown", type=Path, metavar="FILE", help="write the table here")
    options = parser.parse_args()
    if options.iterations_of is not None and options.iterations_of < 1:
        parser.error("--iterations-of must be at least 1")
    for path in (options.json, options.markdown):
        if path is not None and not path.resolve().parent.is_dir():
            parser.error(f"{path}: there is no such folder")
    results: list[dict[str, Any]] = []
    try:
        overrides = parse_overrides(options.set)
        for scene in options.scenes:
            for preset in options.presets:
                found = measure(options.method, scene, preset, overrides, options.iterations_of, options.seed)
                results.append(found)
                # After every run: what is measured is kept when somebody loses patience.
                if options.json is not None:
                    write_json(options.json, {"machine": hardware.describe(), "results": results})
                if options.markdown is not None:
                    write_text(options.markdown, table(results))
    except SplashbenchError as error:
        print(f"error: {error}", file=sys.stderr)
        return 1
    print(table(results))
    return 0


if __name__ == "__main__":
    sys.exit(main())

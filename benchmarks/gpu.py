"""The renderer's CUDA backend on a machine that has a GPU: its tests, its images and its speed beside the CPU's.

    python benchmarks/gpu.py [--json FILE] [--repeats N]

One command for everything that a machine without a GPU cannot show. It runs the tests marked cuda, then renders scenes
iii, i and ii of render_scenes.py with both backends in turn. Without a GPU, or without gsplat 1.5.3, it says so in one
line and exits 1. It also exits 1, after the table, where a test failed or an image differs by more than 1e-3.

The JSON has `tests` (passed, summary), what it ran on, and per scene

cpu, cuda           forward_ms and backward_ms, medians over the rounds. A time includes the wait for the device, and no
                    copies: CPU tensors stay on the CPU, CUDA tensors on the device.
speedup             CPU time over CUDA time, both passes; median over the rounds.
image_difference    the largest one, of color and opacity, over the pixels where rounding does not decide what is drawn.
smooth_share        the share of these pixels.
"""

from __future__ import annotations

import argparse
import re
import statistics
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path
from types import ModuleType
from typing import Any

import render_scenes  # beside this file
import torch

from splashbench.files import write_json
from splashbench.harness import hardware
from splashbench.parallel import thread_count
from splashbench.render import cuda, native, rasterize

ROOT = Path(__file__).resolve().parents[1]
TOLERANCE = 1e-3
WARM_UP = 2


def run_tests() -> dict[str, Any]:
    """Whether the tests marked cuda pass, the renderer's and the methods', and pytest's last line."""
    command = [sys.executable, "-m", "pytest", "-q", "-m", "cuda", "tests/render", "tests/methods"]
    outcome = subprocess.run(command, cwd=ROOT, capture_output=True, text=True)
    lines = outcome.stdout.strip().splitlines() or [outcome.stderr.strip()[-300:]]
    # Status 0 says that none failed; tests that were skipped are not passed.
    passed = outcome.returncode == 0 and " passed" in lines[-1] and not re.search(r"\d skipped", lines[-1])
    if not passed:
        print(outcome.stdout, outcome.stderr, sep="\n", file=sys.stderr)
    return {"passed": passed, "summary": lines[-1]}


def timed_pass(scene: Any, background: torch.Tensor, backend: str, device: str) -> Callable[[], tuple[float, float]]:
    """A function that renders and differentiates once, and returns the milliseconds of either pass."""
    inputs = [tensor.to(device, copy=True).requires_grad_() for tensor in scene.gaussians]
    behind, size = background.to(device), (scene.camera.height, scene.camera.width)
    generator = torch.Generator().manual_seed(1)
    outer = [torch.randn(shape, generator=generator).to(device) for shape in ((*size, 3), size)]

    def now() -> float:
        if device != "cpu":
            torch.cuda.synchronize()
        return 1e3 * time.perf_counter()

    def run() -> tuple[float, float]:
        start = now()
        images = rasterize(*inputs, scene.camera, background=behind, backend=backend)
        middle = now()
        torch.autograd.grad(images, inputs, outer)
        return middle - start, now() - middle

    return run


def image_difference(scene: Any, background: torch.Tensor, reference: ModuleType) -> tuple[float, float]:
    """(the largest difference of color and opacity at smooth pixels, the share of these)."""
    smooth = ~reference.threshold_pixels(*scene.gaussians[:3], scene.camera)
    on_cpu = rasterize(*scene.gaussians, scene.camera, background=background, backend="cpu")
    moved = [tensor.to(cuda.DEVICE) for tensor in scene.gaussians]
    on_device = rasterize(*moved, scene.camera, background=background, backend="cuda")
    largest = max(float((ours.cpu() - theirs)[smooth].abs().max()) for ours, theirs in zip(on_device, on_cpu))
    return largest, float(smooth.float().mean())


def measure(scene: Any, background: torch.Tensor, repeats: int, reference: ModuleType) -> dict[str, Any]:
    """The figures of one scene; the backends take turns."""
    passes = {
        "cpu": timed_pass(scene, background, "cpu", "cpu"),
        "cuda": timed_pass(scene, background, "cuda", cuda.DEVICE),
    }
    times: dict[str, list[tuple[float, float]]] = {name: [] for name in passes}
    for turn in range(WARM_UP + repeats):
        for name, run in passes.items():
            elapsed = run()
            if turn >= WARM_UP:
                times[name].append(elapsed)
    figures: dict[str, Any] = {
        name: {
            "forward_ms": round(statistics.median(forward for forward, _ in rounds), 3),
            "backward_ms": round(statistics.median(backward for _, backward in rounds), 3),
        }
        for name, rounds in times.items()
    }
    figures["speedup"] = statistics.median(sum(a) / sum(b) for a, b in zip(times["cpu"], times["cuda"]))
    figures["image_difference"], figures["smooth_share"] = image_difference(scene, background, reference)
    return figures


def print_table(results: dict[str, Any]) -> None:
    """What it ran on, the tests' last line, and a row per scene."""
    versions = results["versions"]
    print(f"{results['gpu']}; gsplat {versions['gsplat']}, PyTorch {versions['torch']}, CUDA {versions['cuda']}")
    machine = results["machine"]
    print(f"{machine['cpu']}, {results['threads']} threads, kernel {results['kernel']}; {results['repeats']} rounds")
    print(f"tests: {results['tests']['summary']}\n")
    print(f"{'':6}{'CPU ms':>18}{'CUDA ms':>18}{'CPU/CUDA':>10}{'largest':>12}{'smooth':>9}")
    print(f"{'scene':6}{'forward backward':>18}{'forward backward':>18}{'both':>10}{'difference':>12}{'pixels':>9}")
    for name, figures in results["scenes"].items():
        columns = "".join(
            f"{figures[backend]['forward_ms']:>9.2f}{figures[backend]['backward_ms']:>9.2f}"
            for backend in ("cpu", "cuda")
        )
        difference, smooth = figures["image_difference"], figures["smooth_share"]
        print(f"{name:6}{columns}{figures['speedup']:>10.1f}{difference:>12.1e}{smooth:>9.1%}")


def main() -> int:
    """Run the tests and the measurements, print the table, and write the JSON where asked to."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--json", type=Path, metavar="FILE", help="write the figures here, too")
    parser.add_argument("--repeats", type=int, default=15, metavar="N", help="rounds that count (default 15)")
    options = parser.parse_args()
    if options.repeats < 1:
        parser.error("--repeats must be at least 1")
    reason = cuda.available()
    if reason is not None:
        print(f"error: nothing was measured: {reason}", file=sys.stderr)
        return 1
    reference = render_scenes.reference()
    results: dict[str, Any] = {
        "gpu": torch.cuda.get_device_name(),
        "versions": {"gsplat": cuda.GSPLAT_VERSION, "torch": torch.__version__, "cuda": torch.version.cuda},
        "machine": hardware.describe(),
        "threads": thread_count(),
        "kernel": native.KERNEL.variant,
        "repeats": options.repeats,
        "tests": run_tests(),
        "scenes": {
            name: measure(render_scenes.make_scene(*size), render_scenes.BACKGROUND, options.repeats, reference)
            for name, size in render_scenes.SCENES.items()
        },
    }
    print_table(results)
    if options.json is not None:
        write_json(options.json, results)
    close = all(figures["image_difference"] <= TOLERANCE for figures in results["scenes"].values())
    return 0 if close and results["tests"]["passed"] else 1


if __name__ == "__main__":
    sys.exit(main())

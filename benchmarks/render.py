"""How fast the renderer is, and how exact: the figures that it promises, measured side by side in one run.

    python benchmarks/render.py [--prototype DIR] [--json FILE] [--repeats N] [--quick]

A time is that of one forward and backward pass through torch's autograd, on two threads and for fixed random gradients
of both images. What is compared takes turns (A B A B ...), after two rounds that do not count. Each round gives a ratio
of A's time over B's, and their median counts: a slow spell of a shared machine hits both. The JSON has

prototype_ratio     ours / the C++ prototype in DIR, which is compiled here and now, on scenes iii, i and ii. The
                    prototype takes covariances, made outside the clock.
torch_ratio         the plain torch renderer in DIR (ref_torch.py, vectorised over groups of tiles) / ours on scene i,
                    float32. It runs once on one torch thread and once on two; the faster run counts.
torch_ratio_reference  the same for tests/render/reference.py, which is the faster of the two.
thread_scaling      one thread / two threads, scene i.
mask_speedup        all tiles / those that a centered disc of 20% of the pixels touches, the others skipped. The scene:
                    85 000 Gaussians all over 1200x1800. The table also has it for compact output.
frozen_ratio        scene ii before, in and behind a frozen background (those 85 000 Gaussians, with which it
                    interleaves in depth) / all 170 000 with gradients. `frozen_identical` says whether the images are
                    the same bit for bit.
gradient_error      the largest relative L2 error among the gradients of means, factors, opacities and colors on scenes
                    iii and i, against the reference in float64. The loss reads no pixel where rounding may decide what
                    is drawn (`threshold_pixels` there).
exponent_gaussians  slope of log time over log N for N = 5000 to 160 000 at 640x416. Gaussians shrink as N grows: about
                    25 always contribute to a covered pixel.
exponent_pixels     slope of log time over log pixels: scene iii unchanged, in images from 240x160 to 1920x1280.

(slopes by least squares through the medians), and beside them `medians_ms`, `machine`, `kernel`, `repeats`, `missing`
(what was not measured, and why).
"""

from __future__ import annotations

import argparse
import math
import shutil
import statistics
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
import torch
from render_scenes import (  # beside this file
    BACKGROUND,
    SCENES,
    THREADS,
    GaussianTensors,
    Pass,
    crop_scene,
    image_gradients,
    leaves,
    load_module,
    make_scene,
    our_pass,
    ratio,
    reference,
    take_turns,
)

from splashbench.files import write_json
from splashbench.harness import hardware
from splashbench.render import freeze, native, rasterize, tile_modes, to_tiles

MASKED = 0.2
COUNTS = (5_000, 10_000, 20_000, 40_000, 80_000, 160_000)
SCALES = (1, 2, 4, 8)

# The prototype's build line, as its README has it.
COMPILE = [
    "g++", "-O3", "-std=c++17", "-fno-math-errno", "-fno-trapping-math", "-freciprocal-math", "-fno-signed-zeros",
    "-ffp-contract=fast", "-march=native", "-shared", "-fPIC", "-pthread", "-DVW=8", "-DAABB", "-DTW=64", "-DTH=32",
]  # fmt: skip

TARGETS = {
    "prototype_ratio iii": "<= 1.15",
    "prototype_ratio i": "<= 1.15",
    "prototype_ratio ii": "<= 1.15",
    "torch_ratio": ">= 300",
    "thread_scaling": ">= 1.7",
    "mask_speedup": ">= 3.5",
    "frozen_ratio": "<= 0.6",
    "gradient_error": "<= 2e-5",
    "exponent_gaussians": "<= 1.1",
    "exponent_pixels": "<= 1.1",
}


class Benchmark:
    """Measures one figure per method; `medians_ms` collects the medians behind them."""

    def __init__(self, repeats: int, quick: bool, prototype: Path | None) -> None:
        self.repeats, self.quick, self.prototype = repeats, quick, prototype
        self.medians_ms: dict[str, float] = {}
        self.missing: dict[str, str] = {}

    def times(self, group: str, passes: dict[Any, Pass]) -> dict[Any, list[float]]:
        """`take_turns`, whose medians are kept as "<group> <name>"."""
        times = take_turns(passes, self.repeats)
        self.medians_ms |= {f"{group} {name}": round(statistics.median(t), 3) for name, t in times.items()}
        return times

    def prototype_ratio(self) -> dict[str, float | None]:
        """Scene -> our time over the prototype's; None where there is no prototype."""
        nothing: dict[str, float | None] = dict.fromkeys(SCENES)
        if self.prototype is None:
            self.missing["prototype_ratio"] = "--prototype DIR was not given"
            return nothing
        if shutil.which("g++") is None:
            self.missing["prototype_ratio"] = "no g++ on PATH to compile the prototype with"
            return nothing
        with tempfile.TemporaryDirectory() as folder:
            library = Path(folder) / "libprototype.so"
            outcome = subprocess.run(
                [*COMPILE, str(self.prototype / "rast_port.cpp"), "-o", str(library)], capture_output=True, text=True
            )
            if outcome.returncode:
                self.missing["prototype_ratio"] = f"the prototype did not compile: {outcome.stderr.strip()[-300:]}"
                return nothing
            module = load_module(self.prototype / "cpp_backend.py")
            loaded = module.Lib(str(library.resolve()))
            return {name: self._against(module, loaded, name) for name in SCENES}

    def _against(self, module: ModuleType, library: Any, name: str) -> float:
        scene = make_scene(*SCENES[name])
        camera, outer = scene.camera, image_gradients(scene.camera)
        factors = scene.gaussians.factors
        covariances = factors @ factors.transpose(1, 2)
        inputs = leaves(scene.gaussians._replace(factors=covariances))
        w2c, K = (torch.tensor(matrix, dtype=torch.float32) for matrix in (camera.w2c, camera.K))

        def prototype() -> tuple[torch.Tensor, ...]:
            images = module.render(library, *inputs, w2c, K, camera.width, camera.height, bg=BACKGROUND, nthr=THREADS)
            return torch.autograd.grad(images, inputs, outer)

        ours = our_pass(scene.gaussians, camera, outer)
        self._check_same_colors(name, ours()[3], prototype()[3])
        times = self.times(f"scene {name}", {"ours": ours, "prototype": prototype})
        return ratio(times["ours"], times["prototype"])

    @staticmethod
    def _check_same_colors(name: str, ours: torch.Tensor, theirs: torch.Tensor) -> None:
        """A comparison of speeds means something only where the work is the same."""
        difference = float((ours - theirs).norm() / theirs.norm())
        if difference > 1e-2:
            raise RuntimeError(f"scene {name}: the prototype's gradient of colors is {difference:.1e} away from ours")

    def torch_ratio(self) -> dict[str, float | None]:
        """Plain torch over ours: that of the prototype's folder, and the tests' reference."""
        scene = make_scene(*SCENES["i"])
        camera, gaussians, outer = scene.camera, scene.gaussians, image_gradients(scene.camera)
        inputs = leaves(gaussians)
        ours = our_pass(gaussians, camera, outer)
        definition = reference().rasterize
        plain: dict[str, Pass] = {
            "reference": lambda: torch.autograd.grad(definition(*inputs, camera, background=BACKGROUND), inputs, outer)
        }
        module = None if self.prototype is None else self.prototype / "ref_torch.py"
        if module is None or not module.is_file():
            self.missing["torch_ratio"] = "no ref_torch.py in --prototype DIR; torch_ratio_reference is measured"
        else:
            render = load_module(module).render
            w2c, K = (torch.tensor(matrix, dtype=torch.float32) for matrix in (camera.w2c, camera.K))

            def of_prototype() -> tuple[torch.Tensor, ...]:
                covariances = inputs.factors @ inputs.factors.transpose(1, 2)
                arguments = inputs._replace(factors=covariances)
                images = render(*arguments, w2c, K, camera.width, camera.height, BACKGROUND)
                return torch.autograd.grad(images, inputs, outer)

            plain["prototype"] = of_prototype
        ratios: dict[str, float | None] = {"prototype": None}
        for name, one_pass in plain.items():
            slow, fast = [], []
            before = torch.get_num_threads()
            for threads in (1, THREADS):
                torch.set_num_threads(threads)
                start = time.perf_counter()
                one_pass()
                slow.append(1e3 * (time.perf_counter() - start))
                torch.set_num_threads(before)
                fast += take_turns({"ours": ours}, self.repeats)["ours"]
            self.medians_ms |= {
                f"plain torch ({name})": round(min(slow), 3),
                f"plain torch ({name}), ours": round(statistics.median(fast), 3),
            }
            ratios[name] = min(slow) / statistics.median(fast)
        return ratios

    def thread_scaling(self) -> float:
        """One thread over two."""
        scene = make_scene(*SCENES["i"])
        passes: dict[Any, Pass] = {count: our_pass(scene.gaussians, scene.camera, threads=count) for count in (1, 2)}
        times = self.times("scene i, threads", passes)
        return ratio(times[1], times[2])

    def mask_speedup(self) -> dict[str, float]:
        """All tiles over those of the mask, for images and for compact output."""
        scene = crop_scene()
        width, height = scene.camera.width, scene.camera.height
        rows, columns = np.mgrid[:height, :width] + 0.5
        disc = (columns - width / 2) ** 2 + (rows - height / 2) ** 2 <= MASKED * width * height / math.pi
        modes = tile_modes(disc)
        outer = image_gradients(scene.camera)
        tiled = [torch.from_numpy(to_tiles(image.numpy(), modes)) for image in outer]
        passes = {
            "all tiles": our_pass(scene.gaussians, scene.camera, outer),
            "masked": our_pass(scene.gaussians, scene.camera, outer, modes=modes),
            "masked, compact": our_pass(scene.gaussians, scene.camera, tiled, modes=modes, compact=True),
        }
        times = self.times("crop", passes)
        return {name: ratio(times["all tiles"], times[name]) for name in ("masked", "masked, compact")}

    def frozen(self) -> tuple[float, bool]:
        """(frozen background over joint rendering, whether their images are identical)."""
        scene, background = make_scene(*SCENES["ii"]), crop_scene()
        camera = scene.camera
        union = GaussianTensors(*[torch.cat(pair) for pair in zip(scene.gaussians, background.gaussians)])
        frozen = freeze(*background.gaussians, camera)
        joint = rasterize(*union, camera, background=BACKGROUND, backend="cpu")
        merged = rasterize(*scene.gaussians, camera, background=BACKGROUND, backend="cpu", frozen=frozen)
        identical = all(torch.equal(a, b) for a, b in zip(joint, merged))
        passes = {"frozen": our_pass(scene.gaussians, camera, frozen=frozen), "joint": our_pass(union, camera)}
        times = self.times("background", passes)
        return ratio(times["frozen"], times["joint"]), identical

    def gradient_error(self) -> float:
        """The largest relative L2 error of a gradient."""
        definition = reference()
        worst = 0.0
        for name in ("iii",) if self.quick else ("iii", "i"):
            scene = make_scene(*SCENES[name])
            smooth = ~definition.threshold_pixels(*scene.gaussians[:3], scene.camera)
            outer = [
                gradient * mask for gradient, mask in zip(image_gradients(scene.camera), (smooth[..., None], smooth))
            ]
            ours = our_pass(scene.gaussians, scene.camera, outer)()
            inputs = leaves(scene.gaussians, torch.float64)
            images = definition.rasterize(*inputs, scene.camera, background=BACKGROUND.double())
            exact = torch.autograd.grad(images, inputs, [gradient.double() for gradient in outer])
            errors = [float((a.double() - b).norm() / b.norm()) for a, b in zip(ours, exact)]
            worst = max(worst, *errors)
        return worst

    def _exponent(self, group: str, passes: dict[int, Pass]) -> float:
        medians = {size: statistics.median(times) for size, times in self.times(group, passes).items()}
        return float(np.polyfit(np.log(list(medians)), np.log(list(medians.values())), 1)[0])

    def exponent_gaussians(self) -> float:
        """How time grows with N."""
        scenes = {n: make_scene(n, *SCENES["i"][1:]) for n in COUNTS}
        return self._exponent("gaussians", {n: our_pass(scene.gaussians, scene.camera) for n, scene in scenes.items()})

    def exponent_pixels(self) -> float:
        """How time grows with the number of pixels."""
        scene = make_scene(*SCENES["iii"])
        cameras = [scene.camera.scaled(scale) for scale in SCALES]
        return self._exponent(
            "pixels", {camera.width * camera.height: our_pass(scene.gaussians, camera) for camera in cameras}
        )

    def run(self) -> dict[str, Any]:
        """Everything that the JSON holds."""
        results: dict[str, Any] = {"prototype_ratio": self.prototype_ratio()}
        plain = self.torch_ratio()
        results["torch_ratio"], results["torch_ratio_reference"] = plain["prototype"], plain["reference"]
        results["thread_scaling"] = self.thread_scaling()
        masks = self.mask_speedup()
        results["mask_speedup"] = masks["masked"]
        results["mask_speedup_compact"] = masks["masked, compact"]
        results["frozen_ratio"], results["frozen_identical"] = self.frozen()
        results["gradient_error"] = self.gradient_error()
        results["exponent_gaussians"] = self.exponent_gaussians()
        results["exponent_pixels"] = self.exponent_pixels()
        return results | {
            "medians_ms": self.medians_ms,
            "machine": hardware.describe(),
            "kernel": native.KERNEL.variant,
            "repeats": self.repeats,
            "missing": self.missing,
        }


def print_table(results: dict[str, Any]) -> None:
    """The figures with their targets, then the medians."""
    machine = results["machine"]
    print(f"{machine['cpu']}, {machine['cores']} cores, kernel {results['kernel']}, {results['repeats']} rounds\n")
    print(f"{'figure':<24}{'measured':>10}  target")
    for key in results:
        if key == "medians_ms":
            break
        values = results[key] if isinstance(results[key], dict) else {"": results[key]}
        for name, value in values.items():
            label = f"{key} {name}".strip()
            shown = "-" if value is None else f"{value:.3g}" if isinstance(value, float) else str(value)
            print(f"{label:<24}{shown:>10}  {TARGETS.get(label, '')}".rstrip())
    for key, reason in results["missing"].items():
        print(f"{key} was not measured: {reason}")
    print(f"\n{'forward + backward':<32}{'median ms':>10}")
    for name, median in results["medians_ms"].items():
        print(f"{name:<32}{median:>10.2f}")


def main() -> int:
    """Print the table, and write the JSON where asked to."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--prototype", type=Path, metavar="DIR", help="folder with the prototype's rast_port.cpp")
    parser.add_argument("--json", type=Path, metavar="FILE", help="write the figures here, too")
    parser.add_argument("--repeats", type=int, metavar="N", help="rounds that count (default 15; 5 with --quick)")
    parser.add_argument("--quick", action="store_true", help="under a minute: fewer rounds, gradients on iii only")
    options = parser.parse_args()
    repeats = options.repeats if options.repeats is not None else 5 if options.quick else 15
    if repeats < 1:
        parser.error("--repeats must be at least 1")
    for name in ("rast_port.cpp", "cpp_backend.py"):
        if options.prototype is not None and not (options.prototype / name).is_file():
            parser.error(f"--prototype {options.prototype}: there is no {name} in it")
    if options.json is not None and not options.json.resolve().parent.is_dir():
        parser.error(f"--json {options.json}: there is no such folder")
    sys.dont_write_bytecode = True  # nothing is left in the prototype's folder
    torch.set_num_threads(1)  # neither renderer uses torch's threads, which would take turns with their own
    results = Benchmark(repeats, options.quick, options.prototype).run()
    if options.json is not None:
        write_json(options.json, results)
    print_table(results)
    return 0


if __name__ == "__main__":
    sys.exit(main())

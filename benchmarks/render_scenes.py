"""What the renderer's benchmarks render and how they time it: scenes of random Gaussians, passes that take turns."""

from __future__ import annotations

import importlib.util
import math
import statistics
import time
from collections.abc import Callable
from pathlib import Path
from types import ModuleType
from typing import Any, NamedTuple

import numpy as np
import torch

from splashbench.native.threads import use_threads
from splashbench.render import rasterize
from splashbench.scene import Camera

SCENES = {"iii": (5_000, 240, 160), "i": (20_000, 640, 416), "ii": (85_000, 1200, 1800)}
COVERED, OVERLAP, DISTANCE, TURN = 0.25, 25.0, 4.0, 0.3
CROP_COVERED = 0.9
BACKGROUND = torch.tensor([0.2, 0.3, 0.4])
THREADS = 2
WARM_UP = 2

Pass = Callable[[], Any]


class GaussianTensors(NamedTuple):
    """Gaussians as `rasterize` takes them, float32."""

    means: torch.Tensor
    factors: torch.Tensor
    opacities: torch.Tensor
    colors: torch.Tensor


class BenchmarkScene(NamedTuple):
    """Gaussians, and the camera that looks at them."""

    gaussians: GaussianTensors
    camera: Camera


def make_scene(n: int, width: int, height: int, seed: int = 0, covered: float = COVERED) -> BenchmarkScene:
    """N flat Gaussians on a bumpy shell: about `covered` of the image, OVERLAP contributing to each covered pixel."""
    rng = np.random.default_rng(seed)
    focal = 1.4 * max(width, height)
    radius_px = math.sqrt(covered * width * height / math.pi)
    radius = radius_px * DISTANCE / focal / math.sqrt(1 + (radius_px / focal) ** 2)
    normal = rng.normal(size=(n, 3))
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    bumps = 1 + 0.06 * np.sin(15 * normal[:, :1]) * np.cos(12 * normal[:, 1:2])
    means = radius * (normal * bumps + 0.004 * rng.normal(size=(n, 3)))
    opacities = rng.uniform(0.3, 0.99, n)
    # A footprint is the ellipse alpha >= 1/255: area 2 pi ln(255 o) s1 s2, about halved by foreshortening.
    footprint = covered * width * height * OVERLAP / n
    variance = footprint * 1.75 / (math.pi * 2 * np.log(255 * opacities).mean()) - 0.3
    size = math.sqrt(max(variance, 0.2)) * DISTANCE / focal
    scales = size * np.exp(rng.normal(size=(n, 3)) * [0.45, 0.45, 0.3] - [0.1, 0.1, math.log(5)])
    tangent = np.cross(normal, rng.normal(size=(n, 3)))
    tangent /= np.linalg.norm(tangent, axis=1, keepdims=True)
    factors = np.stack([tangent, np.cross(normal, tangent), normal], axis=2) * scales[:, None]
    c, s = math.cos(TURN), math.sin(TURN)
    w2c = np.array([[c, 0, s, 0], [0, 1, 0, 0], [-s, 0, c, DISTANCE], [0, 0, 0, 1]])
    K = np.array([[focal, 0, width / 2 + 0.3], [0, focal, height / 2 - 0.2], [0, 0, 1]])
    camera = Camera("benchmark", width, height, K, w2c)
    colors = rng.uniform(size=(n, 3))
    tensors = [torch.tensor(array, dtype=torch.float32) for array in (means, factors, opacities, colors)]
    return BenchmarkScene(GaussianTensors(*tensors), camera)


def crop_scene(seed: int = 1) -> BenchmarkScene:
    """As many Gaussians as in scene ii, and as many at each covered pixel, all over an image of its size."""
    return make_scene(*SCENES["ii"], seed=seed, covered=CROP_COVERED)


def image_gradients(camera: Camera) -> list[torch.Tensor]:
    """Fixed gradients of the loss with respect to color and opacity."""
    generator = torch.Generator().manual_seed(1)
    shapes = (camera.height, camera.width, 3), (camera.height, camera.width)
    return [torch.randn(shape, generator=generator) for shape in shapes]


def leaves(gaussians: GaussianTensors, dtype: torch.dtype = torch.float32) -> GaussianTensors:
    """Copies that ask for gradients."""
    return GaussianTensors(*[tensor.to(dtype, copy=True).requires_grad_() for tensor in gaussians])


def our_pass(
    gaussians: GaussianTensors,
    camera: Camera,
    outer: list[torch.Tensor] | None = None,
    threads: int = THREADS,
    **options: Any,
) -> Pass:
    """One forward and backward pass of `rasterize`; outer: the gradients of the two images."""
    inputs = leaves(gaussians)
    outer = outer or image_gradients(camera)

    def run() -> tuple[torch.Tensor, ...]:
        with use_threads(threads):
            images = rasterize(*inputs, camera, background=BACKGROUND, backend="cpu", **options)
            return torch.autograd.grad(images, inputs, outer)

    return run


def take_turns(passes: dict[Any, Pass], repeats: int) -> dict[Any, list[float]]:
    """Milliseconds of `repeats` calls of each pass, in turn: entry k of every list is of round k."""
    times: dict[Any, list[float]] = {name: [] for name in passes}
    for turn in range(WARM_UP + repeats):
        for name, run in passes.items():
            start = time.perf_counter()
            run()
            elapsed = 1e3 * (time.perf_counter() - start)
            if turn >= WARM_UP:
                times[name].append(elapsed)
    return times


def ratio(numerators: list[float], denominators: list[float]) -> float:
    """Median over the rounds of one time over the other."""
    return statistics.median(a / b for a, b in zip(numerators, denominators))


def load_module(path: Path) -> ModuleType:
    """The module in a file that is on no import path."""
    spec = importlib.util.spec_from_file_location(f"benchmark_{path.stem}", path)
    if spec is None or spec.loader is None:
        raise ImportError(f"{path} is no Python module")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def reference() -> ModuleType:
    """The plain torch renderer of the tests."""
    return load_module(Path(__file__).resolve().parents[1] / "tests" / "render" / "reference.py")

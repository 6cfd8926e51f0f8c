"""How fast the renderer is: forward and backward milliseconds on scenes like a training view of liquid.

    python benchmarks/render.py [--repeats 15] [--json]

A bumpy shell of flat Gaussians covers a quarter of the image, about 25 of them contributing to each covered pixel.
The scenes are named as in the measurements that set the target: 20 ms for both passes of `i` on two threads.
"""

from __future__ import annotations

import argparse
import json
import statistics
import sys
import time

import numpy as np
from numpy.typing import NDArray

from splashbench.parallel import thread_count
from splashbench.render import cpu
from splashbench.scene import Camera

SCENES = {"iii": (5_000, 240, 160), "i": (20_000, 640, 416)}
COVERED, OVERLAP, DISTANCE = 0.25, 25.0, 4.0


def make_scene(n: int, width: int, height: int, seed: int = 0) -> tuple[list[NDArray], Camera]:
    """N Gaussians as [means, covariances, opacities, colors] (float32), and the camera that looks at them."""
    rng = np.random.default_rng(seed)
    focal = 1.4 * max(width, height)
    radius_px = np.sqrt(COVERED * width * height / np.pi)
    radius = radius_px * DISTANCE / focal / np.sqrt(1 + (radius_px / focal) ** 2)
    normal = rng.normal(size=(n, 3))
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    bumps = 1 + 0.06 * np.sin(15 * normal[:, :1]) * np.cos(8 * normal[:, 1:2])
    means = normal * radius * bumps
    opacities = rng.uniform(0.3, 0.99, n)
    # A footprint is the ellipse alpha >= 1/255: area 2 pi ln(255 o) s1 s2, about halved by foreshortening.
    footprint = COVERED * width * height * OVERLAP / n
    variance = footprint * 1.75 / (np.pi * 2 * np.log(255 * opacities).mean()) - 0.3
    size = np.sqrt(max(variance, 0.2)) * DISTANCE / focal
    scales = size * np.exp(rng.normal(size=(n, 3)) * [0.45, 0.45, 0.3] - [0.1, 0.1, np.log(5.0)])
    tangent = np.cross(normal, rng.normal(size=(n, 3)))
    tangent /= np.linalg.norm(tangent, axis=1, keepdims=True)
    factors = np.stack([tangent, np.cross(normal, tangent), normal], axis=2) * scales[:, None]
    arrays = [means, factors @ factors.transpose(0, 2, 1), opacities, rng.uniform(size=(n, 3))]
    w2c = np.eye(4)
    w2c[2, 3] = DISTANCE
    K = np.array([[focal, 0, width / 2], [0, focal, height / 2], [0, 0, 1.0]])
    return [array.astype(np.float32) for array in arrays], Camera("benchmark", width, height, K, w2c)


def measure(name: str, repeats: int) -> dict[str, float | int | str]:
    """Median milliseconds of the forward and of the backward pass, after one pass to compile."""
    n, width, height = SCENES[name]
    arrays, camera = make_scene(n, width, height)
    weights = np.random.default_rng(1).normal(size=(height, width, 3)).astype(np.float32)
    forward, backward = [], []
    for _ in range(repeats + 1):
        start = time.perf_counter()
        rendering = cpu.forward(*arrays, camera)
        middle = time.perf_counter()
        cpu.backward(rendering, weights, weights[..., 0])
        forward.append(1e3 * (middle - start))
        backward.append(1e3 * (time.perf_counter() - middle))
    return {
        "scene": name,
        "gaussians": n,
        "width": width,
        "height": height,
        "threads": thread_count(),
        "forward_ms": round(statistics.median(forward[1:]), 2),
        "backward_ms": round(statistics.median(backward[1:]), 2),
    }


def main() -> int:
    """Print a line, or a JSON object, per scene."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--repeats", type=int, default=15, help="timed passes per scene (default 15)")
    parser.add_argument("--json", action="store_true", help="print one JSON list on standard output")
    options = parser.parse_args()
    rows = [measure(name, options.repeats) for name in SCENES]
    if options.json:
        print(json.dumps(rows))
        return 0
    for row in rows:
        print(
            f"{row['scene']:>4}: {row['gaussians']} Gaussians at {row['width']}x{row['height']}, "
            f"{row['threads']} threads: forward {row['forward_ms']} ms, backward {row['backward_ms']} ms"
        )
    return 0


if __name__ == "__main__":
    sys.exit(main())

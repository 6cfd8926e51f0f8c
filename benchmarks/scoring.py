"""How fast image pairs are scored, beside scikit-image and torchmetrics, and whether all say the same.

    python benchmarks/scoring.py [--size 1200x1800] [--rounds 5] [--json FILE]

A pair is a render and its truth at one size, the liquid's mask an ellipse over a fifth of the image. Each row does what
its title says from 8-bit images to figures, on one core; the rows take turns, and times are medians over the rounds.
The figures have to agree to 1e-5. torchmetrics is left out where it is not installed. LPIPS is timed with weights made
here, which take as long as real ones; its figure then means nothing, and is held against the same network by torch.nn.
"""

from __future__ import annotations

import argparse
import importlib.util
import statistics
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import torch

from splashbench.cli.arguments import image_size
from splashbench.files import write_json
from splashbench.harness import hardware
from splashbench.score.image.fidelity import outside_filled, psnr, ssim
from splashbench.score.image.lpips import CONVOLUTIONS, SCALE, SHIFT, Lpips
from splashbench.score.image.weights import weights_digest

AGREEMENT = 1e-5
SIGMA = 1.5
BORDER = 5


def make_pair(width: int, height: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """(render, truth, mask): uint8 [H, W, 3] twice, smooth images with noise, equal outside the mask; bool [H, W]."""
    rng = np.random.default_rng(0)
    y, x = np.mgrid[:height, :width]
    waves = np.stack([np.sin(x / 37 + c) + np.cos(y / 23 - c) for c in range(3)], axis=2)
    truth = np.clip(128 + 40 * waves + rng.normal(0, 6, waves.shape), 0, 255).astype(np.uint8)
    a = 0.5 * np.sqrt(0.2 * 4 / np.pi)
    mask = ((x / width - 0.5) / a) ** 2 + ((y / height - 0.5) / a) ** 2 < 1
    render = np.clip(truth + rng.normal(0, 9, truth.shape), 0, 255).astype(np.uint8)
    return np.where(mask[..., None], render, truth), truth, mask


def ours(render: np.ndarray, truth: np.ndarray, mask: np.ndarray) -> tuple[float, float]:
    first, second = render.astype(np.float64) / 255, truth.astype(np.float64) / 255
    similarity, _ = ssim(
        outside_filled(first, second, mask, "black"), outside_filled(second, second, mask, "black"), mask
    )
    return psnr(first, second, mask), similarity


def by_skimage(render: np.ndarray, truth: np.ndarray, mask: np.ndarray) -> tuple[float, float]:
    from skimage.metrics import peak_signal_noise_ratio, structural_similarity

    first, second = render / 255, truth / 255
    black = mask[..., None]
    similarity = structural_similarity(
        first * black, second * black, channel_axis=2, data_range=1.0, gaussian_weights=True, sigma=SIGMA,
        use_sample_covariance=False,
    )  # fmt: skip
    return float(peak_signal_noise_ratio(second[mask], first[mask], data_range=1.0)), float(similarity)


def by_torchmetrics(render: np.ndarray, truth: np.ndarray, mask: np.ndarray) -> tuple[float, float]:
    from torchmetrics.functional.image import peak_signal_noise_ratio, structural_similarity_index_measure

    first, second = (torch.from_numpy(image).float() / 255 for image in (render, truth))
    seen = torch.from_numpy(mask)
    planes = [(image * seen[..., None]).permute(2, 0, 1)[None] for image in (first, second)]
    # It averages over the border too, where half of the window is mirrored; the protocol does not, so neither here.
    _, whole = structural_similarity_index_measure(
        *planes, gaussian_kernel=True, sigma=SIGMA, data_range=1.0, return_full_image=True
    )
    similarity = whole[..., BORDER:-BORDER, BORDER:-BORDER].double().mean()
    return float(peak_signal_noise_ratio(first[seen], second[seen], data_range=1.0)), float(similarity)


def made_weights() -> dict[str, np.ndarray]:
    """Weights of LPIPS in the real shapes, at random."""
    rng = np.random.default_rng(1)
    shapes = [(64, 3, 11, 11), (192, 64, 5, 5), (384, 192, 3, 3), (256, 384, 3, 3), (256, 256, 3, 3)]
    weights = {f"conv{i}.weight": rng.normal(0, np.sqrt(2 / np.prod(s[1:])), s) for i, s in enumerate(shapes, 1)}
    weights |= {f"conv{i}.bias": rng.normal(0, 0.1, s[0]) for i, s in enumerate(shapes, 1)}
    weights |= {f"lin{i}": rng.random(s[0]) for i, s in enumerate(shapes)}
    return {name: array.astype(np.float32) for name, array in weights.items()}


def lpips_by_modules(weights: dict[str, np.ndarray]) -> Callable[[np.ndarray, np.ndarray], float]:
    """LPIPS as its authors' package computes it: torch.nn's modules, both images one after the other."""
    layers: list[torch.nn.Module] = []
    for i, (stride, padding, pooled) in enumerate(CONVOLUTIONS, 1):
        weight, bias = (torch.from_numpy(weights[f"conv{i}.{part}"]) for part in ("weight", "bias"))
        convolution = torch.nn.Conv2d(weight.shape[1], weight.shape[0], weight.shape[2], stride, padding)
        convolution.load_state_dict({"weight": weight, "bias": bias})
        layers.append(
            torch.nn.Sequential(*([torch.nn.MaxPool2d(3, 2)] if pooled else []), convolution, torch.nn.ReLU())
        )
    shift, scale = (torch.tensor(v).view(1, 3, 1, 1) for v in (SHIFT, SCALE))

    @torch.no_grad()
    def features(image: np.ndarray) -> list[torch.Tensor]:
        out = ((torch.from_numpy(image.astype(np.float32)).permute(2, 0, 1)[None] * 2 - 1) - shift) / scale
        kept = []
        for layer in layers:
            out = layer(out)
            kept.append(out / (out.square().sum(1, keepdim=True).sqrt() + 1e-10))
        return kept

    def distance(first: np.ndarray, second: np.ndarray) -> float:
        total = 0.0
        for i, (a, b) in enumerate(zip(features(first), features(second))):
            head = torch.from_numpy(weights[f"lin{i}"]).view(1, -1, 1, 1)
            total += float(((a - b).square() * head).sum(1).mean())
        return total

    return distance


def lpips_rows(pair: tuple[np.ndarray, np.ndarray, np.ndarray]) -> dict[str, Callable[[], tuple[float, ...]]]:
    """LPIPS of the masked images, ours and by modules."""
    weights = made_weights()
    metric, modules = Lpips(weights, weights_digest(weights)), lpips_by_modules(weights)
    render, truth, mask = pair
    first, second = (np.where(mask[..., None], image / 255, 0.0) for image in (render, truth))
    return {
        "LPIPS, splashbench": lambda: (metric(first, second),),
        "LPIPS, torch.nn": lambda: (modules(first, second),),
    }


def main() -> int:
    """Time the rows in turn, print the table, and say whether the figures agree."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--size", type=image_size, default=(1200, 1800), metavar="WxH")
    parser.add_argument("--rounds", type=int, default=5, metavar="N")
    parser.add_argument("--json", type=Path, metavar="FILE")
    options = parser.parse_args()
    torch.set_num_threads(1)
    pair = make_pair(*options.size)
    rows: dict[str, Callable[[], tuple[float, ...]]] = {
        "PSNR and SSIM, splashbench": lambda: ours(*pair),
        "PSNR and SSIM, scikit-image": lambda: by_skimage(*pair),
    }
    if importlib.util.find_spec("torchmetrics"):
        rows["PSNR and SSIM, torchmetrics"] = lambda: by_torchmetrics(*pair)
    rows |= lpips_rows(pair)
    figures: dict[str, tuple[float, ...]] = {}
    seconds: dict[str, list[float]] = {name: [] for name in rows}
    for turn in range(options.rounds + 1):
        for name, run in rows.items():
            start = time.process_time()
            figures[name] = run()
            if turn:
                seconds[name].append(time.process_time() - start)
    results: dict[str, Any] = {"machine": hardware.describe(), "size": list(options.size), "rows": {}}
    agree = True
    print(f"{options.size[0]}x{options.size[1]}, mask {pair[2].mean():.0%} of it; medians of {options.rounds} rounds")
    print(f"{'':30}{'pairs/s and core':>17}{'times ours':>12}{'difference':>13}")
    for name, times in seconds.items():
        base = next(other for other in rows if other.partition(",")[0] == name.partition(",")[0])
        ratio = statistics.median(a / b for a, b in zip(times, seconds[base]))
        difference = max(abs(a - b) for a, b in zip(figures[name], figures[base]))
        agree &= difference <= AGREEMENT
        rate = 1 / statistics.median(times)
        results["rows"][name] = {"pairs_per_second": rate, "times_ours": ratio, "difference": difference}
        print(f"{name:30}{rate:>17.2f}{ratio:>12.2f}{difference:>13.1e}")
    if options.json is not None:
        write_json(options.json, results)
    return 0 if agree else 1


if __name__ == "__main__":
    sys.exit(main())

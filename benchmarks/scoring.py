"""How fast image pairs are scored, beside scikit-image, torchmetrics, piq and lpips, and whether all say the same.

    python benchmarks/scoring.py [--size 1200x1800] [--rounds 5] [--lpips-weights FILE] [--json FILE]

A pair is a render and its truth at one size, the liquid's mask an ellipse over a fifth of the image. Each row does what
its title says from 8-bit images to figures, on one core; the rows take turns, and times are medians over the rounds.
The figures have to agree with ours to 1e-5, else the exit status is 1. A package that cannot be imported is left out,
and a line says why. lpips, piq and torchmetrics' LPIPS need torchvision. Without --lpips-weights LPIPS has weights made
here, which take as long as real ones; its figure then means nothing, and is the same network's by each package.

What differs by definition is set to the protocol's:

    window of SSIM   11x11, sigma 1.5, data range 1, population variance, for all
    border of SSIM   torchmetrics averages over mirrored windows too; here its map is cut first
    downsampling     piq shrinks large images before SSIM; switched off
    PSNR of piq      has 1e-8 added to the mean squared error, which is taken off again
    LPIPS of piq     has VGG16 alone; here its class below LPIPS is given AlexNet
    LPIPS' norm      of a feature is sqrt(sum + 1e-8) in torchmetrics, sqrt(sum) + 1e-10 elsewhere; left as it is
"""

from __future__ import annotations

import argparse
import importlib
import importlib.metadata
import statistics
import sys
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import torch

from splashbench.cli.arguments import image_size
from splashbench.files import read_npz, write_json
from splashbench.harness import hardware
from splashbench.score.image.fidelity import outside_filled, psnr, ssim
from splashbench.score.image.lpips import CONVOLUTIONS, SCALE, SHIFT, Lpips
from splashbench.score.image.weights import RANKS, Weights, weights_digest

AGREEMENT = 1e-5
SIGMA = 1.5
BORDER = 5
#: What piq adds to the mean squared error.
PIQ_ERROR = 1e-8
FIDELITY, DISTANCE, TOGETHER = "PSNR and SSIM", "LPIPS", "all three together"

#: Render and truth uint8 [H, W, 3], and the liquid's mask bool [H, W].
Pair = tuple[np.ndarray, np.ndarray, np.ndarray]
#: LPIPS of two masked images float32 [1, 3, H, W] in [0, 1].
Network = Callable[[torch.Tensor, torch.Tensor], float]
#: PSNR and SSIM of what `tensors` returns.
Fidelity = Callable[[list[torch.Tensor], list[torch.Tensor]], list[float]]


def make_pair(width: int, height: int) -> Pair:
    """(render, truth, mask): uint8 [H, W, 3] twice, smooth images with noise, equal outside the mask; bool [H, W]."""
    rng = np.random.default_rng(0)
    y, x = np.mgrid[:height, :width]
    waves = np.stack([np.sin(x / 37 + c) + np.cos(y / 23 - c) for c in range(3)], axis=2)
    truth = np.clip(128 + 40 * waves + rng.normal(0, 6, waves.shape), 0, 255).astype(np.uint8)
    a = 0.5 * np.sqrt(0.2 * 4 / np.pi)
    mask = ((x / width - 0.5) / a) ** 2 + ((y / height - 0.5) / a) ** 2 < 1
    render = np.clip(truth + rng.normal(0, 9, truth.shape), 0, 255).astype(np.uint8)
    return np.where(mask[..., None], render, truth), truth, mask


def ours(pair: Pair, what: str, metric: Lpips) -> list[float]:
    """The figures of family `what`, in the order PSNR, SSIM, LPIPS; so do all functions below."""
    render, truth, mask = pair
    first, second = render.astype(np.float64) / 255, truth.astype(np.float64) / 255
    masked = [outside_filled(image, second, mask, "black") for image in (first, second)]
    figures = [] if what == DISTANCE else [psnr(first, second, mask), ssim(masked[0], masked[1], mask)[0]]
    return figures if what == FIDELITY else [*figures, metric(masked[0], masked[1])]


def by_skimage(pair: Pair, network: Network | None = None) -> list[float]:
    """PSNR and SSIM, and LPIPS by `network`, since scikit-image has none."""
    from skimage.metrics import peak_signal_noise_ratio, structural_similarity

    render, truth, mask = pair
    first, second = render / 255, truth / 255
    black = mask[..., None]
    similarity = structural_similarity(
        first * black, second * black, channel_axis=2, data_range=1.0, gaussian_weights=True, sigma=SIGMA,
        use_sample_covariance=False,
    )  # fmt: skip
    figures = [float(peak_signal_noise_ratio(second[mask], first[mask], data_range=1.0)), float(similarity)]
    return [*figures, network(*tensors(pair)[0])] if network else figures


def by_tensors(pair: Pair, fidelity: Fidelity | None, network: Network | None) -> list[float]:
    """PSNR and SSIM by `fidelity`, LPIPS by `network`, of one conversion of the images."""
    planes, liquid = tensors(pair)
    return [*(fidelity(planes, liquid) if fidelity else []), *([network(*planes)] if network else [])]


def tensors(pair: Pair) -> tuple[list[torch.Tensor], list[torch.Tensor]]:
    """Masked images float32 [1, 3, H, W], and the pixels of the liquid float32 [n, 3], of render and truth."""
    render, truth, mask = pair
    seen = torch.from_numpy(mask)
    images = [torch.from_numpy(image).float() / 255 for image in (render, truth)]
    return [(image * seen[..., None]).permute(2, 0, 1)[None] for image in images], [image[seen] for image in images]


def by_torchmetrics(planes: list[torch.Tensor], liquid: list[torch.Tensor]) -> list[float]:
    """PSNR and SSIM; arguments from `tensors`."""
    from torchmetrics.functional.image import peak_signal_noise_ratio, structural_similarity_index_measure  # type: ignore[import-not-found]

    _, whole = structural_similarity_index_measure(
        *planes, gaussian_kernel=True, sigma=SIGMA, data_range=1.0, return_full_image=True
    )
    similarity = whole[..., BORDER:-BORDER, BORDER:-BORDER].double().mean()
    return [float(peak_signal_noise_ratio(*liquid, data_range=1.0)), float(similarity)]


def by_piq(planes: list[torch.Tensor], liquid: list[torch.Tensor]) -> list[float]:
    """PSNR and SSIM; arguments from `tensors`."""
    import piq  # type: ignore[import-not-found]

    raised = float(piq.psnr(*(pixels.T[None, :, :, None] for pixels in liquid), data_range=1.0))
    ratio = -10 * np.log10(10 ** (-raised / 10) - PIQ_ERROR)
    return [float(ratio), float(piq.ssim(*planes, kernel_sigma=SIGMA, data_range=1.0, downsample=False))]


def made_weights() -> Weights:
    """Weights of LPIPS in the real shapes, at random."""
    rng = np.random.default_rng(1)
    shapes = [(64, 3, 11, 11), (192, 64, 5, 5), (384, 192, 3, 3), (256, 384, 3, 3), (256, 256, 3, 3)]
    weights = {f"conv{i}.weight": rng.normal(0, np.sqrt(2 / np.prod(s[1:])), s) for i, s in enumerate(shapes, 1)}
    weights |= {f"conv{i}.bias": rng.normal(0, 0.1, s[0]) for i, s in enumerate(shapes, 1)}
    weights |= {f"lin{i}": rng.random(s[0]) for i, s in enumerate(shapes)}
    return {name: array.astype(np.float32) for name, array in weights.items()}


def alexnet(weights: Weights) -> list[torch.nn.Sequential]:
    """The five parts of AlexNet whose outputs LPIPS compares."""
    parts = []
    for i, (stride, padding, pooled) in enumerate(CONVOLUTIONS, 1):
        weight, bias = (torch.from_numpy(weights[f"conv{i}.{part}"]) for part in ("weight", "bias"))
        convolution = torch.nn.Conv2d(weight.shape[1], weight.shape[0], weight.shape[2], stride, padding)
        convolution.load_state_dict({"weight": weight, "bias": bias})
        parts.append(torch.nn.Sequential(*([torch.nn.MaxPool2d(3, 2)] if pooled else []), convolution, torch.nn.ReLU()))
    return parts


def lpips_by_modules(weights: Weights) -> Network:
    """LPIPS as its authors' package computes it: torch.nn's modules, both images one after the other."""
    layers = alexnet(weights)
    shift, scale = (torch.tensor(v).view(1, 3, 1, 1) for v in (SHIFT, SCALE))
    heads = [torch.from_numpy(weights[f"lin{i}"]).view(1, -1, 1, 1) for i in range(5)]

    def features(image: torch.Tensor) -> list[torch.Tensor]:
        out = ((image * 2 - 1) - shift) / scale
        kept = []
        for layer in layers:
            out = layer(out)
            kept.append(out / (out.square().sum(1, keepdim=True).sqrt() + 1e-10))
        return kept

    def distance(first: torch.Tensor, second: torch.Tensor) -> float:
        pairs = zip(features(first), features(second), heads)
        return sum(float(((a - b).square() * head).sum(1).mean()) for a, b, head in pairs)

    return distance


def lpips_by_package(weights: Weights) -> Network:
    """LPIPS of its authors' package, `lpips`."""
    import lpips  # type: ignore[import-not-found]

    network = _filled(lpips.LPIPS(pretrained=False, pnet_rand=True, net="alex", verbose=False), weights)
    return lambda first, second: float(network(first, second, normalize=True))


def lpips_by_torchmetrics(weights: Weights) -> Network:
    """LPIPS of torchmetrics. Its class is private: the public function fetches other weights at every call."""
    from torchmetrics.functional.image.lpips import _LPIPS  # type: ignore[import-not-found]

    network = _filled(_LPIPS(pretrained=False, pnet_rand=True, net="alex"), weights)
    return lambda first, second: float(network(first, second, normalize=True))


def _filled(network: Any, weights: Weights) -> Any:
    """`network`, of lpips or torchmetrics, which name the same parts, with `weights`."""
    convolutions = [module for module in network.net.modules() if isinstance(module, torch.nn.Conv2d)]
    for i, convolution in enumerate(convolutions, 1):
        state = {part: torch.from_numpy(weights[f"conv{i}.{part}"]) for part in ("weight", "bias")}
        convolution.load_state_dict(state)
    for i in range(5):
        head = torch.from_numpy(weights[f"lin{i}"]).view(1, -1, 1, 1)
        getattr(network, f"lin{i}").model[-1].load_state_dict({"weight": head})
    return network.eval()


def lpips_by_piq(weights: Weights) -> Network:
    """LPIPS by piq's ContentLoss, of which its LPIPS is the case of VGG16."""
    from piq.perceptual import ContentLoss  # type: ignore[import-not-found]

    # piq takes images in [0, 1] to (image - mean) / std, LPIPS to (2 image - 1 - SHIFT) / SCALE.
    loss = ContentLoss(
        torch.nn.Sequential(*alexnet(weights)),
        layers=[str(i) for i in range(5)],
        weights=[torch.from_numpy(weights[f"lin{i}"]).view(1, -1, 1, 1) for i in range(5)],
        mean=[(1 + shift) / 2 for shift in SHIFT],
        std=[scale / 2 for scale in SCALE],
        normalize_features=True,
    )
    return lambda first, second: float(loss(first, second))


def make_rows(pair: Pair, weights: Weights) -> dict[tuple[str, str], Callable[[], list[float]]]:
    """(family, package) -> what computes the family's figures; of each family ours is the first."""
    metric = Lpips(weights, weights_digest(weights))
    rows = {(what, "splashbench"): partial(ours, pair, what, metric) for what in (FIDELITY, DISTANCE, TOGETHER)}
    rows[FIDELITY, "scikit-image"] = partial(by_skimage, pair)
    rows[DISTANCE, "torch.nn"] = partial(by_tensors, pair, None, lpips_by_modules(weights))
    fidelities: dict[str, Fidelity] = {"torchmetrics": by_torchmetrics, "piq": by_piq}
    networks = {"lpips": lpips_by_package, "torchmetrics": lpips_by_torchmetrics, "piq": lpips_by_piq}
    vision = _imports("torchvision", "LPIPS by other packages")
    for package, make_network in networks.items():
        if not _imports(package):
            continue
        fidelity = fidelities.get(package)
        network = make_network(weights) if vision else None
        if fidelity:
            rows[FIDELITY, package] = partial(by_tensors, pair, fidelity, None)
        if network:
            rows[DISTANCE, package] = partial(by_tensors, pair, None, network)
        if fidelity and network:
            rows[TOGETHER, package] = partial(by_tensors, pair, fidelity, network)
        elif network:
            rows[TOGETHER, f"scikit-image, {package}"] = partial(by_skimage, pair, network)
    families = [FIDELITY, DISTANCE, TOGETHER]
    return dict(sorted(rows.items(), key=lambda item: families.index(item[0][0])))


def _imports(package: str, what: str = "") -> bool:
    """Whether `package` can be imported; a line says why `what` (the package itself) is left out where it cannot."""
    try:
        importlib.import_module(package)
    except Exception as error:  # torchvision built for another torch ends in a RuntimeError
        print(f"{what or package} is left out: {package} cannot be imported ({str(error).splitlines()[0]})")
        return False
    return True


def main() -> int:
    """Time the rows in turn, print the table, and say whether the figures agree."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--size", type=image_size, default=(1200, 1800), metavar="WxH")
    parser.add_argument("--rounds", type=int, default=5, metavar="N")
    parser.add_argument(
        "--lpips-weights", type=Path, metavar="FILE", help="an .npz of LPIPS v0.1's (default: made ones)"
    )
    parser.add_argument("--json", type=Path, metavar="FILE")
    options = parser.parse_args()
    torch.set_num_threads(1)
    torch.set_grad_enabled(False)
    pair = make_pair(*options.size)
    rows = make_rows(pair, read_npz(options.lpips_weights, RANKS) if options.lpips_weights else made_weights())
    figures: dict[tuple[str, str], list[float]] = {}
    seconds: dict[tuple[str, str], list[float]] = {name: [] for name in rows}
    for turn in range(options.rounds + 1):
        for name, run in rows.items():
            start = time.process_time()
            figures[name] = run()
            if turn:
                seconds[name].append(time.process_time() - start)
    results: dict[str, Any] = {"machine": hardware.describe(), "size": list(options.size), "rows": {}}
    results["versions"] = _versions()
    agree = True
    print(f"{options.size[0]}x{options.size[1]}, mask {pair[2].mean():.0%} of it; medians of {options.rounds} rounds")
    print(f"{'':40}{'pairs/s and core':>17}{'times ours':>12}{'difference':>13}")
    for (what, package), times in seconds.items():
        base = (what, "splashbench")
        ratio = statistics.median(a / b for a, b in zip(times, seconds[base]))
        difference = max(abs(a - b) for a, b in zip(figures[what, package], figures[base], strict=True))
        agree &= difference <= AGREEMENT  # False for NaN
        rate = 1 / statistics.median(times)
        title = f"{what}, {package}"
        results["rows"][title] = {"pairs_per_second": rate, "times_ours": ratio, "difference": difference}
        mark = "" if difference <= AGREEMENT else "  DIFFERS"
        print(f"{title:40}{rate:>17.2f}{ratio:>12.2f}{difference:>13.1e}{mark}")
    if options.json is not None:
        write_json(options.json, results)
    return 0 if agree else 1


def _versions() -> dict[str, str]:
    found = {}
    for package in ("scikit-image", "torch", "torchmetrics", "torchvision", "piq", "lpips"):
        try:
            found[package] = importlib.metadata.version(package)
        except importlib.metadata.PackageNotFoundError:
            continue
    return found


if __name__ == "__main__":
    sys.exit(main())

"""LPIPS v0.1 with AlexNet (Zhang et al. 2018) in plain torch: five convolutions and five 1x1 linear heads.

No torchvision is needed. Weights come from an .npz (`--lpips-weights`, or the environment variable
SPLASHBENCH_LPIPS_WEIGHTS), else from the cache folder, where `splashbench download lpips-weights` puts them, else from
an installed `lpips` package's own file together with torchvision's AlexNet in the torch.hub cache. Where none can be
had LPIPS is null with a reason; other weights than v0.1's are refused.
"""

from __future__ import annotations

import importlib.util
import os
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from splashbench.errors import SplashbenchError
from splashbench.files import read_npz
from splashbench.score.image.fidelity import Image
from splashbench.score.image.weights import (
    ALEXNET_FILE,
    HEADS_FILE,
    RANKS,
    WEIGHTS_SHA256,
    Weights,
    checkpoint_weights,
    weights_digest,
    weights_path,
)

if TYPE_CHECKING:
    import torch

WEIGHTS_VARIABLE = "SPLASHBENCH_LPIPS_WEIGHTS"

_REMEDY = "run `splashbench download lpips-weights` once, or give --lpips-weights"
#: (stride, padding) of each convolution, and whether a 3x3 max pooling of stride 2 comes before it.
CONVOLUTIONS = ((4, 2, False), (1, 2, True), (1, 1, True), (1, 1, False), (1, 1, False))
#: Of the colours in [-1, 1], before the first convolution: (colour - SHIFT) / SCALE.
SHIFT = (-0.030, -0.088, -0.188)
SCALE = (0.458, 0.448, 0.450)

# A feature of the last layer sees so many pixels, and all grids are the same again after so many.
_SEEN, _PERIOD = 163, 16


def _surroundings(differs: NDArray[np.bool_]) -> slice:
    """The rows (or columns) that tell the distance, of those in which the images differ, bool [n].

    A feature that sees a difference lies less than what it sees away from it, and sees as far again. A part that starts
    at a multiple of the grids' period has the whole image's features, but for those at its edges, which see none.
    """
    where = np.flatnonzero(differs)
    start = max(0, int(where[0]) - _SEEN) // _PERIOD * _PERIOD
    return slice(start, min(len(differs), max(int(where[-1]) + 1 + _SEEN, start + _SEEN)))


def _feature_count(pixels: int, layer: int) -> int:
    """Features along a side of so many pixels after the convolution `layer`, counted from 0."""
    count = (pixels + 2 * 2 - 11) // 4 + 1
    for _, _, pooled in CONVOLUTIONS[1 : layer + 1]:
        count = (count - 3) // 2 + 1 if pooled else count
    return count


class Lpips:
    """The metric with its weights loaded. `digest` names them."""

    def __init__(self, weights: Weights, expected: str = WEIGHTS_SHA256) -> None:
        """expected: `weights_digest` that they must have; tests and benchmarks have made-up ones."""
        import torch

        self.digest = weights_digest(weights)
        if self.digest != expected:
            raise SplashbenchError(
                "the LPIPS weights given are not those of AlexNet v0.1; use torchvision's IMAGENET1K_V1 convolutions "
                "with the linear weights of the lpips package"
            )
        tensors = {name: torch.from_numpy(np.array(array, dtype=np.float32)) for name, array in weights.items()}
        self._convolutions = [(tensors[f"conv{i}.weight"], tensors[f"conv{i}.bias"]) for i in range(1, 6)]
        self._heads = [tensors[f"lin{i}"].reshape(1, -1, 1, 1) for i in range(5)]
        self._shift = torch.tensor(SHIFT).reshape(1, 3, 1, 1)
        self._scale = torch.tensor(SCALE).reshape(1, 3, 1, 1)

    def __call__(self, first: Image, second: Image) -> float:
        """Distance of two images [H, W, 3] in [0, 1], 31 px a side or more; exactly 0 for equal ones.

        What is equal in both has equal features, which add nothing to the sum: only the surroundings of what differs
        are looked at. The means are over the whole images all the same.
        """
        import torch

        differs = (first != second).any(axis=2)
        if not differs.any():
            return 0.0
        rows, columns = (_surroundings(differs.any(axis=axis)) for axis in (1, 0))
        with torch.inference_mode():
            images = np.stack([first[rows, columns], second[rows, columns]]).astype(np.float32)
            cut = torch.from_numpy(images).permute(0, 3, 1, 2)
            total = 0.0
            for i, (features, head) in enumerate(zip(self._features(2 * cut - 1), self._heads)):
                unit = features / (features.square().sum(1, keepdim=True).sqrt() + 1e-10)
                distance = ((unit[:1] - unit[1:]).square() * head).sum(1)
                total += float(distance.sum(dtype=torch.float64)) / (
                    _feature_count(differs.shape[0], i) * _feature_count(differs.shape[1], i)
                )
        return total

    def _features(self, images: torch.Tensor) -> list[torch.Tensor]:
        """Activations after each of the five ReLUs for images [B, 3, H, W] in [-1, 1]."""
        import torch.nn.functional as F

        activation = (images - self._shift) / self._scale
        features = []
        for (stride, padding, pooled), (weight, bias) in zip(CONVOLUTIONS, self._convolutions):
            if pooled:
                activation = F.max_pool2d(activation, 3, 2)
            activation = F.relu(F.conv2d(activation, weight, bias, stride, padding))
            features.append(activation)
        return features


def load_lpips(path: Path | None = None) -> tuple[Lpips | None, str]:
    """(metric, "") where weights can be had, else (None, reason). A file that was named or fetched must be good.

    Args:
        path: an .npz with conv1..5.weight/.bias and lin0..4; None looks at the environment, then into the cache
            folder, then at installed packages.
    """
    weights_file = path or os.environ.get(WEIGHTS_VARIABLE)
    if weights_file:
        return Lpips(read_npz(Path(weights_file), RANKS)), ""
    cached = _cached_file()
    if cached is not None:
        try:
            return Lpips(read_npz(cached, RANKS)), ""
        except SplashbenchError:
            raise SplashbenchError(
                f"{cached} is damaged or no file of LPIPS weights; `splashbench download lpips-weights` replaces it"
            ) from None
    heads = _lpips_package_file()
    if heads is None:
        return None, f"no LPIPS weights: {_REMEDY}"
    import torch

    alexnet = Path(torch.hub.get_dir(), "checkpoints", ALEXNET_FILE)
    if not alexnet.is_file():
        return None, f"no LPIPS weights: {ALEXNET_FILE} is not in the torch.hub cache; {_REMEDY}"
    return Lpips(checkpoint_weights(alexnet, heads)), ""


def _cached_file() -> Path | None:
    """What `splashbench download lpips-weights` left, if anything."""
    try:
        path = weights_path()
    except SplashbenchError:  # no home folder: nothing was left
        return None
    return path if path.exists() else None


def _lpips_package_file() -> Path | None:
    """The linear weights inside an installed `lpips` package, found without importing it (it needs torchvision)."""
    spec = importlib.util.find_spec("lpips")
    for folder in (spec.submodule_search_locations if spec else None) or ():
        path = Path(folder, "weights", "v0.1", HEADS_FILE)
        if path.is_file():
            return path
    return None

"""The weights of LPIPS v0.1 with AlexNet: their one digest, their .npz, and the checkpoints that they come from."""

from __future__ import annotations

import hashlib
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from splashbench.cache import cache_folder
from splashbench.errors import SplashbenchError
from splashbench.files import read_npz

Weights = dict[str, NDArray[np.float32]]

# `weights_digest` of torchvision's IMAGENET1K_V1 AlexNet and LPIPS v0.1's linear weights.
WEIGHTS_SHA256 = "3a6b685efb624231c58b6d5e9951d6ed4f9e15f02b6c67a6b75cdbfc13541748"
#: Torchvision's checkpoint, and the linear weights in the `lpips` package's folder weights/v0.1.
ALEXNET_FILE, HEADS_FILE = "alexnet-owt-7be5be79.pth", "alex.pth"
#: Array -> its number of dimensions.
RANKS = {
    **{f"conv{i}.{part}": rank for i in range(1, 6) for part, rank in (("weight", 4), ("bias", 1))},
    **{f"lin{i}": 1 for i in range(5)},
}
_CACHED_FILE = "lpips_alex_v0.1.npz"
# Index of each convolution in torchvision's `features`.
_TORCHVISION_LAYERS = (0, 3, 6, 8, 10)


def weights_digest(weights: Weights) -> str:
    """SHA-256 of the arrays' shapes and values, whatever file they came from."""
    digest = hashlib.sha256()
    for name in RANKS:
        array = np.ascontiguousarray(weights[name], dtype="<f4")
        digest.update(f"{name} {array.shape}".encode() + array.tobytes())
    return digest.hexdigest()


def weights_path(folder: Path | None = None) -> Path:
    """Where `splashbench download lpips-weights` keeps them in `folder`, by default the user's cache folder."""
    return (cache_folder() if folder is None else Path(folder)) / _CACHED_FILE


def verified_weights(path: Path) -> Weights | None:
    """The arrays of an .npz; None where it is missing, damaged, or holds other weights than v0.1's."""
    try:
        weights: Weights = read_npz(path, RANKS)
    except SplashbenchError:
        return None
    return weights if weights_digest(weights) == WEIGHTS_SHA256 else None


def checkpoint_weights(alexnet: Path, heads: Path) -> Weights:
    """The arrays of `RANKS` from torchvision's AlexNet and the lpips package's linear weights.

    Nothing in the files is run. Raises SplashbenchError for one that is damaged or lacks an array.
    """
    convolutions, linear = _load_state(alexnet), _load_state(heads)
    weights: Weights = {}
    for i, layer in enumerate(_TORCHVISION_LAYERS, start=1):
        for part in ("weight", "bias"):
            weights[f"conv{i}.{part}"] = _array(alexnet, convolutions, f"features.{layer}.{part}")
    for i in range(5):
        weights[f"lin{i}"] = _array(heads, linear, f"lin{i}.model.1.weight").reshape(-1)
    return weights


def _load_state(path: Path) -> dict[str, Any]:
    import pickle

    import torch

    try:
        state = torch.load(path, map_location="cpu", weights_only=True)
    except pickle.UnpicklingError:  # its text advises to run what is in the file
        raise SplashbenchError(f"{path} holds no plain weights; fetch it anew") from None
    except Exception as error:  # torch lets through whatever a damaged file causes
        reason = next(iter(str(error).splitlines()), type(error).__name__)[:120]
        raise SplashbenchError(f"{path} cannot be read ({reason}); fetch it anew") from None
    if not isinstance(state, dict):
        raise SplashbenchError(f"{path} holds no named weights; fetch it anew")
    return state


def _array(path: Path, state: dict[str, Any], name: str) -> NDArray[np.float32]:
    """A copy, so that a checkpoint's other weights, most of its bytes, are not kept in memory."""
    try:
        return np.array(state[name].numpy(), dtype=np.float32)
    except (KeyError, AttributeError, TypeError, ValueError, RuntimeError):
        raise SplashbenchError(f"{path} lacks the weights {name}; fetch it anew") from None

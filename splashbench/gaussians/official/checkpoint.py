"""Weights that a stranger's code saved with PyTorch, read without running what is in the file.

A `state_dict` goes through torch.load with weights_only=True, a TorchScript archive through torchscript.py. Shapes are
held against those of the network before the numbers are used.
"""

from __future__ import annotations

import zipfile
from collections.abc import Mapping
from pathlib import Path

import torch
from torch import Tensor

from splashbench.errors import SplashbenchError, one_line
from splashbench.files import require_plain_file
from splashbench.gaussians.official.torchscript import is_traced, traced_weights

_MAX_BYTES = 256 << 20
_KINDS = (torch.float16, torch.bfloat16, torch.float32, torch.float64)
_REMEDY = "give the file that the official code saved"


def read_weights(path: Path) -> dict[str, Tensor]:
    """The tensors of a `state_dict` or of a traced module by name, as they are; hand them to `fill`.

    Raises SplashbenchError for a file that is missing, too large, or holds anything but tensors.
    """
    path = Path(path)
    if not path.exists():
        raise SplashbenchError(f"{path} does not exist; let the code save its last iteration")
    require_plain_file(path)
    _require_size(path)
    # First: older versions of torch.load compile and run such an archive, whatever weights_only says.
    if is_traced(path):
        return {name: torch.from_numpy(array.copy()) for name, array in traced_weights(path, _MAX_BYTES).items()}
    try:
        content = torch.load(path, map_location="cpu", weights_only=True)
    # What its reader stumbles over in a damaged or hostile file may be anything.
    except Exception as error:
        cause = one_line(str(error)).split(". ")[0][:200]
        raise SplashbenchError(
            f"{path} cannot be read as weights alone ({type(error).__name__}: {cause}); save its state_dict() instead"
        ) from None
    if not (isinstance(content, Mapping) and all(isinstance(tensor, Tensor) for tensor in content.values())):
        raise SplashbenchError(f"{path} holds a {type(content).__name__}, not tensors by name; save state_dict()")
    return {str(name): tensor for name, tensor in content.items()}


def _require_size(path: Path) -> None:
    size = path.stat().st_size
    try:
        with zipfile.ZipFile(path) as archive:
            size = max(size, sum(entry.file_size for entry in archive.infolist()))
    except (zipfile.BadZipFile, OSError, ValueError, RuntimeError):
        pass  # an older format, or no such file at all: the reader will tell
    if size > _MAX_BYTES:
        raise SplashbenchError(
            f"{path} holds more than {_MAX_BYTES >> 20} MiB, more than such a network; see that it is the model's file"
        )


def fill(slots: Mapping[str, Tensor], weights: Mapping[str, Tensor], path: Path) -> None:
    """Copy `weights` into `slots`, a network's own tensors by the names that `path` has for them.

    Raises SplashbenchError for names that are missing or unknown, other shapes, NaN and infinity.
    """
    unknown = [name for name in weights if name not in slots]
    if unknown:
        raise SplashbenchError(f"{path} has {one_line(unknown[0])[:80]}, which this network has not; {_REMEDY}")
    for name, slot in slots.items():
        tensor = weights.get(name)
        if tensor is None:
            raise SplashbenchError(f"{path} lacks {name}; {_REMEDY}")
        if tensor.shape != slot.shape or tensor.dtype not in _KINDS or tensor.layout != torch.strided:
            kind = str(tensor.dtype).removeprefix("torch.")
            raise SplashbenchError(
                f"{path}: {name} is {kind} {list(tensor.shape)}, not float32 {list(slot.shape)}; {_REMEDY}"
            )
        if not torch.isfinite(tensor).all():
            raise SplashbenchError(f"{path}: {name} has NaN or infinite entries; the fit failed, repeat it")
    with torch.no_grad():
        for name, slot in slots.items():
            slot.copy_(weights[name])

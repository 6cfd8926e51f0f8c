"""A SAM3 checkpoint on disk: what it offers, and loading it without trusting or downloading anything.

SAM3 (Carion et al., 2026) finds every instance of a concept given in words, and follows an object given by clicks
through a video. Its implementation is that of Hugging Face's `transformers`, which comes with the extra `sam3`; the
weights are the user's own copy of the published checkpoint: config.json, safetensors, and the tokenizer's files.

`transformers` scales images with torchvision, which this does without: `scaled` does the same in PyTorch, as the
checkpoint's processor is set (1008 x 1008 pixels, bilinear with antialiasing on 8-bit values, mean and deviation 0.5).
"""

from __future__ import annotations

import importlib.util
import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel, Field

from splashbench.errors import SplashbenchError
from splashbench.files import read_json, read_model, validate_model

INSTALL = "in a checkout: pip install -c constraints.txt -e '.[sam3]'"
# Of config.json: the whole published checkpoint, or one of the two models in it.
_FINDING = ("sam3_video", "sam3")
_FOLLOWING = ("sam3_video", "sam3_tracker_video")
_MAX_IMAGE_SIZE = 4096
# The processor's settings are in one of these, the latter as newer versions write them.
_PROCESSOR_FILES = ("preprocessor_config.json", "processor_config.json")
_TOKENIZER_FILES = (("tokenizer.json",), ("vocab.json", "merges.txt"))
_SEED = 0


class _Config(BaseModel):
    """What is read of config.json before `transformers` reads the rest."""

    model_type: str


class _Normalisation(BaseModel):
    """What is read of the processor's settings: mean and deviation of each channel, of 1."""

    image_mean: list[float] = Field(default=[0.5, 0.5, 0.5], min_length=3, max_length=3)
    image_std: list[Annotated[float, Field(gt=0)]] = Field(default=[0.5, 0.5, 0.5], min_length=3, max_length=3)


class Sam3Checkpoint:
    """A folder with a SAM3 checkpoint, looked over but not yet loaded.

    Attributes: folder; device, "cpu" or "cuda"; finds, whether it finds what words describe; follows, whether it
    follows what is clicked.
    """

    def __init__(self, folder: Path, device: Literal["cpu", "cuda"] | None = None) -> None:
        """device: "cuda" where there is one by default.

        Raises SplashbenchError when `transformers` is not installed, the folder holds no SAM3 checkpoint with
        safetensors, or the device is not there.
        """
        require_transformers()
        import torch

        self.folder = Path(folder)
        if not self.folder.is_dir():
            raise SplashbenchError(f"{self.folder} is not a folder; give that of a SAM3 checkpoint in masks.checkpoint")
        kind = read_model(self.folder / "config.json", _Config).model_type
        self.finds, self.follows = kind in _FINDING, kind in _FOLLOWING
        if not (self.finds or self.follows):
            raise SplashbenchError(
                f"{self.folder / 'config.json'}: model_type is {kind!r}, not one of"
                f" {', '.join(sorted({*_FINDING, *_FOLLOWING}))}; give the folder of a SAM3 checkpoint"
            )
        if not any(self.folder.glob("*.safetensors")):
            raise SplashbenchError(
                f"{self.folder} has no *.safetensors; other weights are not read, as unpickling runs code of strangers"
            )
        if device == "cuda" and not torch.cuda.is_available():
            raise SplashbenchError(f"PyTorch finds no CUDA device for the checkpoint {self.folder}; use the CPU")
        self.device = device or ("cuda" if torch.cuda.is_available() else "cpu")
        processor = self._processor()
        self._mean, self._deviation = processor.image_mean, processor.image_std

    def _processor(self) -> _Normalisation:
        for name in _PROCESSOR_FILES:
            path = self.folder / name
            if path.is_file():
                data = read_json(path)
                inner = data.get("image_processor", data) if isinstance(data, dict) else data
                return validate_model(path, _Normalisation, inner)
        return _Normalisation()

    def finder(self) -> Any:
        """The model that finds what words describe, a `Sam3Model`."""
        require_transformers()
        from transformers.models.sam3.modeling_sam3 import Sam3Model

        return self._load(Sam3Model)

    def follower(self) -> Any:
        """The model that follows what is clicked, a `Sam3TrackerVideoModel`."""
        require_transformers()
        from transformers.models.sam3_tracker_video.modeling_sam3_tracker_video import Sam3TrackerVideoModel

        return self._load(Sam3TrackerVideoModel)

    def _load(self, kind: Any) -> Any:
        import torch

        try:
            with _quiet(), seeded(self.device):
                model, notes = kind.from_pretrained(
                    self.folder,
                    local_files_only=True,
                    use_safetensors=True,
                    output_loading_info=True,
                    dtype=torch.float32,
                    # PyTorch's own, whatever the file asks for: others would be fetched.
                    attn_implementation="sdpa",
                )
        # The library checks nothing of its own: a damaged file ends in whatever its reader stumbles over.
        except Exception as error:
            raise SplashbenchError(
                f"{self.folder}: the checkpoint cannot be loaded ({type(error).__name__}: {error}); copy it again"
            ) from None
        # The library fills what is missing with random numbers and goes on.
        absent = sorted(notes["missing_keys"]) + sorted(str(key) for key in notes["mismatched_keys"])
        if absent:
            raise SplashbenchError(
                f"{self.folder}: the weights lack {absent[0]}, or have it in another size"
                f" ({len(absent)} of this kind); give the whole SAM3 checkpoint"
            )
        size = model.config.vision_config.image_size
        if not (isinstance(size, int) and 1 <= size <= _MAX_IMAGE_SIZE):
            raise SplashbenchError(
                f"{self.folder / 'config.json'}: image_size is {size}, not a whole number up to {_MAX_IMAGE_SIZE}"
            )
        return model.eval().requires_grad_(False).to(self.device)

    def words(self, text: str, length: int) -> dict[str, Any]:
        """The model's input for `text`: `input_ids` and `attention_mask`, int64 [1, length] on the device."""
        require_transformers()
        from transformers import CLIPTokenizer

        # Without these the library goes on with a tokenizer that knows no word at all.
        if not any(all((self.folder / name).is_file() for name in names) for names in _TOKENIZER_FILES):
            raise SplashbenchError(
                f"{self.folder} has no tokenizer: neither {' nor '.join(' with '.join(n) for n in _TOKENIZER_FILES)};"
                " give the whole SAM3 checkpoint"
            )
        try:
            with _quiet():
                tokenizer = CLIPTokenizer.from_pretrained(self.folder, local_files_only=True)
                encoded = tokenizer(text, return_tensors="pt", padding="max_length", max_length=length)
        except Exception as error:  # as above
            raise SplashbenchError(
                f"{self.folder}: the tokenizer cannot be loaded ({type(error).__name__}: {error}); copy it again"
            ) from None
        n_tokens = encoded["input_ids"].shape[1]
        if n_tokens > length:
            raise SplashbenchError(
                f"{self.folder}: reads {length} tokens, and masks.text has {n_tokens}; shorten {text!r}"
            )
        return {name: encoded[name].to(self.device) for name in ("input_ids", "attention_mask")}

    def scaled(self, frame: NDArray[np.uint8], size: int) -> Any:
        """A frame [H, W, 3] as the models want it: float32 [1, 3, size, size] on the device."""
        import torch
        import torch.nn.functional as functional

        image = torch.tensor(frame).permute(2, 0, 1)[None]
        image = functional.interpolate(image, (size, size), mode="bilinear", antialias=True)
        mean, deviation = (torch.tensor(values).view(1, 3, 1, 1) * 255 for values in (self._mean, self._deviation))
        return ((image - mean) / deviation).to(self.device)


def require_transformers() -> None:
    """Raise SplashbenchError unless `transformers` can be imported."""
    # Read when the library is imported: nothing is ever fetched.
    os.environ.setdefault("HF_HUB_OFFLINE", "1")
    if importlib.util.find_spec("transformers") is None:
        raise SplashbenchError(f'masks.provider = "sam3" needs the package transformers; {INSTALL}')
    if importlib.util.find_spec("transformers.models.sam3_tracker_video") is None:
        raise SplashbenchError(f"the package transformers is too old to have SAM3; {INSTALL} --upgrade")


@contextmanager
def seeded(device: str) -> Iterator[None]:
    """Inference with fixed random numbers; those of the rest of the program stay as they were."""
    import torch

    with torch.random.fork_rng(devices=range(torch.cuda.device_count()) if device == "cuda" else []):
        torch.manual_seed(_SEED)
        with torch.inference_mode():
            yield


@contextmanager
def _quiet() -> Iterator[None]:
    """Without the library's bars and warnings; what matters in them becomes an error here."""
    from transformers.utils import logging

    verbosity, bars = logging.get_verbosity(), logging.is_progress_bar_enabled()
    logging.set_verbosity(logging.CRITICAL)
    logging.disable_progress_bar()
    try:
        yield
    finally:
        logging.set_verbosity(verbosity)
        if bars:
            logging.enable_progress_bar()

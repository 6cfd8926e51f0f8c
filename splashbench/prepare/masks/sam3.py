"""Liquid masks by SAM3, as the paper starts from (Sec. 3, "Annotations and protocol"; Sec. S1.3).

Words are looked for in every frame by itself: the mask is the union of the instances found with at least the given
confidence, 0.5 in the paper. Clicks on frames of a camera are followed through its other frames. Where a camera has
both, its mask is the union: the paper's corrections of SAM3 are "almost entirely additive", so clicks are for what the
words miss, such as water that stands in a glass. Clicks on what is not liquid bound what the other clicks mean; they
take nothing from what the words find.
"""

from __future__ import annotations

import importlib.metadata
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from splashbench.errors import SplashbenchError
from splashbench.prepare.masks.provider import Mask
from splashbench.prepare.masks.sam3_checkpoint import Sam3Checkpoint, seeded
from splashbench.prepare.masks.sam3_tracking import ReadFrames, follow
from splashbench.prepare.session_tables import MaskClick
from splashbench.prepare.stage_cache import facts_of

DEFAULT_TEXT = "liquid"
DEFAULT_CONFIDENCE = 0.5
_MASK_PROBABILITY = 0.5


class Sam3Masks:
    """Masks by SAM3 from a checkpoint on disk; a `MaskProvider`.

    `read_frames(camera, indices)` yields (index, frame [H, W, 3] in sRGB) for indices that increase. The models are
    loaded when first needed and kept.
    """

    name = "sam3"

    def __init__(
        self,
        read_frames: ReadFrames,
        checkpoint: Path,
        sources: Mapping[str, str],
        *,
        text: str = DEFAULT_TEXT,
        points: Mapping[str, Sequence[MaskClick]] | None = None,
        confidence: float = DEFAULT_CONFIDENCE,
        device: Literal["cpu", "cuda"] | None = None,
    ) -> None:
        """
        Args:
            sources: camera -> file to name in errors.
            text: what to look for; empty to go by clicks alone.
            points: camera -> clicks on its raw frames.
            device: "cuda" where there is one by default.

        Raises SplashbenchError where `transformers` is missing, the checkpoint is none or cannot do what is asked, or
        a camera has neither words nor clicks.
        """
        self._read_frames = read_frames
        self._sources = sources
        self._text = text.strip()
        self._points = dict(points or {})
        self._confidence = confidence
        unknown = sorted(set(self._points) - set(sources))
        if unknown:
            raise SplashbenchError(f"masks.points names camera {unknown[0]}, which is none; correct session.toml")
        without = [camera for camera in sources if camera not in self._points]
        if not self._text and without:
            raise SplashbenchError(
                f"{sources[without[0]]}: camera {without[0]} has neither masks.text nor masks.points;"
                " give one in session.toml"
            )
        self._checkpoint = Sam3Checkpoint(checkpoint, device)
        if self._text and not self._checkpoint.finds:
            raise SplashbenchError(f'{checkpoint} holds SAM3\'s tracker alone; set masks.text = "", or give it whole')
        if self._points and not self._checkpoint.follows:
            raise SplashbenchError(f"{checkpoint} holds SAM3's detector alone; drop masks.points, or give it whole")
        self._finder: _Finder | None = None
        self._follower: Any = None

    def made_from(self, camera: str, indices: Sequence[int]) -> Mapping[str, Any]:
        """See `MaskProvider.made_from`: prompts, the checkpoint's files, and the device, whose outlines may differ."""
        return {
            "text": self._text,
            "points": [click.model_dump() for click in self._points.get(camera, ())],
            "confidence": self._confidence,
            "checkpoint": facts_of([self._checkpoint.folder]),
            "device": self._checkpoint.device,
            **{name: importlib.metadata.version(name) for name in ("torch", "transformers")},
        }

    def masks(self, camera: str, indices: Sequence[int]) -> Iterator[tuple[int, Mask]]:
        """See `MaskProvider.masks`."""
        followed: Mapping[int, Any] = {}
        if camera in self._points:
            if self._follower is None:
                self._follower = self._checkpoint.follower()
            followed = follow(
                self._checkpoint,
                self._follower,
                lambda frames: self._read_frames(camera, frames),
                self._points[camera],
                indices,
                self._sources[camera],
            )
        if self._text and self._finder is None:
            self._finder = _Finder(self._checkpoint, self._text, self._confidence)
        for index, frame in self._read_frames(camera, indices):
            height, width = frame.shape[:2]
            mask = np.zeros((height, width), bool)
            if self._finder is not None:
                mask |= self._finder(frame)
            if index in followed:
                mask |= _above(followed[index], 0.0, height, width)
            yield index, mask


class _Finder:
    """Looks for one text in single frames."""

    def __init__(self, checkpoint: Sam3Checkpoint, text: str, confidence: float) -> None:
        self._checkpoint = checkpoint
        self._model = checkpoint.finder()
        self._words = checkpoint.words(text, self._model.config.text_config.max_position_embeddings)
        self._confidence = confidence

    def __call__(self, frame: NDArray[np.uint8]) -> Mask:
        """The union of the instances found, [H, W]."""
        pixels = self._checkpoint.scaled(frame, self._model.config.vision_config.image_size)
        with seeded(self._checkpoint.device):
            output = self._model(pixel_values=pixels, **self._words)
        # An instance's score is its own times that of the concept's being in the image at all.
        scores = output.pred_logits[0].sigmoid() * output.presence_logits[0].sigmoid()
        height, width = frame.shape[:2]
        union = np.zeros((height, width), bool)
        # One by one: all at once, two hundred masks of a 4K frame are seven gigabytes.
        for instance in output.pred_masks[0][scores > self._confidence]:
            union |= _above(instance.sigmoid()[None, None], _MASK_PROBABILITY, height, width)
        return union


def _above(values: Any, limit: float, height: int, width: int) -> Mask:
    """Where `values` [1, 1, h, w], enlarged bilinearly to [height, width], exceed the limit."""
    import torch.nn.functional as functional

    enlarged = functional.interpolate(values, (height, width), mode="bilinear", align_corners=False)
    return np.asarray((enlarged[0, 0] > limit).cpu().numpy())

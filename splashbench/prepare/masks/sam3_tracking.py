"""Liquid followed through the frames of one camera from a person's clicks, by SAM3's memory of earlier frames.

The frames with clicks come first and are the memory's anchors. From the earliest of them the rest follows forwards,
then backwards, as in the library's propagation. Frames come one by one, and only those that the memory can still reach
stay loaded, so the length of a recording does not matter.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from splashbench.errors import SplashbenchError
from splashbench.prepare.masks.sam3_checkpoint import Sam3Checkpoint, seeded
from splashbench.prepare.session_tables import MaskClick

# (camera, increasing source frames) -> (source frame, image [H, W, 3])
ReadFrames = Callable[[str, Sequence[int]], Iterator[tuple[int, NDArray[np.uint8]]]]

_OBJECT = 0
# Frames held at a time while going backwards, as recordings are read forwards.
_BLOCK = 8


def follow(
    checkpoint: Sam3Checkpoint,
    model: Any,
    read: Callable[[Sequence[int]], Iterator[tuple[int, NDArray[np.uint8]]]],
    clicks: Sequence[MaskClick],
    indices: Sequence[int],
    source: str,
) -> Mapping[int, Any]:
    """Follow the liquid clicked through the frames `indices` of one camera.

    read: source frames, increasing, to (frame, image [H, W, 3]). source: the file to name in errors.
    Returns for each of `indices` the logit of liquid, float32 [1, 1, h, w] at the model's own resolution.
    Raises SplashbenchError for a click outside the image.
    """
    memory = _Memory(checkpoint, model)
    order = sorted({*indices, *(click.frame for click in clicks)})
    place = {frame: position for position, frame in enumerate(order)}
    clicked: dict[int, list[MaskClick]] = {}
    for click in clicks:
        clicked.setdefault(click.frame, []).append(click)
    logits = {}
    for frame, image in read(sorted(clicked)):
        height, width = image.shape[:2]
        for click in clicked[frame]:
            if click.x > width or click.y > height:
                raise SplashbenchError(
                    f"{source}: the click at ({click.x:g}, {click.y:g}) lies outside its frames of {width}x{height};"
                    " correct masks.points in session.toml"
                )
        logits[frame] = memory.anchor(place[frame], image, clicked[frame])
    first = min(clicked)
    after = [frame for frame in order if frame > first and frame not in clicked]
    for frame, image in read(after) if after else ():
        logits[frame] = memory.step(place[frame], image, backwards=False)
    before = [frame for frame in order if frame < first]
    while before:
        before, block = before[:-_BLOCK], before[-_BLOCK:]
        for frame, image in reversed(list(read(block))):
            logits[frame] = memory.step(place[frame], image, backwards=True)
    return {frame: logits[frame] for frame in indices}


class _Memory:
    """The library's inference session, of one object, fed frame by frame."""

    def __init__(self, checkpoint: Sam3Checkpoint, model: Any) -> None:
        import torch
        from transformers.models.sam3_tracker_video.modeling_sam3_tracker_video import Sam3TrackerVideoInferenceSession

        self._checkpoint = checkpoint
        self._model = model
        self._size: int = model.config.vision_config.image_size
        self._reach = max(model.config.num_maskmem, model.config.max_object_pointers_in_encoder)
        self._session = Sam3TrackerVideoInferenceSession(
            inference_device=checkpoint.device, inference_state_device=checkpoint.device, dtype=torch.float32
        )
        self._first: int | None = None

    def anchor(self, position: int, image: NDArray[np.uint8], clicks: Sequence[MaskClick]) -> Any:
        """A frame with clicks, the earliest first; returns its logits."""
        import torch

        height, width = image.shape[:2]
        scale = torch.tensor([self._size / width, self._size / height])
        points = torch.tensor([[click.x, click.y] for click in clicks]) * scale
        labels = torch.tensor([int(click.liquid) for click in clicks], dtype=torch.int32)
        number = self._session.obj_id_to_idx(_OBJECT)
        prompt = {"point_coords": points[None, None], "point_labels": labels[None, None]}
        self._session.add_point_inputs(number, position, prompt)
        self._session.obj_with_new_inputs = [_OBJECT]
        if self._first is None:
            self._first = position
        return self.step(position, image, backwards=False)

    def step(self, position: int, image: NDArray[np.uint8], backwards: bool) -> Any:
        """The next frame in the direction of travel; returns its logits."""
        pixels = self._checkpoint.scaled(image, self._size)
        with seeded(self._checkpoint.device):
            output = self._model(self._session, frame=pixels, frame_idx=position, reverse=backwards)
        self._forget(position)
        return output.pred_masks.float()

    def _forget(self, position: int) -> None:
        """Drop what no later frame can refer to; what is near the first anchor serves both directions."""
        assert self._first is not None
        self._session.processed_frames.clear()
        outputs = self._session.output_dict_per_obj[0]
        for frame_output in (*outputs["cond_frame_outputs"].values(), *outputs["non_cond_frame_outputs"].values()):
            frame_output.pop("high_res_masks", None)
        tracked = outputs["non_cond_frame_outputs"]
        for other in list(tracked):
            if min(abs(other - position), abs(other - self._first)) > self._reach:
                del tracked[other]

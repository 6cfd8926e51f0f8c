"""SAM3 masks from a tiny checkpoint with random weights: loading, words, clicks, and everything that is refused."""

from __future__ import annotations

import importlib.util
import json
import os
import socket
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from splashbench.errors import SplashbenchError
from splashbench.prepare.masks.sam3 import Sam3Masks
from splashbench.prepare.masks.sam3_checkpoint import Sam3Checkpoint
from splashbench.prepare.session_tables import MaskClick

# transformers for Python 3.10 compiles in the old way.
pytestmark = pytest.mark.filterwarnings("ignore:`torch.jit.script` is deprecated:DeprecationWarning")

WIDTH, HEIGHT = 90, 60
SIZE = 56  # of the checkpoint's images, see conftest
needs_transformers = pytest.mark.skipif(
    importlib.util.find_spec("transformers") is None, reason="needs transformers, of the extra [sam3]"
)


@pytest.fixture(autouse=True)
def one_thread() -> Iterator[None]:
    """Threads cost far more than they save on so small a model."""
    import torch

    before = torch.get_num_threads()
    torch.set_num_threads(1)
    yield
    torch.set_num_threads(before)


@pytest.fixture(autouse=True)
def no_network(monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(*_: Any, **__: Any) -> None:
        raise AssertionError("something reached for the network")

    monkeypatch.setattr(socket.socket, "connect", refuse)
    monkeypatch.setattr(socket, "getaddrinfo", refuse)


def picture(index: int) -> np.ndarray:
    """Frame `index` of a drop that falls over a mottled table, [H, W, 3]."""
    rng = np.random.default_rng(0)
    image = rng.integers(40, 200, (HEIGHT // 6, WIDTH // 6, 3)).repeat(6, 0).repeat(6, 1)
    rows, columns = np.mgrid[:HEIGHT, :WIDTH]
    image[np.hypot(columns - 45, rows - 5 - 2 * index) < 9] = (220, 30, 40)
    return image.astype(np.uint8)


class Recorded:
    """A stand-in for recordings, which remembers what was read."""

    def __init__(self) -> None:
        self.read: list[list[int]] = []

    def __call__(self, camera: str, indices: Sequence[int]) -> Iterator[tuple[int, np.ndarray]]:
        assert list(indices) == sorted(set(indices))
        self.read.append(list(indices))
        return ((index, picture(index)) for index in indices)


SOURCES = {"1": "pour/GX010001.MP4"}


def provider(folder: Path, **options: Any) -> Sam3Masks:
    return Sam3Masks(Recorded(), folder, SOURCES, device="cpu", **options)


def reference_finder(folder: Path, text: str, confidence: float, index: int) -> np.ndarray:
    """The union of instances by the steps of the library's own post-processing, all instances at once."""
    import torch
    from transformers import CLIPTokenizer
    from transformers.models.sam3.modeling_sam3 import Sam3Model

    model = Sam3Model.from_pretrained(folder, attn_implementation="eager").eval()
    tokens = CLIPTokenizer.from_pretrained(folder)(text, return_tensors="pt", padding="max_length", max_length=32)
    pixels = Sam3Checkpoint(folder, "cpu").scaled(picture(index), SIZE)
    with torch.no_grad():
        found = model(pixel_values=pixels, input_ids=tokens.input_ids, attention_mask=tokens.attention_mask)
    scores = (found.pred_logits.sigmoid() * found.presence_logits.sigmoid())[0]
    masks = torch.nn.functional.interpolate(found.pred_masks.sigmoid(), (HEIGHT, WIDTH), mode="bilinear")[0]
    return np.asarray((masks[scores > confidence] > 0.5).any(0).numpy())


@needs_transformers
def test_words_give_the_union_of_confident_instances_in_raw_geometry(checkpoint: Path) -> None:
    found = dict(provider(checkpoint, text="red water", confidence=0.36).masks("1", [3, 8, 20]))
    assert list(found) == [3, 8, 20]
    for index, mask in found.items():
        assert mask.shape == (HEIGHT, WIDTH)
        assert mask.dtype == bool
        assert 0 < mask.mean() < 1
        # Attention in another order of sums moves values on the very outline.
        assert (mask != reference_finder(checkpoint, "red water", 0.36, index)).mean() < 1e-3
    other = dict(provider(checkpoint, text="a blue cup", confidence=0.36).masks("1", [3]))
    assert (other[3] != found[3]).any()
    assert not any(mask.any() for _, mask in provider(checkpoint, confidence=0.999).masks("1", [3, 8]))


@needs_transformers
def test_masks_are_the_same_each_time_and_leave_the_random_numbers_alone(checkpoint: Path) -> None:
    import torch

    clicks = {"1": [MaskClick(frame=4, x=45, y=15)]}
    torch.manual_seed(5)
    first = list(provider(checkpoint, points=clicks, confidence=0.36).masks("1", [2, 4, 6]))
    drawn = torch.rand(3)
    torch.manual_seed(6)
    again = list(provider(checkpoint, points=clicks, confidence=0.36).masks("1", [2, 4, 6]))
    assert [index for index, _ in first] == [2, 4, 6]
    for (_, a), (_, b) in zip(first, again):
        np.testing.assert_array_equal(a, b)
    torch.manual_seed(5)
    assert (torch.rand(3) == drawn).all()


@needs_transformers
def test_clicks_are_followed_as_the_library_follows_them(checkpoint: Path) -> None:
    """Frame by frame, with what is out of reach forgotten, against the library with the whole clip in memory."""
    import torch
    from transformers.models.sam3_tracker_video.modeling_sam3_tracker_video import (
        Sam3TrackerVideoInferenceSession,
        Sam3TrackerVideoModel,
    )

    indices = list(range(0, 54, 3))  # 18 frames, and the memory reaches 4
    clicks = [
        MaskClick(frame=30, x=45, y=40),
        MaskClick(frame=30, x=5, y=5, liquid=False),
        MaskClick(frame=36, x=50.5, y=30.25),
    ]
    recorded = Recorded()
    masks = Sam3Masks(recorded, checkpoint, SOURCES, text="", points={"1": clicks}, device="cpu")
    found = dict(masks.masks("1", indices))
    assert list(found) == indices
    assert max(len(block) for block in recorded.read[2:-1]) <= 8  # backwards in blocks

    model = Sam3TrackerVideoModel.from_pretrained(checkpoint, attn_implementation="sdpa").eval()
    scale = Sam3Checkpoint(checkpoint, "cpu").scaled
    video = torch.cat([scale(picture(index), SIZE) for index in indices])
    session = Sam3TrackerVideoInferenceSession(video, HEIGHT, WIDTH, dtype=torch.float32)
    for frame, marked in ((10, clicks[:2]), (12, clicks[2:])):
        points = torch.tensor([[[[c.x * SIZE / WIDTH, c.y * SIZE / HEIGHT] for c in marked]]])
        labels = torch.tensor([[[int(c.liquid) for c in marked]]], dtype=torch.int32)
        number = session.obj_id_to_idx(0)
        session.add_point_inputs(number, frame, {"point_coords": points, "point_labels": labels})
        session.obj_with_new_inputs = [0]
        model(session, frame_idx=frame)
    expected = {}
    for backwards in (False, True):
        for output in model.propagate_in_video_iterator(session, 10, reverse=backwards):
            expected[indices[output.frame_idx]] = output.pred_masks
    assert sorted(expected) == indices
    areas = set()
    for index, logits in expected.items():
        whole = torch.nn.functional.interpolate(logits, (HEIGHT, WIDTH), mode="bilinear")[0, 0] > 0
        np.testing.assert_array_equal(found[index], whole.numpy())
        areas.add(int(whole.sum()))
    assert len(areas) > 3


@needs_transformers
def test_clicks_may_be_on_frames_that_are_not_asked_for(checkpoint: Path) -> None:
    clicks = {"1": [MaskClick(frame=15, x=45, y=35)]}
    found = dict(provider(checkpoint, text="", points=clicks).masks("1", [2, 9, 21]))
    assert list(found) == [2, 9, 21]
    words = dict(provider(checkpoint, confidence=0.36).masks("1", [2, 9, 21]))
    both = dict(provider(checkpoint, confidence=0.36, points=clicks).masks("1", [2, 9, 21]))
    for index in both:
        np.testing.assert_array_equal(both[index], words[index] | found[index])


@needs_transformers
def test_images_are_scaled_as_the_processor_scales_them(checkpoint: Path) -> None:
    """The processor follows Pillow's bilinear filter on 8-bit values, to a rounding."""
    from PIL import Image

    image = picture(7)
    pixels = Sam3Checkpoint(checkpoint, "cpu").scaled(image, SIZE)
    assert tuple(pixels.shape) == (1, 3, SIZE, SIZE)
    grey_levels = pixels[0].permute(1, 2, 0).numpy() * 127.5 + 127.5
    np.testing.assert_allclose(grey_levels, grey_levels.round(), atol=1e-4)
    expected = np.asarray(Image.fromarray(image).resize((SIZE, SIZE), Image.Resampling.BILINEAR))
    assert np.abs(grey_levels - expected).max() < 1.5


@needs_transformers
def test_other_normalisation_is_taken_from_the_checkpoint(copied: Path) -> None:
    plain = Sam3Checkpoint(copied, "cpu").scaled(picture(0), SIZE)
    (copied / "preprocessor_config.json").unlink()
    settings = {"image_processor": {"image_mean": [0.25, 0.5, 0.5], "image_std": [0.5, 0.5, 1.0]}}
    (copied / "processor_config.json").write_text(json.dumps(settings))
    other = Sam3Checkpoint(copied, "cpu").scaled(picture(0), SIZE)
    np.testing.assert_allclose(other[0, 0], plain[0, 0] + 0.5, atol=1e-6)
    np.testing.assert_allclose(other[0, 2], plain[0, 2] / 2, atol=1e-6)
    settings["image_processor"]["image_std"] = [0.5, 0.0, 0.5]
    (copied / "processor_config.json").write_text(json.dumps(settings))
    with pytest.raises(SplashbenchError, match=r"processor_config\.json: image_std"):
        Sam3Checkpoint(copied, "cpu")


@needs_transformers
def test_pickled_weights_are_not_read(copied: Path, tmp_path: Path) -> None:
    import torch

    class Trap:
        def __reduce__(self) -> tuple[Any, ...]:
            return os.mkdir, (str(tmp_path / "sprung"),)

    (copied / "model.safetensors").unlink()
    torch.save(Trap(), copied / "pytorch_model.bin")
    with pytest.raises(SplashbenchError, match=r"checkpoint has no \*\.safetensors"):
        provider(copied)
    (copied / "other.safetensors").write_bytes(b"")
    with pytest.raises(SplashbenchError, match="cannot be loaded"):
        next(iter(provider(copied).masks("1", [0])))
    assert not (tmp_path / "sprung").exists()


@needs_transformers
def test_weights_that_lack_something_are_refused_and_not_made_up(copied: Path) -> None:
    from safetensors.torch import load_file, save_file

    weights = load_file(copied / "model.safetensors")
    del weights["detector_model.text_projection.weight"]
    save_file(weights, copied / "model.safetensors", metadata={"format": "pt"})
    with pytest.raises(SplashbenchError, match=r"the weights lack text_projection\.weight"):
        next(iter(provider(copied).masks("1", [0])))
    weights["detector_model.text_projection.weight"] = weights["detector_model.text_projection.bias"].clone()
    save_file(weights, copied / "model.safetensors", metadata={"format": "pt"})
    with pytest.raises(SplashbenchError, match=r"checkpoint"):
        next(iter(provider(copied).masks("1", [0])))


@needs_transformers
def test_damaged_weights_and_a_missing_tokenizer_are_one_line(copied: Path) -> None:
    (copied / "merges.txt").unlink()
    with pytest.raises(
        SplashbenchError, match=r"no tokenizer: neither tokenizer\.json nor vocab\.json with merges\.txt"
    ):
        next(iter(provider(copied).masks("1", [0])))
    (copied / "tokenizer.json").write_text("{")
    with pytest.raises(SplashbenchError, match="the tokenizer cannot be loaded"):
        next(iter(provider(copied).masks("1", [0])))
    whole = (copied / "model.safetensors").read_bytes()
    (copied / "model.safetensors").write_bytes(whole[: len(whole) // 2])
    with pytest.raises(SplashbenchError, match="the checkpoint cannot be loaded"):
        next(iter(provider(copied).masks("1", [0])))


@needs_transformers
def test_what_a_checkpoint_cannot_do_is_said_before_it_is_loaded(copied: Path) -> None:
    def retype(kind: str) -> None:
        config = json.loads((copied / "config.json").read_text())
        (copied / "config.json").write_text(json.dumps(config | {"model_type": kind}))

    clicks = {"1": [MaskClick(frame=1, x=1, y=1)]}
    retype("sam3")
    with pytest.raises(SplashbenchError, match="detector alone"):
        provider(copied, points=clicks)
    retype("sam3_tracker_video")
    with pytest.raises(SplashbenchError, match="tracker alone"):
        provider(copied, points=clicks)
    provider(copied, text="", points=clicks)
    retype("llama")
    with pytest.raises(SplashbenchError, match=r"config\.json: model_type is 'llama'"):
        provider(copied)
    (copied / "config.json").unlink()
    with pytest.raises(SplashbenchError, match=r"config\.json does not exist"):
        provider(copied)
    with pytest.raises(SplashbenchError, match="nowhere is not a folder"):
        provider(copied / "nowhere")


@needs_transformers
def test_prompts_that_make_no_sense_are_one_line(checkpoint: Path) -> None:
    outside = provider(checkpoint, text="", points={"1": [MaskClick(frame=1, x=WIDTH + 1, y=1)]})
    with pytest.raises(
        SplashbenchError, match=r"GX010001\.MP4: the click at \(91, 1\) lies outside its frames of 90x60"
    ):
        list(outside.masks("1", [1, 2]))
    with pytest.raises(SplashbenchError, match="camera 1 has neither"):
        provider(checkpoint, text=" ")
    with pytest.raises(SplashbenchError, match="names camera 7"):
        provider(checkpoint, points={"7": [MaskClick(frame=1, x=1, y=1)]})
    with pytest.raises(SplashbenchError, match="reads 32 tokens"):
        list(provider(checkpoint, text="liquid " * 25).masks("1", [1]))


def test_without_the_package_one_line_says_what_to_install(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: None)
    with pytest.raises(SplashbenchError, match=r"pip install -c constraints.txt -e '\.\[sam3\]'") as caught:
        provider(tmp_path)
    assert "\n" not in str(caught.value)

"""A tiny SAM3 checkpoint with random weights."""

from __future__ import annotations

import json
import shutil
from pathlib import Path
from typing import Any

import pytest

from splashbench.prepare.masks import sam3_checkpoint

SIZE, PATCH = 56, 14
GRID = SIZE // PATCH
# Channels: the library has 64 for its memory written into it, and needs more than these elsewhere.
WIDE = 128


def tiny_config() -> dict[str, Any]:
    """The published checkpoint's shape with the smallest numbers that work."""
    small = {"hidden_size": 16, "num_attention_heads": 2, "intermediate_size": 32}
    wide = small | {"hidden_size": WIDE}
    backbone = small | {
        "model_type": "sam3_vit_model",
        "num_hidden_layers": 2,
        "image_size": SIZE,
        "patch_size": PATCH,
        "window_size": 2,
        "global_attn_indexes": [1],
        "pretrain_image_size": 28,
    }
    vision = {
        "model_type": "sam3_vision_model",
        "backbone_config": backbone,
        "fpn_hidden_size": WIDE,
        "backbone_feature_sizes": [[4 * GRID] * 2, [2 * GRID] * 2, [GRID] * 2],
    }
    text = small | {
        "model_type": "clip_text_model",
        "vocab_size": 600,
        "projection_dim": 8,
        "num_hidden_layers": 1,
        "max_position_embeddings": 32,
        "bos_token_id": 512,
        "eos_token_id": 513,
        "pad_token_id": 513,
    }
    detector = {
        "vision_config": vision,
        "text_config": text,
        "geometry_encoder_config": wide | {"num_layers": 1},
        "detr_encoder_config": wide | {"num_layers": 1},
        "detr_decoder_config": wide | {"num_layers": 1, "num_queries": 6},
        "mask_decoder_config": {"hidden_size": WIDE, "num_attention_heads": 2},
    }
    tracker = {
        "vision_config": vision,
        "prompt_encoder_config": {"hidden_size": WIDE, "image_size": SIZE, "mask_input_channels": 4},
        "mask_decoder_config": {
            "hidden_size": WIDE,
            "mlp_dim": 32,
            "num_attention_heads": 2,
            "iou_head_hidden_dim": 16,
        },
        "memory_attention_hidden_size": WIDE,
        "memory_attention_num_layers": 1,
        "memory_attention_feed_forward_hidden_size": 32,
        "memory_encoder_hidden_size": WIDE,
        "memory_encoder_output_channels": 64,
        "memory_attention_rope_feat_sizes": [GRID, GRID],
        "mask_downsampler_embed_dim": WIDE,
        "memory_fuser_embed_dim": WIDE,
        "memory_fuser_intermediate_dim": 16,
        "memory_fuser_num_layers": 1,
        "image_size": SIZE,
        "num_maskmem": 3,
        "max_object_pointers_in_encoder": 4,
    }
    return {"detector_config": detector, "tracker_config": tracker, "low_res_mask_size": 4 * GRID}


def write_tokenizer(folder: Path) -> None:
    """CLIP's tokenizer over single bytes: 256 symbols, each also at the end of a word, a few merges."""
    symbols = [chr(c) for c in [*range(33, 127), *range(161, 173), *range(174, 256), *range(256, 324)]]
    assert len(symbols) == 256
    words = [*symbols, *(f"{s}</w>" for s in symbols), "<|startoftext|>", "<|endoftext|>", "re", "wa"]
    (folder / "vocab.json").write_text(json.dumps({word: n for n, word in enumerate(words)}))
    (folder / "merges.txt").write_text("#version: 0.2\nr e\nw a\n")


@pytest.fixture(scope="module")
def checkpoint(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder like that of the published checkpoint, with random weights."""
    pytest.importorskip("transformers", reason="needs transformers, of the extra [sam3]")
    import torch
    from transformers import Sam3VideoConfig
    from transformers.models.sam3_video.modeling_sam3_video import Sam3VideoModel

    folder = tmp_path_factory.mktemp("sam3")
    with torch.random.fork_rng(), sam3_checkpoint._quiet():
        torch.manual_seed(5)
        model = Sam3VideoModel(Sam3VideoConfig(**tiny_config()))
        # As they are drawn they are so small that no input makes a difference to the output.
        for parameter in model.parameters():
            if parameter.ndim > 1:
                parameter.data.normal_(0.0, parameter[0].numel() ** -0.5)
        model.save_pretrained(folder)
    write_tokenizer(folder)
    settings = {"image_mean": [0.5] * 3, "image_std": [0.5] * 3, "size": {"height": SIZE, "width": SIZE}}
    (folder / "preprocessor_config.json").write_text(json.dumps(settings))
    return folder


@pytest.fixture
def copied(checkpoint: Path, tmp_path: Path) -> Path:
    """A copy of the checkpoint that the test may damage."""
    return Path(shutil.copytree(checkpoint, tmp_path / "checkpoint"))

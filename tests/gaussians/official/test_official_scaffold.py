"""Models of the official 4D-Scaffold-GS: files of the published layout against the published formula."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import official_layouts as layouts
import official_reference as reference
import pytest
from official_comparison import (
    anchor_rows,
    assert_same_image,
    assert_same_when_loaded,
    lens_of,
    named,
)

from splashbench.errors import SplashbenchError
from splashbench.files import read_json
from splashbench.gaussians.official.model import OfficialFitted
from splashbench.scene import Camera, Scene
from splashbench_methods.scaffold_4d.official import OfficialScaffold4D, in_the_image

POINTS = 20


class TestScaffold:
    def expected(self, rows: np.ndarray, heads: dict, camera: Camera, t: float, **variant: object) -> np.ndarray:
        lens = lens_of(camera)._replace(slopes=(np.tan(-0.5), np.tan(-0.5)))
        eye = -lens.R.T @ lens.t
        shown = [row for row in named(layouts.ANCHORS, rows) if reference.anchor_shows(row, lens)]
        gaussians = [g for row in shown for g in reference.anchor_at(row, heads, t, eye, **variant)]
        return np.clip(reference.draw(gaussians, lens), 0, 1)

    def model(
        self, out: Path, export: Path, scene: Scene, rows: np.ndarray, heads: dict, traced: bool = True, **words: object
    ) -> OfficialFitted:
        layouts.write_scaffold(out, rows, heads, traced, **words)
        return OfficialScaffold4D().read(out, export, scene.training())

    @pytest.mark.parametrize(
        ("words", "variant"),
        [
            ({}, {}),
            ({"temporal_opacity": "4dgs", "use_flow": False}, {"ours": False, "flows": False}),
            ({"hparam_beta": 2.0, "frame_ratio": 1.0}, {"beta": 2.0}),
        ],
    )
    def test_it_is_the_published_formula(
        self, late: Scene, blender: Path, tmp_path: Path, words: dict, variant: dict
    ) -> None:
        rng = np.random.default_rng(1)
        rows, heads = anchor_rows(rng), layouts.scaffold_heads(rng)
        assert rows.shape[1] == 89
        fitted = self.model(tmp_path, blender, late, rows, heads, traced=not words, **words)
        camera, facts = late.cameras["7"], read_json(blender / "splashbench.json")
        seconds = float(late.camera_times["7"][4])
        t = (seconds - facts["time_origin_seconds"]) / facts["time_span_seconds"] * words.get("frame_ratio", 0.33)
        wanted = self.expected(rows, heads, camera, t, **variant)
        assert_same_image(fitted.render(camera, seconds).rgb, wanted)

    def test_anchors_that_do_not_show_give_nothing(self, late: Scene, blender: Path, tmp_path: Path) -> None:
        rng = np.random.default_rng(2)
        rows, heads = anchor_rows(rng, 24), layouts.scaffold_heads(rng)
        camera = late.cameras["6"]
        # All about the frame, a good deal of them just outside.
        pixels = rng.uniform([-30, -30], [126, 94], (24, 2))
        rays = np.concatenate([(pixels - camera.K[:2, 2]) / camera.K[[0, 1], [0, 1]], np.ones((24, 1))], axis=1)
        rows[:, :3] = np.float32(camera.center + 1.5 * rays @ camera.w2c[:3, :3])
        for i in range(3):
            rows[:, layouts.ANCHORS.index(f"scale_{i}")] = np.float32(-4.0)
        lens = lens_of(camera)._replace(slopes=(np.tan(-0.5), np.tan(-0.5)))
        shown = [reference.anchor_shows(row, lens) for row in named(layouts.ANCHORS, rows)]
        assert 5 < sum(shown) < 20
        fitted = self.model(tmp_path, blender, late, rows, heads, traced=False)
        found = in_the_image(
            fitted.model.positions[:, :3], fitted.model.log_scales.detach()[:, :3], camera, fitted.model.near
        )
        assert found.tolist() == shown
        seconds = float(late.camera_times["6"][3])
        t = fitted.model_time(seconds)
        assert_same_image(fitted.render(camera, seconds).rgb, self.expected(rows, heads, camera, t))

    def test_a_loaded_model_renders_the_same(self, late: Scene, blender: Path, tmp_path: Path) -> None:
        rng = np.random.default_rng(3)
        words = {"temporal_opacity": "4dgs", "white_background": True}
        fitted = self.model(
            tmp_path / "out", blender, late, anchor_rows(rng, 12), layouts.scaffold_heads(rng), False, **words
        )
        assert_same_when_loaded(OfficialScaffold4D(), fitted, late, tmp_path / "model")

    @pytest.mark.parametrize(
        ("words", "message"),
        [
            ({"appearance_dim": 32}, "cfg_args: colours depend on .*; train with --appearance_dim 0"),
            ({"use_feat_bank": True}, "cfg_args: models with --use_feat_bank are not read; train without it"),
        ],
    )
    def test_other_models_are_refused_by_name(
        self, late: Scene, blender: Path, tmp_path: Path, words: dict, message: str
    ) -> None:
        rng = np.random.default_rng(4)
        with pytest.raises(SplashbenchError, match=message):
            self.model(tmp_path, blender, late, anchor_rows(rng), layouts.scaffold_heads(rng), False, **words)

    def test_other_sizes_are_named(self, late: Scene, blender: Path, tmp_path: Path) -> None:
        rng = np.random.default_rng(5)
        with pytest.raises(SplashbenchError, match=r"cov_mlp\.pt: 2\.weight is float32 \[40, 32\], not .* \[80, 32\]"):
            self.model(tmp_path, blender, late, anchor_rows(rng), layouts.scaffold_heads(rng, 5) | {
                "opacity_mlp": layouts.scaffold_heads(rng)["opacity_mlp"]
            })  # fmt: skip

"""Models of the official SpacetimeGaussians: files of the published layout against the published formula."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import official_layouts as layouts
import official_reference as reference
import pytest
from official_comparison import (
    assert_same_image,
    assert_same_when_loaded,
    lens_of,
    named,
    rows_of,
)

from splashbench.errors import SplashbenchError
from splashbench.gaussians.official.model import OfficialFitted
from splashbench.scene import Scene
from splashbench_methods.spacetime_gaussians.official import OfficialSpacetimeGaussians

POINTS = 20


class TestSpacetime:
    def decoder(self, rng: np.random.Generator) -> dict[str, np.ndarray]:
        return {"mlp1.weight": rng.normal(0, 0.5, (6, 12, 1, 1)), "mlp2.weight": rng.normal(0, 0.5, (3, 6, 1, 1))}

    def model(
        self, out: Path, scene: Scene, rows: np.ndarray, decoder: dict | None = None, **arguments: object
    ) -> OfficialFitted:
        layouts.write_spacetime(out, rows, decoder, **arguments)
        return OfficialSpacetimeGaussians().read(out, out, scene.training())

    @pytest.mark.parametrize("ending", ["sandwich", "sandwichnoact"])
    def test_the_full_model_is_the_published_formula(self, late: Scene, tmp_path: Path, ending: str) -> None:
        rng = np.random.default_rng(1)
        rows = rows_of(layouts.FULL, rng, trbf_center=rng.uniform(0, 1, 6))
        assert rows.shape[1] == 38
        decoder = self.decoder(rng)
        fitted = self.model(tmp_path, late, rows, decoder, rgbfunction=ending)
        camera, lens = late.cameras["6"], lens_of(late.cameras["6"])
        for t in (0, 5):
            gaussians = [reference.spacetime_at(row, t / 8) for row in named(layouts.FULL, rows)]
            wanted = reference.sandwich(reference.draw(gaussians, lens), lens, decoder, ending == "sandwich")
            got = fitted.render(camera, float(late.camera_times["6"][t])).rgb
            assert_same_image(got, wanted)

    def test_the_lite_model_is_the_published_formula(self, late: Scene, tmp_path: Path) -> None:
        rng = np.random.default_rng(2)
        rows = rows_of(layouts.LITE, rng, trbf_center=rng.uniform(0, 1, 6))
        assert rows.shape[1] == 32
        arguments = {"rgbfunction": "None", "loader": "colmap", "source_path": "/data/colmap_2", "duration": 5}
        fitted = self.model(tmp_path, late, rows, **arguments)
        camera = late.cameras["7"]
        for t in (2, 6):
            gaussians = [reference.spacetime_at(row, (t - 2) / 5) for row in named(layouts.LITE, rows)]
            wanted = np.clip(reference.draw(gaussians, lens_of(camera, centered=True)), 0, 1)
            got = fitted.render(camera, float(late.camera_times["7"][t])).rgb
            assert_same_image(got, wanted)

    def test_behind_a_lite_model_there_may_be_white(self, balls: Scene, tmp_path: Path) -> None:
        rng = np.random.default_rng(2)
        rows = rows_of(layouts.LITE, rng, trbf_center=rng.uniform(0, 1, 6))
        fitted = self.model(tmp_path / "trained", balls, rows, white_background=True)
        camera = balls.cameras["7"]
        gaussians = [reference.spacetime_at(row, 2 / 8) for row in named(layouts.LITE, rows)]
        wanted = np.clip(reference.draw(gaussians, lens_of(camera), background=1.0), 0, 1)
        assert_same_image(fitted.render(camera, float(balls.camera_times["7"][2])).rgb, wanted)
        assert_same_when_loaded(OfficialSpacetimeGaussians(), fitted, balls, tmp_path / "kept")

    def test_white_behind_a_full_model_is_refused(self, balls: Scene, tmp_path: Path) -> None:
        rng = np.random.default_rng(6)
        with pytest.raises(SplashbenchError, match=r"cfg_args: white_background, .*; train without it"):
            self.model(tmp_path, balls, rows_of(layouts.FULL, rng), self.decoder(rng), white_background=True)

    def test_a_middle_cy_takes_cx_with_it(self, balls: Scene, tmp_path: Path) -> None:
        fitted = self.model(tmp_path, balls, rows_of(layouts.LITE, np.random.default_rng(3)))
        camera = balls.cameras["6"]
        K = camera.K.copy()
        K[1, 2] = camera.height / 2
        assert fitted.lens(replace(camera, K=K)).K[:2, 2].tolist() == [48, 32]
        assert fitted.lens(camera) == camera

    def test_between_timesteps_time_runs_evenly(self, balls: Scene, tmp_path: Path) -> None:
        fitted = self.model(tmp_path, balls, rows_of(layouts.LITE, np.random.default_rng(4)))
        middle = float(balls.times[2] + balls.times[3]) / 2
        assert fitted.model_time(middle) == pytest.approx(2.5 / 8)
        assert fitted.model_time(float(balls.times[-1])) == pytest.approx(7 / 8)
        step = float(balls.times[-1] - balls.times[-2])
        assert fitted.model_time(float(balls.times[-1]) + step) == pytest.approx(1.0)

    def test_a_loaded_model_renders_the_same(self, balls: Scene, tmp_path: Path) -> None:
        rng = np.random.default_rng(5)
        full = self.model(
            tmp_path / "a", balls, rows_of(layouts.FULL, rng, 20), self.decoder(rng), rgbfunction="sandwichnoact"
        )
        lite = self.model(tmp_path / "b", balls, rows_of(layouts.LITE, rng, 20), loader="colmap")
        for name, fitted in (("full", full), ("lite", lite)):
            assert_same_when_loaded(OfficialSpacetimeGaussians(), fitted, balls, tmp_path / name)

    @pytest.mark.parametrize(
        ("arguments", "message"),
        [
            ({"rgbfunction": "rgbv1"}, "cfg_args: rgbfunction is 'rgbv1'; train with sandwich or sandwichnoact"),
            ({"duration": 0}, "cfg_args: duration is 0, no number of timesteps"),
            ({"duration": "x"}, "cfg_args: duration is 'x', not a number"),
        ],
    )
    def test_arguments_that_say_nothing_are_named(
        self, balls: Scene, tmp_path: Path, arguments: dict, message: str
    ) -> None:
        rng = np.random.default_rng(6)
        with pytest.raises(SplashbenchError, match=message):
            self.model(tmp_path, balls, rows_of(layouts.FULL, rng), self.decoder(rng), **arguments)

    def test_missing_arguments_are_asked_for(self, balls: Scene, tmp_path: Path) -> None:
        layouts.write_spacetime(tmp_path, rows_of(layouts.LITE, np.random.default_rng(7)), None)
        (tmp_path / "cfg_args").unlink()
        with pytest.raises(SplashbenchError, match="cfg_args is missing; keep it beside point_cloud"):
            OfficialSpacetimeGaussians().read(tmp_path, tmp_path, balls.training())

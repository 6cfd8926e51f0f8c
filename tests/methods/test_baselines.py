"""What every baseline of the paper keeps to: masks stay out of the fit, `paper` runs."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from splashbench import toml
from splashbench.errors import SplashbenchError
from splashbench.gaussians import fitting
from splashbench.gaussians.density_control import DensityControl
from splashbench.gaussians.optimizer import RowOptimizer
from splashbench.harness.contract import Fitted, Run
from splashbench.harness.discovery import load_method
from splashbench.scene import Scene, TrainingScene
from splashbench_methods.scaffold_gs import fitting as background_fitting

SMALL = toml.load(Path(__file__).with_name("small_fits.toml"))
BASELINES = ("deformable_3dgs", "spacetime_gaussians", "spacetime_gaussians_lite", "scaffold_4d")


def fit(
    name: str, scene: TrainingScene, directory: Path, preset: str = "quick", run: Run | None = None, **settings: object
) -> Fitted:
    method = load_method(name)
    config = method.Config.preset(preset, {**SMALL[name], "iterations": 12, **settings})
    return method.fit(scene, config, run or Run(directory=directory))


@pytest.mark.parametrize("name", BASELINES)
def test_masks_give_the_first_points_and_are_not_looked_at_again(name: str, balls: Scene, tmp_path: Path) -> None:
    training = balls.training()
    read, told = training.mask, []

    def mask(camera: str, t: int) -> np.ndarray:
        assert not any(message.startswith("fitting") for message in told), "a mask was read during the fit"
        return read(camera, t)

    training.mask = mask  # type: ignore[method-assign]
    run = Run(directory=tmp_path, _report=lambda share, message: told.append(message))
    fit(name, training, tmp_path, run=run)
    assert any(message.startswith("fitting") for message in told)


@pytest.mark.parametrize("name", BASELINES)
def test_preset_paper_fits(name: str, balls: Scene, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The published settings, but for the steps, what is counted in steps, and sizes: growth, resets and guided samples
    take part."""
    grown, reset, placed = [], [], []
    replace_rows, set_rows, append = RowOptimizer.replace_rows, RowOptimizer.set_rows, DensityControl.append

    def replaced(self: RowOptimizer, kept: Any, new: Any) -> None:
        grown.append(max(map(len, new.values())))
        replace_rows(self, kept, new)

    def were_set(self: RowOptimizer, table: str, values: Any, rows: Any = None) -> None:
        reset.append(table)
        set_rows(self, table, values, rows)

    def appended(self: DensityControl, new: Any) -> None:
        placed.append(len(new["positions"]))
        append(self, new)

    monkeypatch.setattr(RowOptimizer, "replace_rows", replaced)
    monkeypatch.setattr(RowOptimizer, "set_rows", were_set)
    monkeypatch.setattr(DensityControl, "append", appended)
    steps = {"grow_every": 5, "reset_every": 10, "guided_every": 3, "sh_every": 10}
    fields = load_method(name).Config.model_fields
    counted = {key: value for key, value in steps.items() if key in fields}
    fitted: Any = fit(name, balls.training(), tmp_path, "paper", iterations=120, **counted)
    assert len(fitted.history.psnr) == 120
    assert max(grown) > 0
    assert ("opacity_logits" in reset) == (name != "scaffold_4d")
    assert bool(placed) == name.startswith("spacetime_gaussians")
    assert fitted.history.psnr[-20:].mean() > fitted.history.psnr[:5].mean()
    image = fitted.render(balls.cameras["6"], float(balls.times[2])).rgb
    assert image.shape == (64, 96, 3)
    assert np.isfinite(image).all()
    assert image.std() > 0.02


def test_a_loss_that_stops_being_finite_ends_the_fit_with_a_remedy(
    balls: Scene, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for module in (fitting, background_fitting):
        monkeypatch.setattr(module, "l1", lambda image, *rest: image.sum() * float("nan"))
    with pytest.raises(
        SplashbenchError, match="the loss is nan at iteration 1; lower the rates, by rate_factor and what other factors"
    ):
        fit("spacetime_gaussians_lite", balls.training(), tmp_path)
    with pytest.raises(SplashbenchError, match="the background's loss is nan at iteration 1; see that"):
        fit("scaffold_gs", balls.training(), tmp_path)

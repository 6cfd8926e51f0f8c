"""The preset `paper` of anchors, static and in space-time, starts, penalises, grows and slows down as published."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
import pytest
import torch

from splashbench.background.clean_plate import CleanPlate
from splashbench.gaussians.anchor_seeds import AnchorSeed
from splashbench.gaussians.torch_threads import one_torch_thread
from splashbench.harness.contract import Run
from splashbench.scene import Camera, Scene
from splashbench_methods.scaffold_4d import Scaffold4D
from splashbench_methods.scaffold_4d.settings import Scaffold4DSettings
from splashbench_methods.scaffold_gs import BackgroundSettings, fitting
from splashbench_methods.scaffold_gs.cells import LEVELS, new_cells
from splashbench_methods.scaffold_gs.growth import Growth
from splashbench_methods.scaffold_gs.model import AnchorModel, StaticAnchorSpec
from splashbench_methods.scaffold_gs.optimizer import AnchorOptimizer


@pytest.fixture(autouse=True)
def _one_thread() -> Iterator[None]:
    with one_torch_thread(), torch.random.fork_rng(devices=[]):
        torch.manual_seed(0)
        yield


def camera() -> Camera:
    w2c = np.eye(4)
    w2c[2, 3] = 3
    return Camera("1", 48, 32, np.array([[48.0, 0, 24], [0, 48.0, 16], [0, 0, 1]]), w2c)


def grey_plate() -> CleanPlate:
    return CleanPlate(camera(), np.full((32, 48, 3), 128, np.uint8), np.ones((32, 48), bool))


def seed_of(spacing: float, n: int = 30) -> AnchorSeed:
    positions = np.random.default_rng(0).uniform([-1, -0.7, -0.2], [1, 0.7, 0.2], (n, 3)).astype(np.float32)
    return AnchorSeed(positions, np.full((n, 3), 0.5, np.float32), np.full(n, spacing, np.float32), spacing)


def fitted(spacing: float, **settings: object) -> AnchorModel:
    chosen = BackgroundSettings(iterations=40, **settings)  # type: ignore[arg-type]
    grey = np.full(3, 0.5, np.float32)
    return fitting.fit_model(seed_of(spacing), [grey_plate()], chosen, grey, 0, lambda fraction: None)


def paper() -> BackgroundSettings:
    settings = BackgroundSettings.preset("paper")
    assert isinstance(settings, BackgroundSettings)
    return settings


def test_the_share_of_candidates_that_is_kept_grows_with_the_level() -> None:
    assert [level.kept for level in LEVELS] == [0.5, 0.75, 0.875]
    rng = np.random.default_rng(0)
    candidates = 100.0 * np.arange(4000)[:, None] * np.ones(3)  # each in a cell of its own, whatever the level
    elsewhere = np.full((1, 3), -1e5)
    for level in LEVELS:
        cells = new_cells(candidates, np.full(4000, 1.0), elsewhere, np.ones(3), [level], 0.1, 10_000, rng)
        assert len(cells.centers) / 4000 == pytest.approx(level.kept, abs=0.03)


def test_volumes_are_penalised_in_scene_units() -> None:
    def volume(spacing: float, unit: str) -> float:
        model = fitted(spacing, volume_unit=unit, rates="published", ssim_every=1)
        with torch.no_grad():
            return float(model.decode(camera().center).scales.prod(dim=1).mean())

    assert volume(2.0, "scene") < 0.9 * volume(2.0, "spacing")
    assert volume(0.2, "scene") > 1.1 * volume(0.2, "spacing")
    assert paper().volume_unit == "scene"


def test_children_start_at_their_anchor() -> None:
    model = AnchorModel.from_seed(seed_of(0.1), StaticAnchorSpec(4), spread=False)
    assert not model.offsets.any()
    assert AnchorModel.from_seed(seed_of(0.1), StaticAnchorSpec(4)).offsets.any()
    plain = AnchorModel.from_seed(seed_of(0.1), StaticAnchorSpec(4, base_color=False), spread=False)
    assert not plain.features.any()
    assert not paper().spread_start


def test_children_of_grown_anchors_start_there_too_and_part_in_the_fit() -> None:
    settings = paper().model_copy(update={"grow_every": 10, "grow_gradient": 1e-9, "children": 2})
    model = AnchorModel.from_seed(seed_of(0.1), StaticAnchorSpec(2), spread=False)
    with torch.no_grad():
        model.offsets += 3 * torch.randn(model.offsets.shape)  # away from their own anchor's cell
    optimizer = AnchorOptimizer(model, "published", 100)
    growth = Growth(optimizer, 0.02, settings, np.random.default_rng(0))
    before = len(model)
    for _ in range(10):
        gaussians = model.decode(camera().center)
        gaussians.means.retain_grad()
        (gaussians.means**2).sum().backward()
        growth.observe(camera(), gaussians)
    growth.round()
    assert len(model) > before
    assert not model.offsets[before:].any()
    shape = model.decode(camera().center)
    (shape.means * torch.randn(shape.means.shape)).sum().backward()
    optimizer.step()
    assert (model.offsets[:, 0] != model.offsets[:, 1]).any(dim=1).all()


def test_learning_rates_fall_for_thirty_thousand_steps() -> None:
    settings = paper()
    assert settings.rates_until * settings.iterations == 30_000
    model = AnchorModel.from_seed(seed_of(0.1), StaticAnchorSpec(2))
    optimizer = AnchorOptimizer(model, settings.rates, 100, settings.rates_until)
    for _ in range(101):
        model.decode(camera().center).colors.sum().backward()
        optimizer.step()
    rates = {group["name"]: group["lr"] for group in optimizer.adam.param_groups}
    assert rates["offsets"] == pytest.approx(0.01 * (0.0001 / 0.01) ** (2 / 3))
    assert rates["color_head"] == pytest.approx(0.008 * (0.00005 / 0.008) ** (2 / 3))
    assert rates["features"] == 0.0075


def test_pulls_are_counted_before_the_first_round_and_rounds_end_before_the_last_step(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    seen: list[str] = []

    class Watched(Growth):
        def observe(self, *arguments: object) -> None:
            seen.append("step")

        def round(self) -> None:
            seen.append("round")

    monkeypatch.setattr(fitting, "Growth", Watched)
    # As `paper` at 20 000 steps, but with longer waits: counted before the first round, none at the end.
    chosen = BackgroundSettings(iterations=100, count_from=0.02, grow_from=0.1, grow_until=0.29, grow_every=10)
    fitting.fit_model(seed_of(0.1), [grey_plate()], chosen, np.full(3, 0.5, np.float32), 0, lambda fraction: None)
    assert seen == ["step"] * 18 + ["round"] + ["step"] * 9
    settings = paper()
    steps = [round(share * 20_000) for share in (settings.count_from, settings.grow_from, settings.grow_until)]
    assert steps == [500, 1500, 14_999]


def test_growth_of_anchors_in_space_time_is_counted_as_published() -> None:
    settings = Scaffold4DSettings.preset("paper")
    assert isinstance(settings, Scaffold4DSettings)
    shares = (settings.count_from, settings.grow_from, settings.grow_until)
    assert [round(share * settings.iterations) for share in shares] == [500, 1500, 59_999]


@pytest.mark.parametrize("preset", ["quick", "paper"])
def test_anchors_in_space_time_start_as_published_too(preset: str, balls: Scene) -> None:
    settings = {"iterations": 1, "static": "pixels", "static_points": 300, "hull_points": 400, "max_anchors": 900}
    model = Scaffold4D().fit(balls.training(), Scaffold4D.Config.preset(preset, settings), Run(seed=0)).model
    assert float(model.unit) == 1
    assert float(model.offsets.detach().abs().max()) <= 0.0151  # one step of the rate of offsets
    spaced = Scaffold4D.Config.preset(preset, {**settings, "volume_unit": "spacing", "spread_start": True})
    model = Scaffold4D().fit(balls.training(), spaced, Run(seed=0)).model
    assert float(model.unit) < 1
    assert float(model.offsets.detach().abs().max()) > 0.5

"""Gaussians that show a share of what lies behind the liquid: drawn, decoded, fitted, decided on, and stored."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from splashbench.errors import SplashbenchError
from splashbench.files import read_json, write_json
from splashbench.harness.contract import Run
from splashbench.render import rasterize_arrays
from splashbench.scene import Camera, Scene
from splashbench_methods import scaffold_gs
from splashbench_methods.splashsplat import FittedSplashSplat, SplashSplat, SplashSplatConfig, course
from splashbench_methods.splashsplat.appearance.compositing import composite, shares
from splashbench_methods.splashsplat.appearance.decoder import Children, Decoder, DecoderSettings
from splashbench_methods.splashsplat.appearance.glass import Splats
from splashbench_methods.splashsplat.carriers.subframe import CarrierState
from splashbench_methods.splashsplat.model import Liquid
from splashbench_methods.splashsplat.panorama import camera_towards, panorama
from splashbench_methods.splashsplat.reconstruction import fit_liquid
from splashbench_methods.splashsplat.trace import trace_liquid

from .test_splashsplat_transmittance import BACKDROP, recoloured

CAMERA = Camera("c", 40, 36, np.array([[40.0, 0, 20], [0, 40, 18], [0, 0, 1]]), np.eye(4))
TINY = {"hull_cells": 48, "transport_cells": 32, "control_cells": 8}


def some_children(count: int, seed: int, depth: float = 2.0) -> Children:
    """Of `count` carriers, one each, transparent ones."""
    rng = torch.Generator().manual_seed(seed)
    means = torch.randn(count, 1, 3, generator=rng) * torch.tensor([0.5, 0.5, 0.1]) + torch.tensor([0, 0, depth])
    factors = 0.12 * torch.eye(3) + 0.02 * torch.randn(count, 1, 3, 3, generator=rng)
    opacities, transmittances = torch.rand(2, count, 1, generator=rng)
    colors = torch.rand(count, 1, 3, generator=rng)
    return Children(means, factors, opacities, colors, torch.zeros(count, 1, 3), transmittances)


def some_background(seed: int = 0) -> torch.Tensor:
    return torch.rand(36, 40, 3, generator=torch.Generator().manual_seed(seed))


def weights(children: Children, **others: Any) -> torch.Tensor:
    """Compositing weights of every child at every pixel, [h, w, n], by a channel each of the same rendering."""
    n = len(children.means)
    one_each = torch.eye(n)[:, None]
    found = [
        composite(
            replace(children, colors=one_each[:, :, [i] * 3], transmittances=None),
            CAMERA,
            torch.zeros(36, 40, 3),
            **others,
        )[0]
        for i in range(n)
    ]
    return torch.stack([image[..., 0] for image in found], -1)


def expected(children: Children, background: torch.Tensor, by: torch.Tensor, beside: torch.Tensor) -> torch.Tensor:
    """The definition of `composite`; by: [h, w, n] weights; beside: [h, w], the share of the background beside them."""
    assert children.transmittances is not None
    own, through = children.colors[:, 0], children.transmittances[:, 0]
    shown = (by[..., None] * ((1 - through)[:, None] * own)).sum(-2)
    return shown + ((by * through).sum(-1) + beside)[..., None] * background


def test_each_shows_its_share_of_what_is_behind_the_liquid() -> None:
    children, background = some_children(12, 1), some_background()
    image, alpha = composite(children, CAMERA, background)
    by = weights(children)
    torch.testing.assert_close(image, expected(children, background, by, 1 - alpha), atol=2e-6, rtol=0)
    # It covers what it would if it were opaque.
    _, opaque = composite(replace(children, transmittances=None), CAMERA, background)
    assert torch.equal(alpha, opaque)
    assert float(alpha.max()) > 0.9
    np.testing.assert_array_equal(shares(children, CAMERA), shares(replace(children, transmittances=None), CAMERA))


def test_all_of_it_hides_nothing_and_none_hides_as_before() -> None:
    children, background = some_children(12, 2), some_background()
    clear = replace(children, transmittances=torch.ones(12, 1))
    torch.testing.assert_close(composite(clear, CAMERA, background)[0], background, atol=2e-6, rtol=0)
    full = replace(children, transmittances=torch.zeros(12, 1))
    opaque = composite(replace(children, transmittances=None), CAMERA, background)[0]
    torch.testing.assert_close(composite(full, CAMERA, background)[0], opaque, atol=2e-6, rtol=0)


def test_a_background_of_one_colour_is_that_colour_everywhere() -> None:
    children, one = some_children(12, 2), torch.tensor([0.2, 0.7, 0.4])
    image = composite(children, CAMERA, one)[0]
    torch.testing.assert_close(image, composite(children, CAMERA, one.expand(36, 40, 3))[0], atol=2e-6, rtol=0)


def test_glass_before_it_is_not_seen_through() -> None:
    children, background = some_children(6, 3), some_background()
    pane = Splats(
        torch.tensor([[0.1, 0.0, 1.0]]), 0.1 * torch.eye(3)[None], torch.tensor([0.6]), torch.tensor([[1.0, 0, 0]])
    )
    image, alpha = composite(children, CAMERA, background, glass=pane)
    by = weights(children, glass=replace(pane, colors=torch.zeros(1, 3)))
    torch.testing.assert_close(alpha, by.sum(-1), atol=2e-6, rtol=0)
    dark = replace(children, colors=torch.zeros(6, 1, 3), transmittances=None)
    red = composite(dark, CAMERA, torch.zeros(36, 40, 3), glass=pane)[0][..., 0]
    assert float(red.max()) > 0.5
    want = expected(children, background, by, 1 - alpha - red)
    want[..., 0] += red
    torch.testing.assert_close(image, want, atol=3e-6, rtol=0)


def test_a_wall_before_it_shows_itself() -> None:
    children, background = some_children(10, 4), some_background()
    wall = torch.rand(36, 40, generator=torch.Generator().manual_seed(5))
    in_front = torch.arange(10) % 3 == 0
    image, alpha = composite(children, CAMERA, background, wall=wall, in_front=in_front)
    first, last = (
        Children(*(None if table is None else table[rows] for table in vars(children).values()))
        for rows in (~in_front, in_front)
    )
    below, below_alpha = composite(first, CAMERA, background)
    below, below_alpha = below + wall[..., None] * (background - below), below_alpha * (1 - wall)
    _, over_alpha = composite(last, CAMERA, background)
    over = expected(last, background, weights(last), torch.zeros(36, 40))
    torch.testing.assert_close(image, over + (1 - over_alpha)[..., None] * below, atol=3e-6, rtol=0)
    torch.testing.assert_close(alpha, over_alpha + (1 - over_alpha) * below_alpha, atol=2e-6, rtol=0)


@pytest.mark.parametrize("case", ["alone", "wall", "wall and some before it", "glass"])
def test_gradients_are_those_of_differences(case: str) -> None:
    children, background = some_children(5, 6), some_background()
    pull = torch.randn(36, 40, 3, generator=torch.Generator().manual_seed(8))
    others: dict[str, Any] = {}
    if case.startswith("wall"):
        others = {"wall": torch.rand(36, 40, generator=torch.Generator().manual_seed(9))}
    if case.endswith("it"):
        others["in_front"] = torch.tensor([True, False, False, True, False])
    if case == "glass":
        others["glass"] = Splats(
            torch.tensor([[0.1, 0.0, 1.0]]), 0.1 * torch.eye(3)[None], torch.tensor([0.6]), torch.tensor([[1.0, 0, 0]])
        )

    def value(transmittances: torch.Tensor, colors: torch.Tensor) -> torch.Tensor:
        given = replace(children, transmittances=transmittances, colors=colors)
        return (composite(given, CAMERA, background, **others)[0] * pull).sum()

    assert children.transmittances is not None
    given = [children.transmittances.clone().requires_grad_(), children.colors.clone().requires_grad_()]
    found = torch.autograd.grad(value(*given), given)
    with torch.no_grad():
        for number, (table, gradient) in enumerate(zip(given, found)):
            for place in range(0, table.numel(), 4):
                ends = []
                for step in (0.05, -0.05):  # it is linear in both
                    moved = [each.detach().clone() for each in given]
                    moved[number].view(-1)[place] += step
                    ends.append(float(value(*moved)))
                assert float(gradient.flatten()[place]) == pytest.approx((ends[0] - ends[1]) / 0.1, abs=2e-2, rel=1e-3)


def test_the_kernel_has_what_the_definition_has() -> None:
    torch.manual_seed(3)
    decoder = Decoder(DecoderSettings(feature_size=8, children=2, color_width=8, transmission=True))
    state = CarrierState(torch.randn(7, 3), torch.eye(3).expand(7, 3, 3).contiguous(), torch.zeros(7))
    features, scales, eye = torch.randn(20, 8), torch.zeros(20, 3), torch.tensor([0.0, 0.0, -4.0])
    rows = torch.tensor([0, 2, 3, 7, 11, 12, 19])
    want = decoder(features[rows], scales[rows], state, eye).transmittances
    found = [
        decoder.decode(features, scales, rows, state, eye),
        decoder.decode(features[rows], scales[rows], None, state, eye),
    ]
    for children, _ in found:
        torch.testing.assert_close(children.transmittances, want)
        assert children.transmittances is not None
        assert tuple(children.transmittances.shape) == (7, 2)
    features.requires_grad_()
    (by_rows,) = torch.autograd.grad(
        decoder.decode(features, scales, rows, state, eye)[0].transmittances.sum(), features
    )
    assert by_rows.is_sparse
    opaque = Decoder(DecoderSettings(feature_size=8, children=2, color_width=8))
    assert opaque.decode(features, scales, rows, state, eye)[0].transmittances is None
    assert not any(name.startswith("transmittance") for name in opaque.state_dict())


def fitted(scene: Scene, behind: dict[str, np.ndarray], **settings: object) -> Liquid:
    config = SplashSplatConfig.preset("quick", TINY | settings)
    run, training = Run(seed=0), scene.training()
    return fit_liquid(training, behind, trace_liquid(training, config, run), run)[0]


def test_a_fit_learns_what_shows_through(balls_copy: Path) -> None:
    """Balls of which .6 is what is behind them, seen before another background than any that taught."""
    scene = recoloured(balls_copy, 0.6)
    behind = {
        name: BACKDROP[: camera.height, : camera.width].astype(np.float32) / 255
        for name, camera in scene.cameras.items()
    }
    camera, t = scene.cameras[scene.train[0]], 4
    unseen = np.random.default_rng(7).uniform(0.1, 0.9, (camera.height, camera.width, 3)).astype(np.float32)
    truth = 0.6 * unseen + 0.4 * np.array([180.0, 60.0, 40.0]) / 255
    mask = scene.mask(camera.name, t)
    assert mask.sum() > 50
    errors, covered = {}, {}
    for transmission in ("never", "always"):
        liquid = fitted(scene, dict(behind), iterations=150, transmission=transmission)
        shown = FittedSplashSplat(liquid, _Flat(unseen)).render(camera, float(scene.times[t]))
        errors[transmission] = float(np.sqrt(np.square(shown.rgb - truth)[mask].mean()))
        covered[transmission] = float((shown.alpha > 0.5)[mask].mean())
    assert errors["always"] < 0.5 * errors["never"], errors
    assert covered["always"] > max(0.9, covered["never"]), covered


class _Flat:
    """A background that every camera sees alike."""

    def __init__(self, image: np.ndarray) -> None:
        self._image = image

    def render(self, camera: Camera) -> np.ndarray:
        return self._image


class _Grey:
    """A background of one colour."""

    def render(self, camera: Camera) -> np.ndarray:
        return np.full((camera.height, camera.width, 3), 0.3, np.float32)


class _Sky:
    """A background whose colour is where it is looked to."""

    def render(self, camera: Camera) -> np.ndarray:
        rows, columns = np.mgrid[: camera.height, : camera.width] + 0.5
        rays = np.stack([columns, rows, np.ones_like(rows)], -1) @ np.linalg.inv(camera.K).T @ camera.w2c[:3, :3]
        return (0.5 + 0.5 * rays / np.linalg.norm(rays, axis=-1, keepdims=True)).astype(np.float32)


def test_what_is_handed_out_shows_the_same_from_where_it_was_asked_for(balls_copy: Path) -> None:
    scene = recoloured(balls_copy, 0.6)
    behind = {
        name: BACKDROP[: camera.height, : camera.width].astype(np.float32) / 255
        for name, camera in scene.cameras.items()
    }
    sky = _Sky()
    model = FittedSplashSplat(fitted(scene, behind, iterations=60, transmission="always"), sky)
    for name in (scene.train[0], scene.test[0]):
        camera, time = scene.cameras[name], float(scene.times[4])
        own = model.render(camera, time)
        assert (own.alpha > 0.5).sum() > 30
        given = model.gaussians(time, camera.center)
        drawn, _ = rasterize_arrays(
            given.means, given.factors, given.opacities, given.colors, camera, background=sky.render(camera)
        )
        assert np.abs(drawn - own.rgb).max() < 0.02
        children = model.children(camera, time)
        assert children is not None
        assert children.transmittances is not None
        assert float(children.transmittances.mean()) > 0.3  # without it this would be another test


CORNERS = np.array([[x, y, z] for x in (-1.0, 2.0) for y in (0.0, 1.0) for z in (3.0, 4.0)])


@pytest.mark.parametrize("eye", [(0, 0, -4), (9, 0.1, 3.5), (0, 30, 3.5), (0.5, 0.5, -40)])
def test_a_panorama_has_all_of_the_box_in_it(eye: tuple[float, float, float]) -> None:
    camera = camera_towards(np.array(eye, dtype=float), CORNERS)
    np.testing.assert_allclose(camera.center, eye, atol=1e-9)
    pixels, depths = camera.project(CORNERS)
    assert (depths > 0).all()
    assert (pixels >= 0).all()
    assert (pixels <= camera.width).all()
    assert np.ptp(pixels, axis=0).max() > 0.4 * camera.width
    seen = panorama(_Sky().render, eye, CORNERS)
    towards = CORNERS - eye
    wanted = 0.5 + 0.5 * towards / np.linalg.norm(towards, axis=1, keepdims=True)
    np.testing.assert_allclose(seen.at(CORNERS), wanted, atol=0.012)


@pytest.mark.parametrize("eye", [(0.5, 0.5, 3.5), (0.4, 0.6, 3.2)])
def test_an_eye_within_the_box_sees_some_color_everywhere(eye: tuple[float, float, float]) -> None:
    found = panorama(_Sky().render, eye, CORNERS).at(CORNERS)
    assert found.shape == (8, 3)
    assert np.isfinite(found).all()


def test_files_keep_it(balls_copy: Path, tmp_path: Path) -> None:
    scene = recoloured(balls_copy, 0.6)
    behind = {
        name: BACKDROP[: camera.height, : camera.width].astype(np.float32) / 255
        for name, camera in scene.cameras.items()
    }
    liquid = fitted(scene, behind, iterations=12, transmission="always")
    liquid.save(tmp_path)
    assert read_json(tmp_path / "liquid.json")["decoder"]["transmission"] is True
    loaded = Liquid.load(tmp_path)
    camera, time = scene.cameras[scene.train[1]], float(scene.times[3])
    background = _Grey()
    images = [FittedSplashSplat(each, background).render(camera, time) for each in (liquid, loaded)]
    np.testing.assert_array_equal(images[0].rgb, images[1].rgb)
    gaussians = FittedSplashSplat(liquid, background).gaussians(time, camera.center)
    children = FittedSplashSplat(liquid, background).children(camera, time)
    assert children is not None
    assert children.transmittances is not None
    np.testing.assert_array_equal(gaussians.opacities, children.opacities.flatten().numpy())
    share = children.transmittances[..., None]
    colors = ((1 - share) * children.colors + share * 0.3).reshape(-1, 3)
    np.testing.assert_allclose(gaussians.colors, colors, atol=0.51 / 255)
    # Without the weights that say by how much, and where no background is behind the liquid alone.
    header = read_json(tmp_path / "liquid.json")
    write_json(tmp_path / "liquid.json", header | {"composition": "together"})
    with pytest.raises(SplashbenchError, match=r"liquid\.json .*transmission"):
        Liquid.load(tmp_path)
    write_json(tmp_path / "liquid.json", header | {"decoder": header["decoder"] | {"transmission": "yes"}})
    with pytest.raises(SplashbenchError, match=r"liquid\.json"):
        Liquid.load(tmp_path)
    write_json(tmp_path / "liquid.json", header)
    with np.load(tmp_path / "appearance.npz") as stored:
        tables = {name: stored[name] for name in stored if not name.startswith("heads.transmittance")}
    np.savez(tmp_path / "appearance.npz", **tables)
    with pytest.raises(SplashbenchError, match=r"appearance\.npz"):
        Liquid.load(tmp_path)


@pytest.fixture
def short_background(monkeypatch: pytest.MonkeyPatch) -> None:
    original = scaffold_gs.shared_background

    def shared_background(scene: Any, settings: Any, *others: Any, **named: Any) -> scaffold_gs.Background:
        return original(scene, settings.model_copy(update={"iterations": 5}), *others, **named)

    monkeypatch.setattr(scaffold_gs, "shared_background", shared_background)


@pytest.mark.parametrize("coarse", [True, False])
@pytest.mark.parametrize(
    ("share", "settings", "shows"),
    [
        (0.3, {}, True),
        (0.03, {}, False),
        (0.3, {"transmission": "never"}, False),
        (0.0, {"transmission": "always"}, True),
    ],
)
def test_it_is_there_where_the_background_shows_through(
    share: float,
    settings: dict[str, Any],
    shows: bool,
    coarse: bool,
    balls: Scene,
    short_background: None,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(course, "transmittance", lambda *_: share)
    run = Run()
    given = TINY | {"iterations": 10, "coarse_grids_share": 0.2 if coarse else 0.0} | settings
    found = SplashSplat().fit(balls.training(), SplashSplatConfig.preset("best", given), run)
    assert isinstance(found, FittedSplashSplat)
    assert found.liquid.appearance.decoder.settings.transmission is shows
    decided = [decision for decision in run.decisions if decision.name == "transmission"]
    assert len(decided) == ("transmission" not in settings)
    if decided:
        assert f"{100 * share:.0f} %" in decided[0].because
        assert (decided[0].chosen == "none") is not shows


def test_it_is_not_drawn_together_with_the_background(balls: Scene, short_background: None) -> None:
    with pytest.raises(SplashbenchError, match="transmission"):
        SplashSplatConfig.preset("best", {"composition": "together", "transmission": "always"})
    run = Run()
    config = SplashSplatConfig.preset("best", TINY | {"iterations": 4, "composition": "together", "plates_share": 0.0})
    found = SplashSplat().fit(balls.training(), config, run)
    assert isinstance(found, FittedSplashSplat)
    assert not found.liquid.appearance.decoder.settings.transmission
    assert not [decision for decision in run.decisions if decision.name == "transmission"]

"""SpacetimeGaussians: formulas, rays, guided sampling, the fit, and what is kept of it."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation
from splashbench_methods.gaussian_splatting.mixed import MixedFitted
from splashbench_methods.spacetime_gaussians import SpacetimeGaussians, SpacetimeGaussiansLite
from splashbench_methods.spacetime_gaussians.model import SpacetimeModel, rays
from splashbench_methods.spacetime_gaussians.settings import Settings

from splashbench.adapter.contract import Run
from splashbench.render.torch_threads import one_torch_thread
from splashbench.scene import Camera, Scene

SMALL = {"iterations": 60, "static_points": 300, "hull_points": 400, "most": 1500}
VARIANTS = [SpacetimeGaussians, SpacetimeGaussiansLite]


@pytest.fixture(autouse=True)
def _one_thread() -> Iterator[None]:
    with one_torch_thread(), torch.random.fork_rng(devices=[]):
        torch.manual_seed(0)
        yield


def fit(
    method: type[SpacetimeGaussians], scene: Scene, directory: Path, seed: int = 0, **settings: object
) -> MixedFitted:
    config = Settings.preset("quick", {**SMALL, **settings})
    assert isinstance(config, Settings)
    return method().fit(scene.training(), config, Run(seed=seed, directory=directory))


@pytest.fixture(scope="module", params=VARIANTS, ids=["full", "lite"])
def fitted(request: pytest.FixtureRequest, balls: Scene, tmp_path_factory: pytest.TempPathFactory) -> MixedFitted:
    result = fit(request.param, balls, tmp_path_factory.mktemp("fit"))
    result.method = request.param  # type: ignore[attr-defined]
    return result


def random_model(full: bool = True, n: int = 7) -> SpacetimeModel:
    model = SpacetimeModel(n, full)
    with torch.no_grad():
        for name in model.rows:
            model.get_parameter(name).normal_(std=0.5)
    return model.double()


class TestFormulas:
    def test_motion_turn_and_fading(self) -> None:
        model = random_model()
        state = model.at(0.7)
        v = {name: model.get_parameter(name).detach().numpy() for name in model.rows}
        for i in range(7):
            d = 0.7 - v["times"][i]
            mean = v["positions"][i] + sum(v["motions"][i, k] * d ** (k + 1) for k in range(3))
            turn = Rotation.from_quat((v["quaternions"][i] + v["spins"][i] * d)[[1, 2, 3, 0]]).as_matrix()
            opacity = np.exp(-((d / np.exp(v["log_widths"][i])) ** 2)) / (1 + np.exp(-v["opacity_logits"][i]))
            np.testing.assert_allclose(state.means[i].detach(), mean)
            np.testing.assert_allclose(state.factors[i].detach(), turn * np.exp(v["log_scales"][i]), atol=1e-12)
            assert float(state.opacities[i].detach()) == pytest.approx(opacity)
            channels = np.concatenate([v["base"][i], v["features"][i], v["time_features"][i] * d])
            np.testing.assert_allclose(state.channels[i].detach(), channels)

    def test_times_learn_from_fading_alone(self) -> None:
        model = random_model()
        model.at(0.2).means.sum().backward()
        assert model.times.grad is None
        model.at(0.2).opacities.sum().backward()
        assert model.times.grad is not None
        assert model.times.grad.abs().min() > 0

    def test_the_decoder_sees_features_and_ray(self, balls: Scene) -> None:
        model = random_model()
        camera = balls.cameras["1"].scaled(0.25)
        splat = torch.randn(camera.height, camera.width, 9)
        image = model.float().image(splat, camera, 0.0).detach().numpy()
        first, second = (model.decoder[i].weight.detach().numpy() for i in (0, 2))
        ray = rays(camera)
        for row, column in ((0, 0), (5, 7)):
            base, features = splat[row, column, :3].numpy(), splat[row, column, 3:].numpy()
            hidden = np.maximum(first @ np.concatenate([features, ray[row, column]]), 0)
            wanted = 1 / (1 + np.exp(-(base + second @ hidden)))
            np.testing.assert_allclose(image[row, column], wanted, rtol=1e-5)

    def test_rays_go_through_their_pixels(self, balls: Scene) -> None:
        camera = balls.cameras["2"]
        camera = Camera("2", 96, 64, camera.K + np.array([[0, 0, 7.0], [0, 0, -5.0], [0, 0, 0]]), camera.w2c)
        ray = rays(camera)[10, 20].astype(float)
        pixels, depth = camera.project((ray[:3] + 1.7 * ray[3:])[None])
        np.testing.assert_allclose(pixels[0], [20.5, 10.5], atol=1e-3)
        assert depth[0] > 0
        assert np.linalg.norm(ray[3:]) == pytest.approx(1)


class TestFit:
    def test_it_learns(self, fitted: MixedFitted) -> None:
        assert fitted.history is not None
        assert fitted.history.psnr[-10:].mean() > fitted.history.psnr[:5].mean() + 2

    def test_a_loaded_model_renders_the_same(self, fitted: MixedFitted, balls: Scene, tmp_path: Path) -> None:
        fitted.save(tmp_path)
        loaded = fitted.method().load(tmp_path, balls.training())  # type: ignore[attr-defined]
        camera = balls.cameras[balls.test[1]]
        for time in balls.times[[0, 5]]:
            a, b = fitted.render(camera, float(time)), loaded.render(camera, float(time))
            np.testing.assert_array_equal(a.rgb, b.rgb)
            np.testing.assert_array_equal(a.alpha, b.alpha)

    def test_liquid_appears_and_vanishes(self, fitted: MixedFitted) -> None:
        particles = fitted.particles()
        assert particles is not None
        assert particles.active.any(axis=1).all()
        assert (particles.active.sum(axis=0) < particles.n_frames).any()

    def test_one_seed_gives_one_model(self, balls: Scene, tmp_path: Path) -> None:
        first, again = (fit(SpacetimeGaussians, balls, tmp_path, 3, iterations=8) for _ in range(2))
        for name, tensor in first.model.state_dict().items():
            assert torch.equal(tensor, again.model.state_dict()[name])


class TestGuidedSampling:
    def test_it_places_gaussians_where_nothing_is_and_the_view_errs(self, balls: Scene, tmp_path: Path) -> None:
        settings = {"iterations": 4, "hull_points": 0, "grow_from": 1.0, "prune_until": 0.0}
        without = fit(SpacetimeGaussiansLite, balls, tmp_path, **settings)
        guided = {"guided_until": 0.25, "guided_patches": 3, "guided_every": 10}
        model = fit(SpacetimeGaussiansLite, balls, tmp_path, **settings, **guided).model
        count = len(without.model.positions)
        new = model.positions.detach().numpy()[count:]
        assert len(new) == 12  # four on each of three rays
        time = float(model.times[count])
        t = int(np.abs((balls.times - balls.times[0]) / np.ptp(balls.times) - time).argmin())
        # Without points of the hull, what is wrong is where the balls are.
        hits = []
        for name in balls.train:
            pixels, _ = balls.cameras[name].project(new)
            inside = ((pixels >= 0) & (pixels < [96, 64])).all(axis=1)
            column, row = np.clip(pixels.astype(int), 0, [95, 63]).T
            grown = balls.mask(name, t)
            near = [grown[max(r - 6, 0) : r + 7, max(c - 6, 0) : c + 7].any() for r, c in zip(row, column)]
            hits.append((np.array(near) & inside).mean())
        assert max(hits) > 0.9

    def test_it_keeps_to_the_limit(self, balls: Scene, tmp_path: Path) -> None:
        settings = {"iterations": 2, "hull_points": 0, "grow_from": 1.0, "most": 305, "guided_until": 1.0}
        model = fit(SpacetimeGaussiansLite, balls, tmp_path, **settings, guided_every=1).model
        assert len(model.positions) <= 305

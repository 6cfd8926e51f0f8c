"""SpacetimeGaussians: formulas, rays, guided sampling, the fit, and what is kept of it."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from splashbench.gaussians.mixed_model import MixedFitted
from splashbench.gaussians.photographs import Photographs
from splashbench.gaussians.torch_threads import one_torch_thread
from splashbench.harness.contract import Run
from splashbench.scene import Camera, Scene
from splashbench_methods.spacetime_gaussians import SpacetimeGaussians, SpacetimeGaussiansLite
from splashbench_methods.spacetime_gaussians.guided import PATCH, PER_RAY, along_worst_rays
from splashbench_methods.spacetime_gaussians.model import SpacetimeModel, rays
from splashbench_methods.spacetime_gaussians.settings import SpacetimeSettings

SMALL = {"iterations": 60, "views_per_step": 5, "static_points": 300, "hull_points": 400, "max_gaussians": 1500}
VARIANTS = [SpacetimeGaussians, SpacetimeGaussiansLite]


@pytest.fixture(autouse=True)
def _one_thread() -> Iterator[None]:
    with one_torch_thread(), torch.random.fork_rng(devices=[]):
        torch.manual_seed(0)
        yield


def fit(
    method: type[SpacetimeGaussians], scene: Scene, directory: Path, seed: int = 0, **settings: object
) -> MixedFitted:
    config = SpacetimeSettings.preset("quick", {**SMALL, **settings})
    assert isinstance(config, SpacetimeSettings)
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
        assert state.rows.tolist() == list(range(7))
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

    def test_what_has_faded_is_left_out_and_changes_no_pixel(
        self, balls: Scene, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        model = random_model(n=60)
        with torch.no_grad():
            camera = balls.cameras["1"]
            model.positions[:] = torch.tensor(camera.center + 2 * camera.w2c[2, :3])
            model.log_scales -= 3
            model.times[:], model.log_widths[:] = 0.3, 0.0
            model.times[::2] = 5.0
            model.opacity_logits[1] = -20.0
        model = model.float()
        state = model.at(0.2)
        assert state.rows.tolist() == [i for i in range(60) if i % 2 and i != 1]
        assert len(model.means(0.2)) == 60
        np.testing.assert_array_equal(model.means(0.2)[state.rows].detach(), state.means.detach())

        def drawn() -> tuple[torch.Tensor, list[torch.Tensor]]:
            model.zero_grad()
            image = model.view(model.splats(model.at(0.2), camera), camera, 0.2)
            image.square().sum().backward()
            return image.detach(), [model.get_parameter(name).grad for name in model.rows]

        image, gradients = drawn()
        monkeypatch.setattr(SpacetimeModel, "_shown", lambda self, time: torch.arange(60))
        everything, of_everything = drawn()
        torch.testing.assert_close(image, everything, rtol=0, atol=1e-6)
        for some, of_all in zip(gradients, of_everything):
            assert some.any()
            torch.testing.assert_close(some, of_all, rtol=1e-4, atol=1e-6)

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

    def test_times_of_gaussians_made_from_others(self, balls: Scene, tmp_path: Path) -> None:
        growing = {"iterations": 4, "hull_points": 0, "grow_from": 0.0, "grow_until": 1.0, "grow_every": 2}
        kept, anywhere = (
            fit(SpacetimeGaussiansLite, balls, tmp_path, **growing, grow_gradient=1e-9, new_times=times).model.times
            for times in ("kept", "anywhere")
        )
        assert min(len(kept), len(anywhere)) > 400
        assert (kept - 0.5).abs().max() < 0.05
        assert (anywhere - 0.5).abs().max() > 0.4


class TestGuidedSampling:
    def test_it_places_gaussians_on_the_rays_of_the_worst_patches(self, balls: Scene) -> None:
        photographs = Photographs(balls.training(), 1000, 1, np.random.default_rng(0))
        photograph = photographs.photograph("2", 3)
        error = np.full((64, 96), 0.1, np.float32)
        error[8:16, 24:32], error[40:48, 80:88] = 0.9, 0.5
        depths = np.linspace(2, 4, 101, dtype=np.float32)
        placed = along_worst_rays(photograph, error, depths, 2, np.random.default_rng(0))
        pixels, depth = photograph.camera.project(placed.positions)
        np.testing.assert_allclose(pixels, np.repeat([[28.5, 12.5], [84.5, 44.5]], PER_RAY, axis=0), atol=1e-3)
        assert depth.min() >= 2
        assert depth.max() <= 4
        assert np.ptp(depth) > 0.5
        np.testing.assert_allclose(placed.colors[0], photograph.image[12, 28] / 255, rtol=1e-6)
        half_a_patch = placed.sizes * photograph.camera.K[0, 0] / depth
        np.testing.assert_allclose(half_a_patch, PATCH / 2, rtol=1e-5)
        assert len(along_worst_rays(photograph, error, depths[:0], 2, np.random.default_rng(0)).positions) == 0

    def test_new_gaussians_have_the_time_of_their_photograph(self, balls: Scene, tmp_path: Path) -> None:
        settings = {"iterations": 2, "hull_points": 0, "grow_from": 1.0, "prune_until": 0.0}
        count = len(fit(SpacetimeGaussiansLite, balls, tmp_path, **settings).model.positions)
        guided = {"guided_until": 0.5, "guided_patches": 3, "guided_every": 10}
        times = fit(SpacetimeGaussiansLite, balls, tmp_path, **settings, **guided).model.times.detach()[count:]
        assert len(times) == 3 * PER_RAY
        assert len(times.round(decimals=3).unique()) == 1

    def test_it_keeps_to_the_limit(self, balls: Scene, tmp_path: Path) -> None:
        settings = {"iterations": 2, "hull_points": 0, "grow_from": 1.0, "max_gaussians": 305, "guided_until": 1.0}
        model = fit(SpacetimeGaussiansLite, balls, tmp_path, **settings, guided_every=1).model
        assert len(model.positions) <= 305

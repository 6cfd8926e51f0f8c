"""What the Gaussian-splatting baselines share: colours, rates, growth, photographs, start, and the liquid in them."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
import torch
from torch import nn

from splashbench.errors import SplashbenchError
from splashbench.gaussians import spherical_harmonics as harmonics
from splashbench.gaussians.density_control import DensityControl, DensitySettings
from splashbench.gaussians.dynamic_model import DynamicModel, Splats, ellipsoids
from splashbench.gaussians.fitting import FitHistory
from splashbench.gaussians.initialization import hull_points, joined, plain_color, static_points
from splashbench.gaussians.mixed_model import MixedFitted
from splashbench.gaussians.optimizer import LearningRate, RowOptimizer
from splashbench.gaussians.photographs import Photographs, unit_time
from splashbench.gaussians.torch_threads import one_torch_thread
from splashbench.harness.contract import Run
from splashbench.harness.discovery import load_method
from splashbench.scene import Camera, Scene, TrainingScene
from splashbench.synth.balls import ball_centers, write_balls_scene


@pytest.fixture(autouse=True)
def _one_thread() -> Iterator[None]:
    with one_torch_thread(), torch.random.fork_rng(devices=[]):
        torch.manual_seed(0)
        yield


class TestHarmonics:
    def test_the_basis_is_orthonormal_on_the_sphere(self) -> None:
        # Gauss-Legendre in z and even steps in the angle integrate polynomials of degree 6 exactly.
        z, weight = np.polynomial.legendre.leggauss(8)
        angle = np.arange(16) / 16 * 2 * np.pi
        s = np.sqrt(1 - z**2)
        directions = np.stack(
            [np.outer(s, np.cos(angle)), np.outer(s, np.sin(angle)), np.outer(z, np.ones(16))], axis=-1
        ).reshape(-1, 3)
        values = harmonics.basis(torch.from_numpy(directions), 3).numpy()
        weights = np.repeat(weight, 16) * 2 * np.pi / 16
        np.testing.assert_allclose((values * weights[:, None]).T @ values, np.eye(16), atol=1e-12)

    def test_order_and_signs_are_those_of_published_point_clouds(self) -> None:
        axes = harmonics.basis(torch.eye(3, dtype=torch.float64), 1).numpy()
        c0, c1 = 0.28209479177387814, 0.4886025119029199
        np.testing.assert_allclose(axes, [[c0, 0, 0, -c1], [c0, -c1, 0, 0], [c0, 0, c1, 0]], atol=1e-15)
        diagonal = torch.full((1, 3), 3**-0.5, dtype=torch.float64)
        second, third = np.split(harmonics.basis(diagonal, 3).numpy()[0, 4:], [5])
        np.testing.assert_allclose(
            second, [1.0925484305920792 / 3, -1.0925484305920792 / 3, 0, -1.0925484305920792 / 3, 0], atol=1e-12
        )
        a, b, c, d = 0.5900435899266435, 2.890611442640554, 0.4570457994644658, 0.3731763325901154
        np.testing.assert_allclose(third * 3**1.5, [-2 * a, b, -2 * c, -4 * d, -2 * c, 0, 2 * a], atol=1e-12)

    def test_a_colour_comes_back_from_its_constant(self) -> None:
        colors = torch.tensor([[0.1, 0.5, 0.9]])
        seen = harmonics.colors(harmonics.constant_of(colors), torch.zeros(1, 0, 3), torch.tensor([[0.0, 0, 1]]), 0)
        torch.testing.assert_close(seen, colors)

    def test_only_the_active_degree_takes_part(self) -> None:
        rest = torch.randn(5, 15, 3)
        direction = nn.functional.normalize(torch.randn(5, 3), dim=1)
        constant = torch.full((5, 3), 0.3)
        flat = harmonics.colors(constant, rest, direction, 0)
        torch.testing.assert_close(flat, harmonics.CONSTANT * constant + 0.5)
        linear = harmonics.colors(constant + 10, rest, direction, 1)
        zeroed = rest.clone()
        zeroed[:, 3:] = 0
        torch.testing.assert_close(linear, harmonics.colors(constant + 10, zeroed, direction, 3))


def test_a_rate_begins_falls_and_stays() -> None:
    rate = LearningRate(1.0, 0.01, until=0.5, begin=0.1)
    assert [rate.at(done) for done in (0.05, 0.25, 0.5, 1.0)] == pytest.approx([0, 0.1, 0.01, 0.01])
    held = LearningRate(1.0, 0.01, until=0.6, hold=0.4)
    assert [held.at(done) for done in (0.0, 0.4, 0.5, 0.6, 1.0)] == pytest.approx([1, 1, 0.1, 0.01, 0.01])


def test_a_short_fit_comes_to_rest_before_it_ends() -> None:
    short = LearningRate(0.3, 0.2, until=0.5, begin=0.1).short()
    assert [short.at(done) for done in (0.05, 0.1, 0.3)] == pytest.approx([0, 0.3, 0.3])
    assert 0.0075 < short.at(0.6) < 0.3
    assert [short.at(done) for done in (0.75, 1.0)] == pytest.approx([0.0075, 0.0075])


class Table(DynamicModel):
    """Gaussians that stay where they are; the smallest model with the tables that density control wants."""

    def __init__(self, positions: np.ndarray, scale: float = 0.05, opacity: float = 0.5) -> None:
        super().__init__()
        n = len(positions)
        self.positions = nn.Parameter(torch.tensor(positions, dtype=torch.float32))
        self.log_scales = nn.Parameter(torch.full((n, 3), float(np.log(scale))))
        self.quaternions = nn.Parameter(torch.tensor([1.0, 0, 0, 0]).repeat(n, 1))
        self.opacity_logits = nn.Parameter(torch.full((n,), float(np.log(opacity / (1 - opacity)))))

    def means(self, time: float) -> torch.Tensor:
        return self.positions

    def splats(self, state: object, camera: Camera) -> Splats:
        colors = torch.full((len(self.positions), 3), 0.5)
        factors = ellipsoids(self.log_scales, self.quaternions)
        return Splats(self.positions, factors, torch.sigmoid(self.opacity_logits), colors)


class Flying(Table):
    """Gaussians in the middle of the balls, at any time."""

    def __init__(self, scene: Scene) -> None:
        super().__init__(ball_centers(scene.times[0]))
        self.first, self.length = float(scene.times[0]), float(scene.times[-1] - scene.times[0])

    def means(self, time: float) -> torch.Tensor:
        return torch.tensor(ball_centers(self.first + time * self.length), dtype=torch.float32)


@pytest.fixture(scope="module")
def late(tmp_path_factory: pytest.TempPathFactory) -> Scene:
    """A scene two of whose cameras are late and early, by which balls move as far as they are large."""
    return write_balls_scene(tmp_path_factory.mktemp("late") / "balls", n_frames=4, delays={"2": 0.06, "4": -0.06})


ROWS = ("positions", "log_scales", "quaternions", "opacity_logits")


def optimizer_of(model: Table, iterations: int = 100) -> RowOptimizer:
    return RowOptimizer(model, {name: LearningRate.constant(0.01) for name in ROWS}, ROWS, iterations)


class TestRows:
    def test_kept_rows_go_on_as_if_nothing_had_happened(self) -> None:
        targets = torch.randn(6, 3)
        models = [Table(np.zeros((6, 3))) for _ in range(2)]
        optimizers = [optimizer_of(model) for model in models]
        for step in range(8):
            kept = torch.arange(6) if step < 4 else torch.tensor([1, 4])
            for i, (model, optimizer) in enumerate(zip(models, optimizers)):
                rows = torch.arange(2) if i == 1 and step >= 4 else kept
                ((model.positions[rows] - targets[kept]) ** 2).sum().backward()
                optimizer.step()
            if step == 3:
                new = {name: models[1].get_parameter(name).detach()[:1] + 7 for name in ROWS}
                optimizers[1].replace_rows(np.array([1, 4]), new)
        torch.testing.assert_close(models[1].positions[:2], models[0].positions[[1, 4]])
        assert len(models[1].positions) == 3

    def test_values_that_are_set_have_no_momentum(self) -> None:
        model = Table(np.zeros((2, 3)))
        optimizer = optimizer_of(model)
        for _ in range(3):
            model.positions.sum().backward()
            optimizer.step()
        optimizer.set_rows("positions", torch.ones(1, 3), torch.tensor([1]))
        (model.positions * 0).sum().backward()
        optimizer.step()
        torch.testing.assert_close(model.positions[1], torch.ones(3))
        assert (model.positions[0] < -0.03).all()  # its momentum goes on


def test_an_orthogonal_step_turns_every_direction_of_a_matrix_by_as_much() -> None:
    network = nn.Sequential(nn.Linear(16, 8), nn.Linear(8, 2))
    first, bias, last = (p.detach().clone() for p in (network[0].weight, network[0].bias, network[1].weight))
    rates = {"0": LearningRate.constant(0.01), "1": LearningRate.constant(0.01)}
    optimizer = RowOptimizer(network, rates, (), 10, orthogonal=("0",))
    strong = torch.zeros(8, 16)
    strong[0] = 100.0
    pull = strong + torch.randn(8, 16)
    (network[0].weight * pull).sum().backward()
    network[0].bias.grad, network[1].weight.grad = torch.ones(8), torch.ones(2, 8)
    optimizer.step()
    step = (network[0].weight.detach() - first).double()
    sizes = torch.linalg.svdvals(step)
    assert sizes.min() > 0.4 * sizes.max()
    assert float((step * pull).sum()) < 0
    # As large as a step of Adam, .2 of the rate on the mean; its bias takes a tenth of Adam's, others Adam's own.
    assert float(step.square().mean().sqrt()) == pytest.approx(0.2 * 0.01, rel=0.3)
    torch.testing.assert_close(network[0].bias.detach(), bias - 0.001)
    torch.testing.assert_close(network[1].weight.detach(), last - 0.01)
    assert network[0].weight.grad is None


def look() -> Camera:
    w2c = np.eye(4)
    w2c[2, 3] = 3
    return Camera("1", 96, 64, np.array([[96.0, 0, 48], [0, 96.0, 32], [0, 0, 1]]), w2c)


def density_of(model: Table, **changes: float) -> DensityControl:
    settings = {"start": 0, "stop": 100, "every": 1, "gradient": 1.0, "large": 0.1, "max_gaussians": 100, **changes}
    return DensityControl(optimizer_of(model), DensitySettings(**settings))  # type: ignore[arg-type]


def pull(model: Table, density: DensityControl, rows: list[int]) -> None:
    """One view in which the loss pulls hard at `rows` and a little at the others."""
    gradients = torch.full((len(model.positions), 3), 1e-4)
    gradients[rows] = 10.0
    density.observe(look(), model.splats(None, look()), gradients)


class TestDensity:
    def test_small_ones_are_cloned_where_the_loss_pulls(self) -> None:
        model = Table(np.arange(12).reshape(4, 3) / 20)
        density = density_of(model)
        pull(model, density, [2])
        density.after_step(0)
        assert len(model.positions) == 5
        torch.testing.assert_close(model.positions[4], model.positions[2])
        torch.testing.assert_close(model.log_scales[4], model.log_scales[2])

    def test_what_a_view_leaves_out_is_not_judged_by_it(self) -> None:
        model = Table(np.array([[-0.5, 0, 0], [0, 0, 0], [0.5, 0, 0]]), scale=0.05)
        density = density_of(model)
        seen, rows = model.splats(None, look()), torch.tensor([0, 2])
        tables = (seen.means, seen.factors, seen.opacities, seen.colors)
        some = Splats(*(table[rows] for table in tables), rows=rows)
        density.observe(look(), some, torch.tensor([[1e-4] * 3, [10.0] * 3]))
        density.after_step(0)
        np.testing.assert_allclose(model.positions.detach()[:, 0], [-0.5, 0, 0.5, 0.5], atol=1e-6)

    def test_large_ones_are_split_within_themselves(self) -> None:
        model = Table(np.zeros((400, 3)), scale=0.5)
        density = density_of(model, max_gaussians=1000)
        pull(model, density, list(range(400)))
        density.after_step(0)
        assert len(model.positions) == 800
        torch.testing.assert_close(torch.exp(model.log_scales), torch.full((800, 3), 0.5 / 1.6))
        spread = model.positions.detach().numpy()
        assert spread.std(axis=0) == pytest.approx([0.5] * 3, rel=0.1)
        assert abs(np.corrcoef(spread[:400, 0], spread[400:, 0])[0, 1]) < 0.15

    def test_faint_ones_go_and_the_strongest_pulls_come_first_within_the_limit(self) -> None:
        model = Table(np.zeros((6, 3)))
        with torch.no_grad():
            model.opacity_logits[0] = -9.0
        density = density_of(model, max_gaussians=7)
        pull(model, density, [0, 3, 4, 5])
        density.observe(look(), model.splats(None, look()), torch.tensor([0.0, 0, 0, 0, 99, 99])[:, None].repeat(1, 3))
        with torch.no_grad():
            model.positions[4:, 0] = torch.tensor([4.0, 5.0])
        density.after_step(0)
        assert model.positions[:, 0].tolist() == [0, 0, 0, 4, 5, 4, 5]

    def test_a_model_of_faint_ones_keeps_one(self) -> None:
        model = Table(np.zeros((3, 3)), opacity=1e-4)
        density = density_of(model)
        density.after_step(0)
        assert len(model.positions) == 1

    def test_pruning_goes_on_after_growth(self) -> None:
        model = Table(np.zeros((3, 3)))
        density = density_of(model, stop=5, prune_until=10)
        with torch.no_grad():
            model.opacity_logits[1] = -9.0
        pull(model, density, [0, 2])
        density.after_step(7)
        assert len(model.positions) == 2

    def test_opacities_are_reset_at_their_steps_alone(self) -> None:
        model = Table(np.zeros((3, 3)), opacity=0.9)
        density = density_of(model, start=1000, reset_every=10, reset_until=25)
        density.after_step(8)
        assert torch.sigmoid(model.opacity_logits).tolist() == pytest.approx([0.9] * 3)
        density.after_step(9)
        assert torch.sigmoid(model.opacity_logits).tolist() == pytest.approx([0.01] * 3)
        with torch.no_grad():
            model.opacity_logits.fill_(2.0)
        density.after_step(29)
        assert model.opacity_logits.tolist() == [2.0] * 3


class TestPhotographs:
    def test_each_comes_once_before_any_comes_again_and_a_step_has_one_time(self, balls: Scene) -> None:
        scene = balls.training()
        photographs = Photographs(scene, 1000, 2, np.random.default_rng(0))
        seen: list[tuple[str, float]] = []
        while len(seen) < len(photographs):
            step = photographs.next()
            assert len({view.time for view in step}) == 1
            seen += [(view.camera.name, view.time) for view in step]
        assert len(set(seen)) == len(seen) == 5 * scene.n_frames
        assert {time for _, time in seen} >= {0.0, 1.0}

    def test_they_are_shrunk_with_their_cameras(self, balls: Scene) -> None:
        scene = balls.training()
        photograph = Photographs(scene, 48, 1, np.random.default_rng(0)).photograph(scene.train[0], 0)
        assert photograph.image.shape == (32, 48, 3) == (photograph.camera.height, photograph.camera.width, 3)
        assert photograph.camera.K[0, 0] == pytest.approx(scene.cameras[scene.train[0]].K[0, 0] / 2)
        assert photograph.image.mean() == pytest.approx(scene.image(scene.train[0], 0).mean(), abs=1)

    def test_times_are_true_ones(self, balls: Scene) -> None:
        scene = balls.training()
        shares = [unit_time(scene, t) for t in scene.times]
        np.testing.assert_allclose(np.diff(shares) / np.diff(scene.times), 1 / (scene.times[-1] - scene.times[0]))
        assert np.ptp(np.diff(shares)) > 0.01  # the steps of this scene are uneven

    def test_a_photograph_has_its_cameras_own_time(self, late: Scene) -> None:
        photographs = Photographs(late.training(), 1000, 1, np.random.default_rng(0))
        for name, delay in (("1", 0.0), ("2", 0.06), ("4", -0.06)):
            wanted = (late.times[2] + delay - late.times[0]) / (late.times[-1] - late.times[0])
            assert photographs.photograph(name, 2).time == pytest.approx(wanted)


class TestStart:
    def test_hull_points_lie_on_the_balls_of_their_frame(self, balls: Scene) -> None:
        scene = balls.training()
        start = hull_points(scene, 60 * scene.n_frames)
        for t in range(scene.n_frames):
            points = start.positions[start.frame == t]
            assert 0 < len(points) <= 60
            distance = np.linalg.norm(points[:, None] - ball_centers(scene.times[t])[None], axis=2).min(axis=1)
            assert np.median(distance) < 0.12  # radii are .06 to .10 m, and hulls of five views a little larger

    def test_the_fullest_frame_alone_may_give_them(self, balls: Scene) -> None:
        start = hull_points(balls.training(), 100, largest_only=True)
        assert len(start) == 100
        assert len(set(start.frame.tolist())) == 1

    def test_static_points_have_the_colours_and_places_of_the_floor(self, balls: Scene) -> None:
        start = static_points(balls.training(), 300, "pixels", np.random.default_rng(0), Run())
        assert 100 < len(start) <= 300
        assert (start.frame == -1).all()
        both = joined(start, hull_points(balls.training(), 40))
        assert len(both) > len(start)

    def test_who_asks_for_sparse_points_is_told_that_there_are_none(self, balls: Scene) -> None:
        scene, said = balls.training(), list[str]()
        run = Run(_report=lambda fraction, message: said.append(message))
        corners = np.array([[x, y, z] for x in range(4) for y in range(4) for z in range(3)], np.float32)
        sparse = np.hstack([corners, np.full((len(corners), 4), 0.5, np.float32)])
        scene.initial_points = lambda: sparse  # type: ignore[method-assign]
        start = static_points(scene, 300, "points", np.random.default_rng(0), run)
        np.testing.assert_array_equal(start.positions, corners)
        assert said == []
        scene.initial_points = lambda: None  # type: ignore[method-assign]
        lifted = static_points(scene, 300, "points", np.random.default_rng(0), run)
        assert "no sparse points" in said[0]
        same = static_points(scene, 300, "pixels", np.random.default_rng(0), run)
        np.testing.assert_array_equal(lifted.positions, same.positions)
        assert len(said) == 1

    def test_colours_are_those_of_the_photographs(self, balls: Scene) -> None:
        colors = hull_points(balls.training(), 400).colors
        assert np.median(colors[:, 2] - colors[:, 0]) > 0.2  # the balls are blue


FLOOR = (0.1, 0.12, 0.25)


class TestPlainViews:
    """Liquid over one colour, as in made-up recordings: no point has a depth there, so there are none."""

    @pytest.fixture
    def plain(self, balls: Scene) -> TrainingScene:
        training = balls.training()
        noise = np.random.default_rng(0).integers(-2, 3, (64, 96, 3))
        pictures = {
            (name, t): np.where(balls.mask(name, t)[..., None], balls.image(name, t), 240 + noise).astype(np.uint8)
            for name in balls.train
            for t in range(balls.n_frames)
        }
        training.image = lambda name, t: pictures[name, t]  # type: ignore[method-assign]
        training.initial_points = lambda: None  # type: ignore[method-assign]
        return training

    def test_the_colour_lies_behind_everything(self, plain: TrainingScene) -> None:
        said = list[str]()
        run = Run(_report=lambda fraction, message: said.append(message))
        start = static_points(plain, 300, "points", np.random.default_rng(0), run)
        assert said == []  # nothing is lifted here
        assert len(start) == 0
        assert start.backdrop is not None
        np.testing.assert_allclose(start.backdrop, 240 / 255, atol=1e-6)
        both = joined(start, hull_points(plain, 100))
        assert len(both) >= 100
        assert both.backdrop is start.backdrop

    def test_a_scene_with_something_in_it_has_none(self, balls: Scene) -> None:
        assert static_points(balls.training(), 300, "pixels", np.random.default_rng(0), Run()).backdrop is None
        gray = np.full((100, 3), 200, np.uint8)
        assert plain_color([gray, gray - 3]) is not None
        assert plain_color([gray, gray - 4]) is None
        gray[7, 1] += 4
        assert plain_color([gray]) is None

    @pytest.mark.parametrize(
        "name", ["deformable_3dgs", "spacetime_gaussians", "spacetime_gaussians_lite", "scaffold_4d"]
    )
    def test_it_is_drawn_and_kept(self, name: str, plain: TrainingScene, balls: Scene, tmp_path: Path) -> None:
        method = load_method(name)
        small = {"iterations": 3, "hull_points": 60, "max_gaussians": 100}
        fitted = method.fit(plain, method.Config.preset("quick", small), Run(directory=tmp_path))
        camera = balls.cameras["6"]
        image = fitted.render(camera, 0.1).rgb
        np.testing.assert_allclose(image[:3, :3], 240 / 255, atol=1 / 255)
        (tmp_path / "model").mkdir()
        fitted.save(tmp_path / "model")
        np.testing.assert_array_equal(method.load(tmp_path / "model", plain).render(camera, 0.1).rgb, image)

    def test_nothing_at_all_is_an_error(self, plain: TrainingScene, tmp_path: Path) -> None:
        plain.image = lambda name, t: np.full((64, 96, 3), 9, np.uint8)  # type: ignore[method-assign]
        plain.mask = lambda name, t: np.zeros((64, 96), bool)  # type: ignore[method-assign]
        method = load_method("scaffold_4d")
        with pytest.raises(SplashbenchError, match=r"there is nothing to start from, .*; correct the masks"):
            method.fit(plain, method.Config.preset("quick", {}), Run(directory=tmp_path))
        with pytest.raises(SplashbenchError, match="raise hull_points"):
            method.fit(plain, method.Config.preset("quick", {"hull_points": 0}), Run(directory=tmp_path))


class TestLiquid:
    @pytest.fixture
    def fitted(self, balls: Scene) -> MixedFitted:
        """Gaussians at the balls of the first frame, and some beside and below them."""
        balls_, floor = ball_centers(balls.times[0]), np.array([FLOOR, [-0.4, -0.3, 0.2]])
        return MixedFitted(Table(np.concatenate([balls_, floor]), opacity=0.95), balls.training())

    def test_it_is_what_lies_inside_all_silhouettes(self, fitted: MixedFitted) -> None:
        assert fitted.liquid(0).tolist() == [True, True, True, False, False]
        particles = fitted.particles()
        assert particles is not None
        assert particles.active[0].all()
        assert particles.active.shape[1] == 3  # what is never liquid is no particle

    def test_opacity_is_of_the_liquid_alone(self, fitted: MixedFitted, balls: Scene) -> None:
        camera = balls.cameras[balls.test[0]]
        render = fitted.render(camera, float(balls.times[0]))
        (floor,), _ = camera.project(np.array([FLOOR]))
        column, row = floor.astype(int)
        assert 2 <= column < camera.width - 2
        assert 2 <= row < camera.height - 2
        assert render.rgb[row, column].mean() > 0.2  # it is drawn
        assert render.alpha[row, column] < 0.05
        (ball,), _ = camera.project(ball_centers(balls.times[0])[:1])
        assert render.alpha[int(ball[1]), int(ball[0])] > 0.8

    def test_silhouettes_are_of_their_cameras_own_times(self, late: Scene) -> None:
        training = late.training()
        assert MixedFitted(Flying(late), training).liquid(2).all()
        training.camera_times = dict.fromkeys(late.cameras, late.times)  # as if all had exposed together
        assert not MixedFitted(Flying(late), training).liquid(2).all()


def test_the_gain_of_the_last_quarter_is_told() -> None:
    assert FitHistory(np.linspace(10, 18, 801, dtype=np.float32)).gained_in_last_quarter() == pytest.approx(2, abs=0.02)
    assert FitHistory(np.full(3, 20, np.float32)).gained_in_last_quarter() == 0

"""SplashSplat from images to images on balls in free flight, whose shape, place and times are known exactly."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import torch

from splashbench.errors import SplashbenchError
from splashbench.harness.contract import Run
from splashbench.render import rasterize_arrays
from splashbench.scene import Scene
from splashbench.scene.particles import Particles
from splashbench.synth.balls import ball_centers, write_balls_scene
from splashbench_methods.splashsplat import FittedSplashSplat, SplashSplat, SplashSplatConfig
from splashbench_methods.splashsplat.appearance.targets import collect_targets
from splashbench_methods.splashsplat.carriers.subframe import locate
from splashbench_methods.splashsplat.model import Liquid
from splashbench_methods.splashsplat.motion.velocity import control_shape
from splashbench_methods.splashsplat.reconstruction import fit_liquid
from splashbench_methods.splashsplat.trace import trace_liquid

TINY = {"hull_cells": 64, "transport_cells": 48, "control_cells": 12, "iterations": 200, "ssim_every": 2}


@pytest.fixture(scope="module")
def fitted(balls: Scene) -> FittedSplashSplat:
    return SplashSplat().fit(balls.training(), SplashSplatConfig.preset("quick", TINY), Run(seed=1))


def liquid_only(scene: Scene, seed: int = 1, **overrides: object) -> Liquid:
    """The liquid over a grey background, without the time that a real background takes."""
    training = scene.training()
    grey = {name: np.full((c.height, c.width, 3), 0.5, np.float32) for name, c in training.cameras.items()}
    config = SplashSplatConfig.preset("quick", TINY | {"iterations": 10} | overrides)
    run = Run(seed=seed)
    return fit_liquid(training, grey, trace_liquid(training, config, run), run)[0]


def test_it_beats_its_own_background_at_the_test_views(balls: Scene, fitted: FittedSplashSplat):
    gains, overlaps = [], []
    for name in balls.test:
        camera = balls.cameras[name]
        for t in range(balls.n_frames):
            mask, truth = balls.mask(name, t), balls.image(name, t) / 255
            render = fitted.render(camera, balls.times[t])
            assert render.rgb.shape == (camera.height, camera.width, 3)
            assert render.rgb.dtype == render.alpha.dtype == np.float32
            assert render.rgb.min() >= 0
            assert render.rgb.max() <= 1
            errors = [((image - truth)[mask] ** 2).mean() for image in (render.rgb, fitted.background.render(camera))]
            gains.append(10 * np.log10(errors[1] / errors[0]))
            found = render.alpha > 0.5
            overlaps.append((found & mask).sum() / (found | mask).sum())
    assert np.mean(gains) > 4
    assert np.mean(overlaps) > 0.75


def test_a_saved_model_renders_the_same_image_in_a_fresh_process(
    balls: Scene, balls_directory: Path, fitted: FittedSplashSplat, tmp_path: Path
):
    fitted.save(tmp_path)
    name, times = balls.test[0], [float(balls.times[3]), 0.4 * balls.times[3] + 0.6 * balls.times[4]]
    code = f"""
import numpy as np
from pathlib import Path
from splashbench.scene import Scene
from splashbench_methods.splashsplat import SplashSplat
scene = Scene.open(Path({str(balls_directory)!r}))
model = SplashSplat().load(Path({str(tmp_path)!r}), scene.training())
views = [model.render(scene.cameras[{name!r}], time) for time in {times!r}]
np.savez({str(tmp_path / "views.npz")!r}, rgb=[v.rgb for v in views], alpha=[v.alpha for v in views])
"""
    subprocess.run([sys.executable, "-c", code], check=True)
    views = np.load(tmp_path / "views.npz")
    for i, time in enumerate(times):
        here = fitted.render(balls.cameras[name], time)
        np.testing.assert_array_equal(views["rgb"][i], here.rgb)
        np.testing.assert_array_equal(views["alpha"][i], here.alpha)
    assert (tmp_path / "static").is_dir()
    assert {path.suffix for path in tmp_path.rglob("*") if path.is_file()} <= {".json", ".npz"}


@pytest.mark.slow
def test_drawn_together_with_the_background_it_is_saved_and_loaded_too(balls: Scene, tmp_path: Path):
    """As in the preset paper: one rasterisation of all Gaussians, in the fit and in what it renders."""
    settings = TINY | {"iterations": 60, "composition": "together", "silhouette_norm": "image", "children": 2}
    settings |= {"scale_residual": "linear", "control_grid": "sides", "between_frames": "forward"}
    config = SplashSplatConfig.preset("quick", settings)
    together = SplashSplat().fit(balls.training(), config, Run(seed=1))
    together.save(tmp_path)
    loaded = SplashSplat().load(tmp_path, balls.training())
    camera, time = balls.cameras[balls.test[0]], float(balls.times[3])
    first, second = together.render(camera, time), loaded.render(camera, time)
    np.testing.assert_array_equal(first.rgb, second.rgb)
    np.testing.assert_array_equal(first.alpha, second.alpha)
    assert loaded.liquid.between_frames == "forward"
    late = float(0.3 * balls.times[3] + 0.7 * balls.times[4])
    np.testing.assert_array_equal(together.render(camera, late).rgb, loaded.render(camera, late).rgb)
    assert len(together.children(camera, late).means) == len(together.children(camera, time).means)
    mask, truth = balls.mask(camera.name, 3), balls.image(camera.name, 3) / 255
    error = ((first.rgb - truth)[mask] ** 2).mean()
    assert error < 0.5 * ((together.background.render(camera) - truth)[mask] ** 2).mean()
    assert (first.alpha > 0.5)[mask].mean() > 0.6
    # The liquid's opacity is of the liquid alone, the image of all Gaussians in one order of depth.
    children = together.children(camera, time)
    assert children is not None
    values = (children.means, children.factors, children.opacities, children.colors)
    shapes = [value.detach().flatten(0, 1).numpy() for value in values]
    _, alone = rasterize_arrays(*shapes, camera)
    np.testing.assert_array_equal(first.alpha, alone.clip(0, 1))
    background = together.background.gaussians(camera)
    everything = [np.concatenate([ours, theirs]) for ours, theirs in zip(shapes, background)]
    rgb, _ = rasterize_arrays(*everything, camera, background=together.background.far_color)
    np.testing.assert_array_equal(first.rgb, rgb.clip(0, 1))


def test_particles_are_the_carriers_near_the_balls(balls: Scene, fitted: FittedSplashSplat):
    particles = fitted.particles()
    assert particles.positions.shape[0] == balls.n_frames
    assert particles.active.any(axis=1).all()
    for t in (0, 4, balls.n_frames - 1):
        distance = np.linalg.norm(particles.at(t)[:, None] - ball_centers(balls.times[t]), axis=2).min(axis=1)
        assert np.median(distance) < 0.12  # the largest ball's radius is 0.1
    assert np.isfinite(particles.velocities).all()


def test_more_carriers_than_a_file_of_particles_holds_hand_out_an_even_share(
    fitted: FittedSplashSplat, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    liquid, whole = fitted.liquid, fitted.particles()
    most = liquid.carriers.count // 3
    monkeypatch.setattr("splashbench.scene.particles.MAX_BYTES", (1 << 16) + 25 * liquid.carriers.n_frames * most)
    chosen = liquid.handed_out
    assert len(chosen) == most
    assert {*np.diff(chosen).tolist()} <= {3, 4}
    part = fitted.particles()
    np.testing.assert_array_equal(part.positions, whole.positions[:, chosen])
    np.testing.assert_array_equal(part.active, whole.active[:, chosen])
    assert part.velocities is not None
    assert whole.velocities is not None
    np.testing.assert_array_equal(part.velocities, whole.velocities[:, chosen])
    part.save(tmp_path / "particles.npz")
    assert Particles.load(tmp_path / "particles.npz").positions.shape == part.positions.shape
    with pytest.raises(SplashbenchError, match="unpacks to more than"):
        whole.save(tmp_path / "whole.npz")
        Particles.load(tmp_path / "whole.npz")


def test_a_row_of_the_particles_is_one_carrier_from_birth_to_end(balls: Scene, fitted: FittedSplashSplat):
    particles = fitted.particles()
    births, ends = fitted.liquid.carriers.births_and_ends()
    frame = np.arange(balls.n_frames)[:, None]
    np.testing.assert_array_equal(particles.active, (frame >= births) & (frame <= ends))
    assert (ends > births).mean() > 0.3  # enough of them live on for the energy to mean something
    # Between two frames of its life a carrier moves by the velocity (at most 8 voxels) and the correction (at most 1);
    # both places are rounded.
    rounding = 3**0.5 / fitted.liquid.precision.steps
    alive = particles.active[1:] & particles.active[:-1]
    moved = np.linalg.norm(np.diff(particles.positions, axis=0), axis=2)[alive] / fitted.liquid.grid.voxel
    assert moved.max() <= 9 + rounding
    # What it does between them is the forecast, but for the correction.
    liquid = fitted.liquid
    for t in range(balls.n_frames - 1):
        rows, lives = liquid.carriers.rows(t), alive[t, liquid.carriers.ids[liquid.carriers.rows(t)]]
        x, F = liquid.carriers.positions[rows][lives], liquid.carriers.deformation[rows][lives]
        ids = liquid.carriers.ids[rows][lives]
        there, _ = liquid.motion.step(t).forecast(x, F)
        off = np.linalg.norm(liquid.grid.to_voxels(particles.positions[t + 1, ids]) - there, axis=1)
        assert off.max() <= 1 + rounding


def test_particle_velocities_are_seconds_not_frames(balls: Scene, fitted: FittedSplashSplat):
    particles = fitted.particles()
    steps = np.diff(balls.times)
    speeds = [np.linalg.norm(particles.velocities[t][particles.active[t]], axis=1) for t in range(len(steps))]
    displacements = [speed * step / fitted.liquid.grid.voxel for speed, step in zip(speeds, steps)]
    assert max(map(np.max, displacements)) <= 8.01  # the fit's limit, voxels a frame
    assert 0.2 < np.median(np.concatenate(speeds)) < 3  # the balls fly at about a metre a second


@pytest.mark.parametrize(("t", "sign"), [(2, 1), (3, -1)])
def test_between_frames_carriers_move_on_and_appearance_stays(fitted: FittedSplashSplat, t: int, sign: int):
    track = fitted.liquid.track
    exact = track.state(t).positions
    moved = [(track.state(t, sign * share).positions - exact).norm(dim=1) for share in (0.2, 0.4)]
    assert float(moved[0].mean()) > 0
    assert float((moved[1] / moved[0].clamp_min(1e-6)).median()) == pytest.approx(2, abs=0.15)


def test_from_either_frame_the_middle_of_a_step_is_the_same_place(fitted: FittedSplashSplat):
    """Carriers that live through the step are nearly where both frames say, against what they move in it."""
    track = fitted.liquid.track
    _, mine, theirs = np.intersect1d(track.ids(4).numpy(), track.ids(5).numpy(), return_indices=True)
    gap = (track.state(4, 0.5).positions[mine] - track.state(5, -0.5).positions[theirs]).norm(dim=1)
    way = (track.state(5).positions[theirs] - track.state(4).positions[mine]).norm(dim=1)
    assert len(mine) > 100
    assert float(gap.median()) < 0.25 * float(way.median())


def test_a_video_does_not_jump_half_way_between_frames(balls: Scene, fitted: FittedSplashSplat):
    camera, (start, stop) = balls.cameras[balls.test[0]], balls.times[2:4]
    before, middle, after = (
        fitted.render(camera, (1 - share) * start + share * stop).rgb for share in (0.49, 0.499, 0.501)
    )
    assert np.abs(after - middle).mean() < 0.5 * np.abs(middle - before).mean()


@pytest.mark.parametrize(
    ("time", "frame", "fraction"),
    [
        (-1, 0, 0),
        (0, 0, 0),
        (0.25, 0, 0.25),
        (0.75, 1, -0.25),
        (1.0000001, 1, 0),
        (2.0, 1, 0.5),
        (2.5, 2, -0.25),
        (2.9999999, 2, 0),
        (9, 2, 0),
    ],
)
def test_times_are_located_on_uneven_steps(time, frame, fraction):
    assert locate(np.array([0.0, 1.0, 3.0]), time) == (frame, pytest.approx(fraction))


def test_the_silhouette_term_averages_over_image_window_or_mask(balls: Scene):
    liquid = liquid_only(balls)
    training = balls.training()
    grey = {name: np.full((c.height, c.width, 3), 0.5, np.float32) for name, c in training.cameras.items()}
    image, window, mask = (collect_targets(training, grey, liquid.track, norm) for norm in ("image", "window", "mask"))
    assert len(image) == len(window) == len(mask) > 10
    for whole, part, wet in zip(image, window, mask):
        # The paper: |Omega| pixels, and nothing that a Gaussian does in the image goes unseen.
        assert whole.area == whole.camera.width * whole.camera.height
        assert (whole.camera.width, whole.camera.height) == (training.cameras["1"].width, training.cameras["1"].height)
        assert wet.area == float(wet.photograph.mask.sum()) < part.area < whole.area
        assert part.camera.width * part.camera.height < whole.area


def test_photographs_of_before_the_first_and_after_the_last_timestep_teach_nothing(balls: Scene):
    liquid = liquid_only(balls)
    training = balls.training()
    grey = {name: np.full((c.height, c.width, 3), 0.5, np.float32) for name, c in training.cameras.items()}

    def count(late: float) -> int:
        step = float(np.diff(balls.times).mean())
        training.camera_times = {**balls.camera_times, "1": balls.times + late * step}
        targets = collect_targets(training, grey, liquid.track, "window", camera_times=True)
        return sum(target.camera.name == "1" for target in targets)

    assert count(0.4) == count(0.0)
    assert count(2.0) == count(-2.0) == count(0.0) - 2
    training.camera_times = {**balls.camera_times, "1": balls.times + 1.0}
    assert len(collect_targets(training, grey, liquid.track, "window")) == 5 * balls.n_frames


@pytest.mark.slow
# Figures are within the masks, where the background hardly counts; it would take most of the time.
@pytest.mark.usefixtures("short_background")
def test_photographs_are_compared_with_the_liquid_at_their_cameras_own_times(tmp_path: Path):
    """Three of five cameras expose up to half a step early or late; the test views are in time."""
    n_frames = 6
    step = 0.33 / (n_frames - 1)
    delays = {"1": -0.4 * step, "3": 0.45 * step, "5": -0.3 * step}
    scene = write_balls_scene(tmp_path / "late", n_frames=n_frames, delays=delays)
    psnr = {}
    for camera_times in (True, False):
        config = SplashSplatConfig.preset("quick", TINY | {"camera_times": camera_times})
        fitted = SplashSplat().fit(scene.training(), config, Run(seed=1))
        for views in (tuple(delays), scene.test):
            values = []
            for name in views:
                for t in range(1, n_frames - 1):
                    mask = scene.mask(name, t)
                    render = fitted.render(scene.cameras[name], float(scene.camera_times[name][t]))
                    values.append(-10 * np.log10(((render.rgb - scene.image(name, t) / 255)[mask] ** 2).mean()))
            psnr[camera_times, views] = np.mean(values)
    assert psnr[True, tuple(delays)] > psnr[False, tuple(delays)] + 0.7
    assert psnr[True, scene.test] > psnr[False, scene.test] + 0.2


def test_the_same_seed_gives_the_same_liquid_bit_for_bit(balls: Scene):
    first, second, other = liquid_only(balls), liquid_only(balls), liquid_only(balls, seed=2)
    assert torch.equal(first.appearance.features, second.appearance.features)
    np.testing.assert_array_equal(first.carriers.positions, second.carriers.positions)
    np.testing.assert_array_equal(first.motion.velocities, second.motion.velocities)
    assert not torch.equal(first.appearance.features[:100], other.appearance.features[:100])


@pytest.mark.slow
def test_the_ablations_differ_as_the_paper_says(balls: Scene):
    full = liquid_only(balls, prune_opacity=0)
    alone = liquid_only(balls, prune_opacity=0, variant="no_resampling")
    anew = liquid_only(balls, prune_opacity=0, variant="per_frame")
    last = balls.n_frames - 1
    active = [np.diff(liquid.carriers.starts)[last] for liquid in (full, alone, anew)]
    assert active[1] < 0.7 * active[0]  # without resampling carriers die out
    assert full.carriers.count < 0.9 * anew.carriers.count  # transport stores fewer than reseeding
    assert (anew.motion.velocities == 0).all()


@pytest.mark.slow
def test_transparent_carriers_are_dropped(balls: Scene):
    kept = liquid_only(balls, prune_opacity=0, iterations=0)
    opacity = kept.appearance.decoder.mean_opacity(kept.appearance.features).detach()
    threshold = float(opacity.quantile(0.25))
    strict = liquid_only(balls, prune_opacity=threshold, iterations=0)
    assert strict.carriers.count == pytest.approx(int((opacity >= threshold).sum()), rel=0.01)
    assert 0.5 * kept.carriers.count < strict.carriers.count < 0.9 * kept.carriers.count
    assert len(strict.appearance.features) == strict.carriers.count
    assert strict.carriers.ids.max() == strict.carriers.count - 1
    # During a fit, too, at the opacities that it has come to.
    assert 0 < liquid_only(balls, prune_opacity=threshold).carriers.count < liquid_only(balls).carriers.count


def test_one_training_view_is_not_enough(balls: Scene):
    training = balls.training()
    training.train = ("3",)
    support = SplashSplat().supports(training)
    assert not support.ok
    assert support.reason == "needs 2 training views, and has 1"
    assert SplashSplat().supports(balls.training()).ok


def test_the_paper_preset_is_the_papers():
    paper = SplashSplatConfig.preset("paper")
    assert (paper.hull_cells, paper.transport_cells, paper.control_cells) == (176, 96, 24)
    # 24^3 control cells in any box, and 0.6 transport voxels.
    assert control_shape((96, 37, 53), paper.motion.factor((96, 37, 53))) == (24, 24, 24)
    assert (paper.iterations, paper.learning_rate_features, paper.learning_rate_heads) == (3000, 2e-3, 2e-3)
    weights = paper.optimisation.weights
    assert tuple(vars(weights).values()) == (0.5, 0.1, 0.2, 0.7, 0.01, 0.1, 1.0, 0.0)  # the last is not the paper's
    velocity = paper.motion.velocity
    assert (velocity.steps, velocity.step_size, velocity.band, velocity.limit) == (35, 0.45, 4.0, 8.0)
    assert (velocity.smooth, velocity.smoothing, velocity.smoothing_unit) == ("field", 0.6, "transport")
    shell = paper.carriers.shell
    assert (shell.min_per_cell, shell.max_per_cell, shell.depth, shell.outside) == (2, 5, 3.0, 0.0)
    assert (shell.interior_per_cell, paper.coverage_reach) == (None, 0)
    assert (paper.decoder.feature_size, paper.decoder.children, paper.decoder.scale_residual) == (32, 2, "linear")
    assert (paper.silhouette_norm, paper.composition, paper.between_frames) == ("image", "together", "forward")
    # What the paper does not say is as its README's table of constants has it.
    assert (paper.base_scale, paper.decoder.offset_bound, paper.decoder.opacity_band) == (0.35, 1.0, 3.0)
    assert paper.decoder.opacity_bias == 1.0
    best = SplashSplatConfig()
    assert (best.carriers.shell.depth, best.in_transparent_container().carriers.shell.depth) == (12.0, 6.0)
    assert paper.in_transparent_container() == paper
    early = [
        c.optimisation.idle_early for c in (best, best.in_transparent_container(), paper.in_transparent_container())
    ]
    assert early == [False, True, False]
    assert (best.base_scale, best.decoder.offset_bound, best.decoder.opacity_band) == (0.5, 3.0, 20.0)
    assert (paper.fields.detect_failed_masks, paper.fields.replace_empty_masks) == (False, False)

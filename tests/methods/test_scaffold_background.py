"""The static background as a whole: what it shows in views it has not seen, and that it can be kept."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from splashbench_methods.controls.nothing import Nothing
from splashbench_methods.scaffold_gs import Background, BackgroundSettings, ScaffoldGS, StaticScene, fit_background

from splashbench.adapter.contract import Run
from splashbench.errors import SplashbenchError
from splashbench.scene import Scene

SETTINGS = BackgroundSettings(iterations=150, anchors=1500, children=3, longest_side=96)


def psnr(image: np.ndarray, expected: np.ndarray, where: np.ndarray) -> float:
    return float(-10 * np.log10(((image - expected)[where] ** 2).mean()))


@pytest.fixture(scope="module")
def background(balls: Scene) -> Background:
    return fit_background(balls.training(), SETTINGS, Run(seed=1))


def test_unseen_views_show_the_scene_without_its_liquid(balls: Scene, background: Background):
    for name in balls.test:
        dry = ~np.any([balls.mask(name, t) for t in range(balls.n_frames)], axis=0)
        truth = balls.image(name, 0) / 255.0
        fitted = psnr(background.render(balls.cameras[name]), truth, dry)
        flat = psnr(np.broadcast_to(background.far_color, truth.shape), truth, dry)
        assert fitted > 20, f"camera {name}: {fitted:.1f} dB"
        assert fitted > flat + 5, f"camera {name}: {fitted:.1f} dB, one colour {flat:.1f} dB"


def test_where_liquid_passes_the_background_shows_what_lies_behind(balls: Scene, background: Background):
    # The balls are blue, the floor is not: no pixel of the plate may take the liquid's colour.
    name = balls.train[2]
    wet = np.any([balls.mask(name, t) for t in range(balls.n_frames)], axis=0)
    rendered = background.render(balls.cameras[name])[wet]
    liquid = balls.image(name, 3)[balls.mask(name, 3)] / 255.0
    excess = lambda rgb: (rgb[:, 2] - rgb[:, 0]).mean()  # noqa: E731
    assert excess(rendered) < 0.25 * excess(liquid)


def test_the_same_seed_gives_the_same_background(balls: Scene):
    small = BackgroundSettings(iterations=8, anchors=200, children=2, longest_side=64)
    camera = balls.cameras[balls.test[0]]
    first, again = (fit_background(balls.training(), small, Run(seed=3)).render(camera) for _ in range(2))
    other = fit_background(balls.training(), small, Run(seed=4)).render(camera)
    np.testing.assert_array_equal(first, again)
    assert np.abs(first - other).max() > 1e-3


def test_what_was_saved_renders_the_same_bits(balls: Scene, background: Background, tmp_path: Path):
    fitted = StaticScene(background)
    fitted.save(tmp_path)
    assert [p.relative_to(tmp_path).as_posix() for p in tmp_path.rglob("*") if p.is_file()] == ["static/background.npz"]
    loaded = ScaffoldGS().load(tmp_path, balls.training())
    camera = balls.cameras[balls.test[0]]
    one, other = fitted.render(camera, 0.0), loaded.render(camera, 0.2)
    np.testing.assert_array_equal(one.rgb, other.rgb)
    assert one.rgb.dtype == one.alpha.dtype == np.float32
    assert (other.alpha == 0).all()
    assert loaded.particles() is None


def test_a_damaged_file_is_one_line_naming_it(background: Background, tmp_path: Path):
    background.save(tmp_path)
    path = tmp_path / "background.npz"
    with np.load(path) as archive:
        arrays = dict(archive)
    np.savez(path, **{**arrays, "offsets": arrays["offsets"][:, :1]})
    with pytest.raises(SplashbenchError, match=r"background\.npz.*fit the background again"):
        Background.load(tmp_path)
    path.write_bytes(path.read_bytes()[:500])
    with pytest.raises(SplashbenchError, match=r"background\.npz"):
        Background.load(tmp_path)


def test_anchors_without_evidence_are_dropped(balls: Scene, background: Background):
    # Every anchor left weighs on some seen training pixel, so none lies behind all cameras.
    positions = background.model.positions.numpy()
    assert 100 < len(positions) <= SETTINGS.anchors
    seen = np.zeros(len(positions), bool)
    for name in balls.train:
        camera = balls.cameras[name]
        uv, depth = camera.project(positions)
        margin = 0.5 * camera.width
        inside = (uv > -margin).all(1) & (uv[:, 0] < camera.width + margin) & (uv[:, 1] < camera.height + margin)
        seen |= inside & (depth > 0)
    assert seen.all()


def test_a_scene_without_sparse_points_is_fitted_too(balls_copy: Path):
    (balls_copy / "init_pt_cld.npz").unlink()
    scene = Scene.open(balls_copy)
    background = fit_background(scene.training(), SETTINGS, Run(seed=0))
    name = scene.train[0]
    dry = ~np.any([scene.mask(name, t) for t in range(scene.n_frames)], axis=0)
    assert psnr(background.render(scene.cameras[name]), scene.image(name, 0) / 255.0, dry) > 18


def test_progress_stays_within_the_part_that_was_asked_for(balls: Scene):
    heard: list[float] = []
    run = Run(seed=0, _report=lambda fraction, message: heard.append(fraction))
    small = BackgroundSettings(iterations=25, anchors=100, children=1, longest_side=48)
    fit_background(balls.training(), small, run, span=(0.2, 0.6))
    assert heard == sorted(heard)
    assert 0.2 <= heard[0] < heard[-1] < 0.6


def test_nothing_is_the_background_as_a_control():
    assert Nothing.control
    assert not ScaffoldGS.control
    assert (Nothing.id, ScaffoldGS.id) == ("nothing", "scaffold_gs")
    assert Nothing.Config.preset("quick") == ScaffoldGS.Config.preset("quick")
    assert {"best", "paper", "quick"} <= set(Nothing.Config.presets)

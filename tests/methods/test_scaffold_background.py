"""The static background as a whole: what it shows in views it has not seen, and that it can be kept."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest

from splashbench import parallel
from splashbench.errors import SplashbenchError
from splashbench.harness.contract import Run
from splashbench.native.threads import use_threads
from splashbench.scene import Scene
from splashbench_methods.controls.nothing import Nothing
from splashbench_methods.scaffold_gs import Background, BackgroundSettings, ScaffoldGS, StaticScene, fit_background

SETTINGS = BackgroundSettings(iterations=150, max_anchors=1500, children=3, longest_side=96)


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


TINY = BackgroundSettings(iterations=8, max_anchors=200, children=2, longest_side=64)
GROWING = BackgroundSettings(
    start="points", iterations=12, max_anchors=400, children=2, grow_until=1, grow_every=4, grow_gradient=1e-5
)


@pytest.mark.parametrize("settings", [TINY, GROWING], ids=["seeded", "growing"])
def test_the_same_seed_gives_the_same_bytes_on_any_number_of_threads(
    balls: Scene, settings: BackgroundSettings, monkeypatch: pytest.MonkeyPatch
):
    def image(seed: int, threads: int) -> np.ndarray:
        monkeypatch.setattr(parallel, "thread_count", lambda: threads)
        with use_threads(threads):
            return fit_background(balls.training(), settings, Run(seed=seed)).render(balls.cameras[balls.test[0]])

    first = image(3, 1)
    np.testing.assert_array_equal(first, image(3, 3))
    assert np.abs(first - image(4, 1)).max() > 1e-3


def test_depth_is_that_of_what_is_seen_and_infinite_where_nothing_is(balls: Scene, background: Background):
    camera = balls.cameras[balls.test[0]]
    depth = background.depth(camera)
    assert depth.shape == (camera.height, camera.width)
    assert depth.dtype == np.float32
    means, _, opacities, _ = background.gaussians(camera)
    uv, distance = camera.project(means)
    column, row = np.floor(uv).astype(int).T
    inside = (distance > 0) & (opacities > 0.3) & (uv >= 0).all(1) & (column < camera.width) & (row < camera.height)
    ratio = distance[inside] / depth[row[inside], column[inside]]
    assert abs(np.median(ratio) - 1) < 0.05
    # Turned around, the camera sees no Gaussian at all.
    turned = np.diag([-1.0, 1, -1, 1]) @ camera.w2c
    behind = type(camera)(camera.name, camera.width, camera.height, camera.K, turned)
    assert np.isposinf(background.depth(behind)).all()


def _paint(path: Path, change) -> None:  # type: ignore[no-untyped-def]
    image = cv2.imread(str(path), cv2.IMREAD_UNCHANGED)
    assert cv2.imwrite(str(path), change(image))


def test_the_first_frame_alone_is_used_where_that_is_asked_for(balls_copy: Path):
    scene = Scene.open(balls_copy)
    camera = scene.cameras[scene.test[0]]
    first = BackgroundSettings(**{**TINY.model_dump(), "frames": "first"})

    def image(settings: BackgroundSettings) -> np.ndarray:
        return fit_background(scene.training(), settings, Run(seed=0)).render(camera)

    before = image(first), image(TINY)
    for name in scene.train:
        for t in range(1, scene.n_frames):
            _paint(scene.image_path(name, t), lambda old: 255 - old)
            _paint(scene.mask_path(name, t), np.zeros_like)
    np.testing.assert_array_equal(image(first), before[0])
    assert np.abs(image(TINY) - before[1]).max() > 0.1


def test_liquid_of_the_first_frame_is_not_baked_in(balls_copy: Path):
    scene = Scene.open(balls_copy)
    for name in scene.train:
        wet = scene.mask(name, 0)
        assert wet.any()
        _paint(scene.image_path(name, 0), lambda old, wet=wet: np.where(wet[..., None], (255, 0, 255), old))
    settings = BackgroundSettings(**{**SETTINGS.model_dump(), "frames": "first", "iterations": 40})
    background = fit_background(scene.training(), settings, Run(seed=0))
    rendered = background.render(scene.cameras[scene.train[2]])[scene.mask(scene.train[2], 0)]
    magenta = rendered[:, [0, 2]].min(axis=1) - rendered[:, 1]
    assert magenta.mean() < 0.2


@pytest.mark.parametrize("settings", [TINY, GROWING], ids=["seeded", "growing"])
def test_a_single_training_view_is_enough(balls: Scene, settings: BackgroundSettings):
    scene = balls.training()
    scene.train = scene.train[:1]
    background = fit_background(scene, settings, Run(seed=0))
    assert len(background.model) > 0
    assert np.isfinite(background.render(balls.cameras[balls.test[0]])).all()


def test_a_view_that_is_liquid_throughout_is_left_out_and_all_of_them_are_an_error(balls_copy: Path):
    scene = Scene.open(balls_copy)
    full = lambda old: np.full_like(old, 255)  # noqa: E731
    for t in range(scene.n_frames):
        _paint(scene.mask_path(scene.train[0], t), full)
    background = fit_background(scene.training(), SETTINGS, Run(seed=0))
    name = scene.train[2]
    dry = ~np.any([scene.mask(name, t) for t in range(scene.n_frames)], axis=0)
    assert psnr(background.render(scene.cameras[name]), scene.image(name, 0) / 255.0, dry) > 18
    for name in scene.train[1:]:
        _paint(scene.mask_path(name, 0), full)
    with pytest.raises(SplashbenchError, match=r"every training view in frame 0; fix the masks"):
        fit_background(scene.training(), BackgroundSettings(frames="first"), Run(seed=0))
    for name in scene.train[1:]:
        for t in range(scene.n_frames):
            _paint(scene.mask_path(name, t), full)
    with pytest.raises(SplashbenchError, match=r"every training view throughout; fix the masks"):
        fit_background(scene.training(), TINY, Run(seed=0))


def test_cameras_may_differ_in_size(balls: Scene):
    class Sizes:
        """The balls, with the first training view cropped."""

        def __init__(self) -> None:
            self.inner = balls.training()
            self.train, self.n_frames, self.directory = self.inner.train, self.inner.n_frames, self.inner.directory
            self.initial_points = self.inner.initial_points
            name = self.train[0]
            self.cameras = {**self.inner.cameras, name: self.inner.cameras[name].cropped(10, 6, 60, 50)}

        def _window(self, name: str, array: np.ndarray) -> np.ndarray:
            return array[6:56, 10:70] if name == self.train[0] else array

        def image(self, name: str, t: int) -> np.ndarray:
            return self._window(name, self.inner.image(name, t))

        def mask(self, name: str, t: int) -> np.ndarray:
            return self._window(name, self.inner.mask(name, t))

    for settings in (TINY, GROWING):
        background = fit_background(Sizes(), settings, Run(seed=0))  # type: ignore[arg-type]
        assert np.isfinite(background.render(balls.cameras[balls.test[0]])).all()


def test_without_sparse_points_the_hull_is_started_from_and_the_user_is_told(balls_copy: Path):
    path = balls_copy / "init_pt_cld.npz"
    np.savez(path, data=np.empty((0, 7), np.float32))
    scene = Scene.open(balls_copy)
    heard: list[str] = []
    run = Run(seed=0, _report=lambda fraction, message: heard.append(message))
    empty = fit_background(scene.training(), GROWING, run).model
    assert len(empty) > 0
    assert "background, from points of the liquid's hull, as the scene has no sparse ones" in heard
    # The balls fly above the floor, and nowhere else is there anything to start from.
    truth = scene.truth_particles().positions.reshape(-1, 3)
    size = np.ptp(truth, axis=0).max()
    distance = np.abs(empty.positions.numpy()[:, None] - truth[None]).max(axis=2).min(axis=1)
    assert np.median(distance) < 0.2 * size
    path.unlink()
    absent = fit_background(scene.training(), GROWING, Run(seed=0)).model
    np.testing.assert_array_equal(absent.positions.numpy(), empty.positions.numpy())


def test_where_there_is_no_hull_either_sparse_points_are_asked_for(balls_copy: Path):
    (balls_copy / "init_pt_cld.npz").unlink()
    scene = Scene.open(balls_copy)
    for name in scene.train:
        for t in range(scene.n_frames):
            _paint(scene.mask_path(name, t), np.zeros_like)
    with pytest.raises(SplashbenchError, match=r"init_pt_cld\.npz holds no points.*start=pixels"):
        fit_background(scene.training(), GROWING, Run(seed=0))
    assert len(fit_background(scene.training(), TINY, Run(seed=0)).model) > 0


def test_presets_are_the_papers_and_ours():
    paper, best, quick = (BackgroundSettings.preset(name) for name in ("paper", "best", "quick"))
    assert isinstance(paper, BackgroundSettings)
    assert (paper.frames, paper.start, paper.iterations, paper.children) == ("first", "points", 20_000, 10)
    assert paper.grow_from * paper.iterations == 1500
    assert round(paper.grow_until * paper.iterations) == 14_999
    assert (paper.grow_every, paper.grow_gradient, paper.prune_opacity) == (100, 2e-4, 0.005)
    for ours in (best, quick):
        assert isinstance(ours, BackgroundSettings)
        assert (ours.frames, ours.start) == ("all", "pixels")
    assert next(iter(BackgroundSettings.presets)) == "best"


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
    assert 100 < len(positions) <= SETTINGS.max_anchors
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
    small = BackgroundSettings(iterations=25, max_anchors=100, children=1, longest_side=48)
    fit_background(balls.training(), small, run, span=(0.2, 0.6))
    assert heard == sorted(heard)
    assert 0.2 <= heard[0] < heard[-1] < 0.6


def test_nothing_is_the_background_as_a_control():
    assert Nothing.control
    assert not ScaffoldGS.control
    assert (Nothing.id, ScaffoldGS.id) == ("nothing", "scaffold_gs")
    assert Nothing.Config.preset("quick") == ScaffoldGS.Config.preset("quick")
    assert {"best", "paper", "quick"} <= set(Nothing.Config.presets)

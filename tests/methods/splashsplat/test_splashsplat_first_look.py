"""What a fit begins with: carriers in the colours of the photographs, and a draft where states of the fit are taken."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from splashbench import parallel
from splashbench.errors import SplashbenchError
from splashbench.files.images import read_image, write_png
from splashbench.harness import side_by_side
from splashbench.harness.checkpoints import Checkpoints
from splashbench.harness.contract import Run
from splashbench.scene import Scene
from splashbench_methods import scaffold_gs
from splashbench_methods.splashsplat import SplashSplat, SplashSplatConfig, course
from splashbench_methods.splashsplat.appearance import fitting
from splashbench_methods.splashsplat.appearance.coarse import with_smaller
from splashbench_methods.splashsplat.appearance.decoder import Decoder, DecoderSettings
from splashbench_methods.splashsplat.appearance.first_look import FirstLook, Look, photographed, take_on
from splashbench_methods.splashsplat.appearance.fitting import Appearance
from splashbench_methods.splashsplat.appearance.photographs import read_now
from splashbench_methods.splashsplat.appearance.projection import projected_extent
from splashbench_methods.splashsplat.appearance.targets import TrainingTarget, collect_targets
from splashbench_methods.splashsplat.carriers.subframe import CarrierState, Track
from splashbench_methods.splashsplat.motion import advection
from splashbench_methods.splashsplat.trace import trace_liquid

# Nothing here asks how good the background is, which would take most of the time.
pytestmark = pytest.mark.usefixtures("short_background")

TINY = {"hull_cells": 64, "transport_cells": 48, "control_cells": 12, "iterations": 20}


@pytest.fixture(scope="module")
def taught(balls: Scene) -> tuple[Track, list[TrainingTarget]]:
    training = balls.training()
    grey = {name: np.full((c.height, c.width, 3), 0.5, np.float32) for name, c in training.cameras.items()}
    traced = trace_liquid(training, SplashSplatConfig.preset("quick", TINY), Run(seed=1))
    track = traced.track
    return track, collect_targets(training, grey, track, "window")


def test_carriers_have_the_colour_of_the_photographs_that_see_them(
    balls: Scene, taught: tuple[Track, list[TrainingTarget]]
) -> None:
    track, targets = taught
    look = photographed(track, targets)
    colors = look.colors
    assert colors.dtype == np.float32
    assert colors.shape == (track.carriers.count, 3)
    # At test views, the nearest carrier of a pixel has about the pixel's colour; the mean of all is much farther off.
    errors, spread = [], []
    for name in balls.test:
        camera = balls.cameras[name]
        for t in range(balls.n_frames):
            pixels, depth = camera.project(track.state(t).positions.numpy())
            row, column = np.clip(pixels.astype(int).T[::-1], 0, [[camera.height - 1], [camera.width - 1]])
            order = np.argsort(depth)
            _, first = np.unique(row[order] * camera.width + column[order], return_index=True)
            front = order[first]
            front = front[balls.mask(name, t)[row[front], column[front]]]
            truth = balls.image(name, t)[row[front], column[front]] / 255
            errors.append(np.abs(colors[track.ids(t).numpy()[front]] - truth).mean(axis=1))
            spread.append(np.abs(truth - colors.mean(axis=0)).mean(axis=1))
    assert np.median(np.concatenate(errors)) < 0.4 * np.median(np.concatenate(spread))


def test_a_look_is_the_weighted_mean_over_photographs(taught: tuple[Track, list[TrainingTarget]]) -> None:
    """One photograph, part of whose carriers are hidden, against the definition in plain NumPy."""
    track, targets = taught
    target = max(targets, key=lambda target: track.carriers.rows(target.frame).stop)
    positions = track.state(target.frame).positions.numpy()
    hidden = torch.from_numpy((np.arange(len(positions)) % 3 == 0).astype(np.uint8) * 255)
    photograph = read_now(target.photograph)
    mask = photograph.mask.numpy()
    pixels, depth = target.camera.project(positions)
    cells = np.floor(pixels).astype(int) - (photograph.left, photograph.top)
    seen = (cells >= 0).all(axis=1) & (cells < mask.shape[::-1]).all(axis=1) & (np.arange(len(depth)) % 3 != 0)
    seen[seen] = mask[cells[seen, 1], cells[seen, 0]]
    nearest = np.full(mask.shape, np.inf)
    np.minimum.at(nearest, (cells[seen, 1], cells[seen, 0]), depth[seen])
    colors = photograph.image.numpy()[cells[seen, 1], cells[seen, 0]] / 255
    front = depth[seen] <= nearest[cells[seen, 1], cells[seen, 0]] + track.grid.voxel
    assert 0 < front.mean() < 1
    look = photographed(track, [replace(target, hidden=hidden)])
    ids = track.ids(target.frame).numpy()
    np.testing.assert_allclose(look.colors[ids[seen]], colors, atol=1e-6)
    weights = np.where(front, 1.0, 0.01)
    unseen = np.setdiff1d(np.arange(track.carriers.count), ids[seen])
    mean = (weights[:, None] * colors).sum(axis=0) / weights.sum()
    np.testing.assert_allclose(look.colors[unseen], np.broadcast_to(mean, (len(unseen), 3)), atol=1e-6)


def test_where_carriers_lie_in_a_photograph_is_what_the_camera_says(taught: tuple[Track, list[TrainingTarget]]) -> None:
    track, targets = taught
    camera = targets[0].camera
    for fraction in (0.0, 0.3, -0.4):
        positions = track.positions(1, fraction)
        np.testing.assert_array_equal(positions, track.state(1, fraction).positions.numpy())
        behind = np.concatenate([positions, 2 * camera.center[None].astype(np.float32) - positions])
        pixels, depth = camera.project(behind)
        shown = pixels[depth > 0]
        expected = [*shown.min(axis=0), *shown.max(axis=0)]
        np.testing.assert_allclose(projected_extent(camera, behind), expected, rtol=1e-9)
    assert projected_extent(camera, behind[depth <= 0]) is None
    assert projected_extent(camera, positions[:0]) is None


@pytest.mark.usefixtures("no_hang")
def test_photographs_between_two_frames_are_looked_at_on_several_threads(
    balls: Scene, taught: tuple[Track, list[TrainingTarget]], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Positions between frames are made in parts, by the threads that look: these must not wait for each other."""
    track, _ = taught
    training = balls.training()
    grey = {name: np.full((c.height, c.width, 3), 0.5, np.float32) for name, c in training.cameras.items()}
    targets = collect_targets(training, grey, track, "window", blocks=4)
    last = balls.n_frames - 1
    between = [replace(target, fraction=0.3) for target in targets if target.frame < last]
    once = photographed(track, between)
    monkeypatch.setattr(parallel, "thread_count", lambda: 2)
    monkeypatch.setattr(advection, "_SMALL_LOOP", 1)
    parallel._pool.cache_clear()
    first = FirstLook(track)
    with_smaller(between, grey, dict.fromkeys(grey), first)
    parallel._pool.cache_clear()
    np.testing.assert_array_equal(first.look().colors, once.colors)


def test_without_a_photograph_carriers_are_grey(taught: tuple[Track, list[TrainingTarget]]) -> None:
    look = photographed(taught[0], [])
    np.testing.assert_array_equal(look.colors, 0.5)
    np.testing.assert_array_equal(look.spread, 0)


@pytest.mark.parametrize("children", [1, 2])
@torch.no_grad()
def test_the_decoder_hands_colours_on_from_every_side(children: int) -> None:
    torch.manual_seed(0)
    features = 0.1 * torch.randn(50, 16)
    decoder = Decoder(DecoderSettings(feature_size=16, color_width=32, children=children))
    colors = np.random.default_rng(0).uniform(0.05, 0.95, (50, 3)).astype(np.float32)
    spread = np.linspace(0, 0.2, 50, dtype=np.float32)
    take_on(Look(colors, spread), features, decoder)
    state = CarrierState(torch.randn(50, 3), torch.eye(3).expand(50, 3, 3), torch.zeros(50))
    for eye in torch.eye(3):
        shown, _ = decoder.decode(features, torch.zeros(50, 3), None, state, 5 * eye)
        error = (shown.colors - torch.from_numpy(colors)[:, None]).abs()
        assert float(error.mean()) < 0.03
        assert float(error.max()) < 0.15
    # Opacities follow the doubt, and none of the colours.
    opacity = decoder.mean_opacity(features)
    assert np.corrcoef(np.log(opacity.numpy()), spread)[0, 1] < -0.95
    assert float(opacity[-1]) < 0.02 < 0.2 < float(opacity[0])
    others = features.clone()
    others[:, :3] = -others[:, :3]
    torch.testing.assert_close(decoder.mean_opacity(others), opacity)


@pytest.mark.slow
def test_a_draft_comes_first_where_states_are_taken_and_the_fit_is_the_same(balls: Scene, tmp_path: Path) -> None:
    scene, config = balls.training(), SplashSplatConfig.preset("quick", TINY | {"draft_cells": 32})

    def fit(run: Run) -> Appearance:
        return SplashSplat().fit(scene, config, run).liquid.appearance

    watched = Run(seed=1)
    watched._checkpoints = Checkpoints(tmp_path, [1e9], lambda: 7.0, lambda: None)
    with_draft, without = fit(watched), fit(Run(seed=1))
    assert torch.equal(with_draft.features, without.features)
    assert watched._checkpoints.seconds == [7.0, 7.0]
    assert watched.stages["draft"] > 0
    first, draft = (SplashSplat().load(tmp_path / name, scene) for name in ("00", "01"))
    # Its first state is before one colour, its last before a background.
    assert len(first.background.model) == 0 < len(draft.background.model)
    assert first.liquid.carriers.count == pytest.approx(draft.liquid.carriers.count, rel=0.2)
    # Already it shows balls where the balls are.
    overlaps = []
    for name in balls.test:
        for t in range(balls.n_frames):
            found, mask = draft.render(balls.cameras[name], balls.times[t]).alpha > 0.5, balls.mask(name, t)
            overlaps.append((found & mask).sum() / (found | mask).sum())
    assert np.mean(overlaps) > 0.5


def test_no_draft_where_none_is_asked_for(balls: Scene, tmp_path: Path) -> None:
    run = Run(seed=1)
    run._checkpoints = Checkpoints(tmp_path, [1e9], lambda: 7.0, lambda: None)
    SplashSplat().fit(balls.training(), SplashSplatConfig.preset("quick", TINY | {"draft_cells": 0}), run)
    assert run._checkpoints.seconds == []
    assert "draft" not in run.stages


@pytest.mark.slow
def test_the_background_comes_after_the_first_iterations(
    balls: Scene, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Clean plates are behind the liquid until then, and states are taken before it."""
    monkeypatch.setattr(side_by_side, "thread_count", lambda: 1)
    scene = balls.training()
    shown: list[bool] = []
    loss = fitting.image_loss

    def note(*arguments):
        shown.append(len(calls) > 0)
        return loss(*arguments)

    calls: list[int] = []
    fit_background = scaffold_gs.shared_background

    def background(*arguments, **others):
        calls.append(len(shown))
        return fit_background(*arguments, **others)

    monkeypatch.setattr(fitting, "image_loss", note)
    monkeypatch.setattr(scaffold_gs, "shared_background", background)
    settings = TINY | {"draft_cells": 0, "validation_share": 0.0, "iterations": 100}
    for share, before in ((0.0, 0), (0.4, 40), (1.0, 100)):
        shown.clear()
        calls.clear()
        config = SplashSplatConfig.preset("quick", settings | {"plates_share": share})
        run = Run(seed=1)
        run._checkpoints = Checkpoints(tmp_path / str(share), [], lambda: 7.0, lambda: None)
        fitted = SplashSplat().fit(scene, config, run)
        assert calls == [before]
        assert shown.count(False) == before
        assert len(fitted.background.model) > 0
        # The last state before the wait, once each photograph was seen.
        seen = sum(bool(scene.mask(name, t).any()) for name in scene.train for t in range(scene.n_frames))
        assert run._checkpoints.seconds == ([7.0] if before >= seen else [])
        if before >= seen:
            state = SplashSplat().load(tmp_path / str(share) / "00", scene)
            assert len(state.background.model) == 0


def test_masks_that_leave_no_background_are_refused_at_once(balls_copy: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    for path in (balls_copy / "seg").rglob("*.png"):
        write_png(path, np.full_like(read_image(path), 255))
    scene = Scene.open(balls_copy).training()
    assert all(scene.mask(name, t).all() for name in scene.train for t in range(scene.n_frames))
    monkeypatch.setattr(course, "trace_liquid", lambda *arguments: pytest.fail("minutes went by first"))
    with pytest.raises(SplashbenchError, match=r"liquid masks cover every training view throughout; fix the masks"):
        SplashSplat().fit(scene, SplashSplatConfig.preset("best", TINY), Run(seed=1))

"""Whom a photograph teaches: carriers that its view may see, as long as they are not transparent."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from splashbench.observe.grid import Grid
from splashbench.render import freeze, rasterize, tile_modes
from splashbench.scene.camera import Camera, look_at
from splashbench_methods.splashsplat.appearance.active import Active, ActiveCarriers
from splashbench_methods.splashsplat.appearance.compositing import composite, shares
from splashbench_methods.splashsplat.appearance.contribution import contributions, least
from splashbench_methods.splashsplat.appearance.decoder import Children, DecoderSettings, ScaleResidual
from splashbench_methods.splashsplat.appearance.fit_settings import FitSettings
from splashbench_methods.splashsplat.appearance.fitting import fit_appearance, initial_appearance
from splashbench_methods.splashsplat.appearance.glass import Splats
from splashbench_methods.splashsplat.appearance.targets import TrainingTarget
from splashbench_methods.splashsplat.carriers.population import Carriers
from splashbench_methods.splashsplat.carriers.subframe import Track
from splashbench_methods.splashsplat.kernel.window_loss import WindowPhotograph
from splashbench_methods.splashsplat.motion.steps import Motion

SIZE = 12


def _track() -> Track:
    """Two frames on a grid of unit voxels: carriers 0, 1 and 2 in the first, 1, 2 and 3 in the second. 0 and 1 are side
    by side, 2 and 3 far off; all move one voxel along x."""
    ids = np.array([0, 1, 2, 1, 2, 3], dtype=np.int32)
    positions = np.array([[2, 2, 2], [3, 2, 2], [7, 2, 2], [4, 2, 2], [8, 2, 2], [7, 3, 2]], dtype=np.float32)
    carriers = Carriers(
        np.array([0, 3, 6]), ids, positions, np.tile(np.eye(3, dtype=np.float32), (6, 1, 1)), np.zeros(6, np.float32), 4
    )
    velocity = np.zeros((1, 7, 7, 7, 3), dtype=np.float32)
    velocity[..., 0] = 1
    grid = Grid(np.zeros(3), 1.0, (SIZE, SIZE, SIZE))
    return Track(grid, carriers, Motion(velocity, 2, [None]), np.zeros((2, SIZE, SIZE, SIZE), dtype=np.int8))


def _target(frame: int = 0, fraction: float = 0.0, hidden: list[int] | None = None) -> TrainingTarget:
    """A white photograph of 16x16 pixels, taken from along z."""
    camera = Camera("1", 16, 16, np.array([[20.0, 0, 8], [0, 20, 8], [0, 0, 1]]), look_at((5, 2, -15), (5, 2, 0)))
    white = torch.full((16, 16, 3), 255, dtype=torch.uint8)
    return TrainingTarget(
        frame=frame,
        fraction=fraction,
        camera=camera,
        eye=torch.tensor(camera.center, dtype=torch.float32),
        photograph=WindowPhotograph(white, torch.ones(16, 16, dtype=torch.bool), top=0, left=0),
        background=torch.zeros(16, 16, 3),
        area=256.0,
        hidden=None if hidden is None else torch.tensor(hidden, dtype=torch.uint8),
    )


def test_all_carriers_are_taught_where_nothing_hides_them() -> None:
    active = ActiveCarriers(_track(), color_cell=4.0).of(_target())
    assert active.ids.tolist() == [0, 1, 2]
    assert active.places is None
    assert active.cells.of_carriers.tolist() == [0, 0, 1]
    assert active.cells.sizes.tolist() == [2, 1]


def test_a_carrier_that_is_hidden_as_a_whole_is_not_taught() -> None:
    active = ActiveCarriers(_track(), color_cell=4.0).of(_target(hidden=[0, 255, 51]))
    assert active.ids.tolist() == [0, 2]
    assert active.places is not None
    assert active.places.tolist() == [0, 2]
    assert active.state.positions[:, 0].tolist() == [2, 7]
    assert active.state.visibility is not None
    np.testing.assert_allclose(active.state.visibility, [1, 0.8], rtol=1e-6)
    assert active.cells.of_carriers.tolist() == [0, 1]
    assert active.cells.sizes.tolist() == [1, 1]


@pytest.mark.parametrize("fraction", [0.0, 0.25])
def test_dropped_carriers_are_left_out_at_any_instant(fraction: float) -> None:
    carriers = ActiveCarriers(_track(), color_cell=4.0)
    before = carriers.ids
    carriers.drop(torch.tensor([False, True, False, False]))
    active = carriers.of(_target(fraction=fraction, hidden=[0, 255, 51]))
    assert active.ids.tolist() == [0, 2]
    np.testing.assert_allclose(active.state.positions[:, 0], [2 + fraction, 7 + fraction], atol=1e-3)
    assert active.state.visibility is not None
    np.testing.assert_allclose(active.state.visibility, [1, 0.8], rtol=1e-6)
    carriers.drop(torch.tensor([True, False, False, False]))
    assert [ids.tolist() for ids in carriers.ids] == [[2], [2, 3]]
    active = carriers.of(_target(fraction=fraction, hidden=[0, 255, 51]))
    assert active.ids.tolist() == [2]
    np.testing.assert_allclose(active.state.visibility, [0.8], rtol=1e-6)
    assert [ids.tolist() for ids in before] == [[0, 1, 2], [1, 2, 3]]


def _steps_of_sizes(prune_opacity: float) -> list[float]:
    """How far each carrier's extent moved in twenty iterations on both frames, in Adam's steps; 1 is transparent from
    the start."""
    rate = 0.01
    settings = FitSettings(
        iterations=20,
        feature_cells=(4.0,),
        learning_rate_heads=1e-6,
        learning_rate_scales=rate,
        anneal=False,
        prune_opacity=prune_opacity,
    )
    appearance = initial_appearance(4, 1.0, settings, DecoderSettings(feature_size=4, children=1), seed=0)
    with torch.no_grad():
        appearance.decoder.opacity.weight.copy_(torch.tensor([[8.0, 0, 0, 0]]))
        appearance.features[:, 0] = torch.tensor([0.0, -1.0, 0.0, 0.0])
    before = appearance.log_scales.clone()
    fit_appearance(appearance, _track(), [_target(0), _target(1)], settings, 100.0, 0, lambda done: None)
    return ((appearance.log_scales - before).abs().amax(dim=1) / rate).tolist()


def test_a_transparent_carrier_is_not_fitted_any_further() -> None:
    kept, dropped = _steps_of_sizes(0.0), _steps_of_sizes(0.01)
    assert kept[1] > 10
    assert 0 < dropped[1] < 2.5  # the two before the first look
    assert min(dropped[0], dropped[2]) > 5


@pytest.mark.parametrize("residual", ["bounded", "linear"])
@pytest.mark.parametrize(("prune_opacity", "hidden"), [(0.9, None), (0.0, [255, 255, 255])])
def test_photographs_that_teach_no_carrier_do_no_harm(
    prune_opacity: float, hidden: list[int] | None, residual: ScaleResidual
) -> None:
    settings = FitSettings(iterations=10, feature_cells=(4.0,), prune_opacity=prune_opacity, idle_share=0.02)
    heads = DecoderSettings(feature_size=4, children=1, scale_residual=residual)
    appearance = initial_appearance(4, 1.0, settings, heads, seed=0)
    targets = [_target(0, hidden=hidden), _target(1, hidden=hidden)]
    losses = fit_appearance(appearance, _track(), targets, settings, 100.0, 0, lambda done: None).losses
    assert len(losses) == 10
    assert np.isfinite(losses).all()
    assert bool(torch.isfinite(appearance.features).all())


@pytest.mark.parametrize("fraction", [0.0, 0.25])
def test_idle_carriers_of_a_photograph_are_left_out_of_it_alone(fraction: float) -> None:
    carriers = ActiveCarriers(_track(), color_cell=4.0)
    first, second = _target(0, fraction), _target(1, hidden=[0, 0, 255])

    # 0 and 2 make up none of the first photograph; 2, unlike 0, is taught by the second. 3 is hidden from it.
    def useless(target: TrainingTarget, active: Active) -> torch.Tensor:
        return torch.isin(active.ids, torch.tensor([0, 2] if target is first else []))

    carriers.focus(useless, [first, second])
    assert carriers.of(first).ids.tolist() == [1]
    np.testing.assert_allclose(carriers.of(first).state.positions[:, 0], [3 + fraction], atol=1e-3)
    assert carriers.of(second).ids.tolist() == [1, 2]
    assert carriers.of(_target(0)).ids.tolist() == [1, 2]
    # What was idle is looked at again.
    carriers.focus(lambda target, active: torch.zeros(len(active.ids), dtype=torch.bool), [first, second])
    assert carriers.of(first).ids.tolist() == [1, 2]


def test_carriers_that_no_photograph_could_teach_stay() -> None:
    carriers = ActiveCarriers(_track(), color_cell=4.0)
    carriers.focus(lambda target, active: torch.ones(len(active.ids), dtype=torch.bool), [_target(0)])
    assert carriers.left(4).tolist() == [False, False, False, True]


def test_a_gaussian_behind_an_opaque_one_makes_up_little() -> None:
    camera = _target().camera
    means = torch.tensor([[5.0, 2, 0], [5.0, 2, 3], [0.0, 2, 3]])
    sizes = torch.tensor([1.0, 0.3, 0.3])
    shapes = means, sizes[:, None, None] * torch.eye(3), torch.tensor([0.99, 0.9, 0.9])
    colors = torch.rand(3, 1, 3)
    drawn = contributions(colors, lambda c: rasterize(*shapes, c[:, 0], camera, background=torch.zeros(3))[0])
    alone = contributions(
        colors[1:2],
        lambda c: rasterize(*(s[1:2] for s in shapes), c[:, 0], camera, background=torch.zeros(3))[0],
    )
    assert drawn[1] < 0.2 * alone[0]
    assert drawn[2] == pytest.approx(float(alone[0]), rel=0.1)


@pytest.mark.parametrize("case", ["over", "wall", "in front", "glass", "together"])
def test_the_renderer_weighs_carriers_as_the_derivative_does(case: str) -> None:
    camera = _target().camera
    rng = np.random.default_rng(0)

    def some(*shape: int) -> torch.Tensor:
        return torch.from_numpy(rng.uniform(0, 1, shape).astype(np.float32))

    n = 40
    means = some(n, 2, 3) * torch.tensor([10.0, 4, 6]) - torch.tensor([2.0, 0, 2])
    children = Children(means, 0.4 * some(n, 2, 3, 3), 0.05 + 0.9 * some(n, 2), some(n, 2, 3), some(n, 2, 3))
    background = some(camera.height, camera.width, 3)
    wall = some(camera.height, camera.width) if case in ("wall", "in front") else None
    in_front = some(n) < 0.3 if case == "in front" else None
    other = Splats(some(9, 3) * 4, some(9, 3, 3), some(9), some(9, 3))
    frozen = freeze(*vars(other).values(), camera) if case == "together" else None
    glass = other if case == "glass" else None

    def drawn(colors: torch.Tensor) -> torch.Tensor:
        shown = replace(children, colors=colors)
        return composite(shown, camera, background, frozen, None, wall, in_front, glass)[0]

    expected = contributions(children.colors, drawn)
    found = shares(children, camera, frozen, wall, in_front, glass)
    torch.testing.assert_close(found, expected, rtol=1e-4, atol=1e-4)
    assert float(found.max()) > 1


def test_least_takes_no_more_than_the_share() -> None:
    weights = torch.tensor([3.0, 0.0, 1.0, 96.0])
    assert least(weights, 0.0).tolist() == [False, True, False, False]
    assert least(weights, 0.01).tolist() == [False, True, True, False]
    assert least(weights, 0.039).tolist() == [False, True, True, False]
    assert least(weights, 0.04).tolist() == [True, True, True, False]
    assert least(torch.zeros(0), 0.5).tolist() == []


def _visible_after(idle_share: float, iterations: int, early: bool = False) -> list[bool]:
    """Which carriers are fitted to the end: 2 and 3 lie behind others, all opaque."""
    settings = FitSettings(iterations=iterations, idle_share=idle_share, idle_early=early, base_scale=2.0)
    heads = DecoderSettings(feature_size=4, children=1, opacity_bias=6.0)
    appearance = initial_appearance(4, 1.0, settings, heads, seed=0)
    track = _track()
    track.carriers.positions[[2, 4, 5]] = [[2, 2, 9], [4, 2, 9], [4.5, 2, 9]]
    fit = fit_appearance(appearance, track, [_target(0), _target(1)], settings, 100.0, 0, lambda done: None)
    return fit.left.tolist()


def test_carriers_idle_in_all_photographs_are_left_out_once_all_were_seen() -> None:
    assert all(_visible_after(0.0, 40))
    assert _visible_after(0.1, 40) == [True, True, False, False]
    assert all(_visible_after(0.1, 9))  # the photographs were not seen four times by the last look
    assert not all(_visible_after(0.1, 9, early=True))


def test_liquid_beside_the_masks_is_not_idle_where_it_is_drawn_together_with_the_background() -> None:
    gaussian = np.array([[5, 2, 400.0]]), np.eye(3)[None], np.array([0.5]), np.ones((1, 3))
    apart = [
        replace(
            target,
            background=torch.zeros(3),
            frozen=freeze(*(values.astype(np.float32) for values in gaussian), target.camera),
            modes=tile_modes(np.zeros((16, 16), dtype=bool)),
        )
        for target in (_target(0), _target(1))
    ]
    settings = FitSettings(iterations=10, idle_share=0.02)
    appearance = initial_appearance(4, 1.0, settings, DecoderSettings(feature_size=4, children=1), seed=0)
    assert fit_appearance(appearance, _track(), apart, settings, 100.0, 0, lambda done: None).left.all()

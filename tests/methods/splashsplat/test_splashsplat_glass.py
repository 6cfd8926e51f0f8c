"""The glass before the liquid: drawn by depth, no liquid itself, fitted to photographs, and in the files."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch
import trimesh

from splashbench.errors import SplashbenchError
from splashbench.files import read_json, write_json
from splashbench.harness.contract import Run
from splashbench.observe.grid import Grid
from splashbench.scene import Camera, Scene
from splashbench_methods.splashsplat import SplashSplatConfig
from splashbench_methods.splashsplat.appearance import losses
from splashbench_methods.splashsplat.appearance.compositing import composite
from splashbench_methods.splashsplat.appearance.decoder import Children
from splashbench_methods.splashsplat.appearance.glass import Glass, GlassFit, Splats, glass_before
from splashbench_methods.splashsplat.carriers.population import Carriers
from splashbench_methods.splashsplat.carriers.subframe import Track
from splashbench_methods.splashsplat.model import Liquid
from splashbench_methods.splashsplat.motion.steps import Motion
from splashbench_methods.splashsplat.reconstruction import fit_liquid
from splashbench_methods.splashsplat.trace import trace_liquid

CAMERA = Camera("c", 40, 40, np.array([[40.0, 0, 20], [0, 40, 20], [0, 0, 1]]), np.eye(4))
BLUE = torch.tensor([0.0, 0.0, 1.0])
TINY = {"hull_cells": 48, "transport_cells": 32, "control_cells": 8, "iterations": 12, "glass": 300}


def liquid_at(depth: float) -> Children:
    shape = (1, 1)
    return Children(
        torch.tensor([0.0, 0.0, depth]).expand(*shape, 3),
        0.2 * torch.eye(3).expand(*shape, 3, 3),
        torch.full(shape, 0.99),
        BLUE.expand(*shape, 3),
        torch.zeros(*shape, 3),
    )


def pane_at(depth: float) -> Splats:
    """A red spot."""
    return Splats(
        torch.tensor([[0.0, 0.0, depth]]), 0.1 * torch.eye(3)[None], torch.tensor([0.99]), torch.tensor([[1.0, 0, 0]])
    )


def test_glass_before_the_liquid_hides_it_and_is_none() -> None:
    black = torch.zeros(40, 40, 3)
    rgb, alpha = composite(liquid_at(2.0), CAMERA, black, glass=pane_at(1.0))
    assert rgb[20, 20, 0] > 0.9
    assert alpha[20, 20] < 0.1
    rgb, alpha = composite(liquid_at(2.0), CAMERA, black, glass=pane_at(3.0))
    assert rgb[20, 20, 2] > 0.9
    assert alpha[20, 20] > 0.9
    without, _ = composite(liquid_at(2.0), CAMERA, black)
    unseen = pane_at(-1.0)  # behind the camera
    np.testing.assert_allclose(composite(liquid_at(2.0), CAMERA, black, glass=unseen)[0], without, atol=1e-6)


def test_what_is_beside_the_mask_is_averaged_over_its_own_pixels() -> None:
    target = torch.zeros(2, 4, 3)
    image = target.clone()
    mask = torch.zeros(2, 4, dtype=torch.bool)
    mask[0] = True
    image[0] = 0.9
    image[1, 0] = 0.4
    assert float(losses.beside_loss(image, target, mask)) == pytest.approx(0.1, rel=1e-5)
    assert float(losses.beside_loss(image, target, torch.ones_like(mask))) == 0


def track(phi: float) -> Track:
    carriers = Carriers(
        np.array([0, 2]),
        np.array([0, 1], dtype=np.int32),
        np.array([[2, 2, 2], [8, 8, 8]], dtype=np.float32),
        np.tile(np.eye(3, dtype=np.float32), (2, 1, 1)),
        np.float32([phi, -9.0]),
        2,
    )
    grid = Grid(np.array([1.0, 2.0, 3.0]), 0.5, (12, 12, 12))
    return Track(
        grid, carriers, Motion(np.zeros((0, 7, 7, 7, 3), np.float32), 2, []), np.zeros((1, 12, 12, 12), np.int8)
    )


def test_it_begins_about_the_surface_the_same_for_the_same_seed() -> None:
    glass = glass_before(track(0.0), 2000, seed=3)
    assert glass is not None
    places = (glass.positions.numpy() - [1.0, 2.0, 3.0]) / 0.5
    np.testing.assert_allclose(places.mean(axis=0), track(0.0).carriers.positions[0], atol=0.6)
    assert places.std(axis=0) == pytest.approx([2.0] * 3, rel=0.1)
    again, other = glass_before(track(0.0), 2000, seed=3), glass_before(track(0.0), 2000, seed=4)
    assert again is not None
    assert other is not None
    assert torch.equal(glass.positions, again.positions)
    assert not torch.equal(glass.positions, other.positions)
    assert glass_before(track(0.0), 0, seed=3) is None
    assert glass_before(track(-9.0), 5, seed=3) is None  # no carrier is near the surface


def test_a_fit_moves_it_to_a_bright_line_that_one_carrier_cannot_draw() -> None:
    """A white upright line before blue liquid, five pixels beside where the only Gaussian begins."""
    black = torch.zeros(40, 40, 3)
    truth = composite(liquid_at(2.0), CAMERA, black)[0]
    truth[12:28, 23:25] = 1.0
    glass = Glass(
        torch.tensor([[-0.05, 0.0, 1.0]]),
        torch.full((1, 3), -3.0),
        torch.tensor([[1.0, 0, 0, 0]]),
        torch.zeros(1),
        torch.zeros(1, 3),
        torch.zeros(1, 3, 3),
    )
    fit = GlassFit(glass, voxel=0.1)
    errors = []
    for _ in range(150):
        image, _ = composite(liquid_at(2.0), CAMERA, black, glass=glass.seen(torch.zeros(3)))
        loss = (image - truth).square().mean()
        errors.append(float(loss.detach()))
        fit.step(list(torch.autograd.grad(loss, fit.parameters)), 1.0)
    fit.done()
    assert errors[-1] < 0.35 * errors[0]
    pixel = CAMERA.project(glass.positions.numpy())[0][0]
    assert pixel == pytest.approx([24.0, 20.0], abs=1.0)
    factors = glass.seen(torch.zeros(3)).factors[0]
    extents = (factors @ factors.T).diagonal()
    assert extents[1] > 9 * extents[0]  # it is upright
    assert not glass.positions.requires_grad


def fitted(directory: Path, **settings: object) -> Liquid:
    scene = Scene.open(directory).training()
    config = SplashSplatConfig.preset("quick", TINY | settings)
    grey = {name: np.full((camera.height, camera.width, 3), 0.5, np.float32) for name, camera in scene.cameras.items()}
    run = Run(seed=0)
    return fit_liquid(scene, grey, trace_liquid(scene, config, run), run)[0]


def change(directory: Path, **fields: object) -> None:
    write_json(directory / "scene.json", read_json(directory / "scene.json") | fields)


@pytest.fixture
def in_glass(balls_copy: Path) -> Path:
    """Balls, and a transparent box elsewhere."""
    trimesh.creation.box((0.1, 0.1, 0.1)).apply_translation((5, 0, 5)).export(balls_copy / "box.ply")
    change(balls_copy, container_mesh="box.ply", gravity=None, container_transparent=True)
    return balls_copy


@pytest.mark.slow
def test_only_liquid_in_a_transparent_container_has_glass_and_files_keep_it(in_glass: Path, tmp_path: Path) -> None:
    liquid = fitted(in_glass)
    glass = liquid.appearance.glass
    assert glass is not None
    assert len(glass) > 0
    liquid.save(tmp_path)
    assert read_json(tmp_path / "liquid.json")["glass"] is True
    loaded = Liquid.load(tmp_path).appearance.glass
    assert loaded is not None
    for name, table in glass.tables.items():
        assert torch.equal(table, loaded.tables[name]), name
    assert fitted(in_glass, glass=0).appearance.glass is None
    change(in_glass, container_transparent=False)
    opaque = fitted(in_glass)
    assert opaque.appearance.glass is None
    opaque.save(tmp_path)
    assert read_json(tmp_path / "liquid.json")["glass"] is False
    assert Liquid.load(tmp_path).appearance.glass is None


def test_larger_photographs_have_more_of_it(in_glass: Path) -> None:
    cameras = Scene.open(in_glass).cameras.values()
    longest = max(max(camera.width, camera.height) for camera in cameras)
    glass = fitted(in_glass, iterations=0).appearance.glass  # of none is any transparent yet
    assert glass is not None
    assert len(glass) == round(300 * longest / 240)


@pytest.mark.parametrize("name", ["glass.positions", "glass.slopes"])
def test_broken_glass_is_named(in_glass: Path, tmp_path: Path, name: str) -> None:
    fitted(in_glass, iterations=0).save(tmp_path)
    path = tmp_path / "appearance.npz"
    with np.load(path) as stored:
        tables = dict(stored)
    np.savez(path, **(tables | {name: tables[name][:-1]}))
    with pytest.raises(SplashbenchError, match=r"appearance\.npz"):
        Liquid.load(tmp_path)
    del tables[name]
    np.savez(path, **tables)
    with pytest.raises(SplashbenchError, match=r"appearance\.npz"):
        Liquid.load(tmp_path)

"""The container's near wall cuts the liquid's picture by pixels, where the rim is, as training masks show it."""

from __future__ import annotations

import json
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import cast

import numpy as np
import pytest
import torch
import trimesh

from splashbench.errors import SplashbenchError
from splashbench.harness.contract import Run
from splashbench.observe.container import depth_image
from splashbench.observe.occlusion import ContainerOcclusion
from splashbench.scene.camera import Camera, look_at
from splashbench.scene.container import ContainerMesh
from splashbench.scene.scene import Scene, TrainingScene
from splashbench_methods.splashsplat.appearance.compositing import _Over, _Parts, composite
from splashbench_methods.splashsplat.appearance.decoder import Children
from splashbench_methods.splashsplat.fields import observations
from splashbench_methods.splashsplat.fields.container import ContainerSource, KnownContainer
from splashbench_methods.splashsplat.fields.near_wall import NearWall, near_wall, room_beside
from splashbench_methods.splashsplat.fields.occlusion import LiquidOcclusion
from splashbench_methods.splashsplat.fields.rim import Rim, rim_of
from splashbench_methods.splashsplat.fields.vessel import Vessel
from splashbench_methods.splashsplat.settings import SplashSplatConfig

UP = np.array([0.0, 1.0, 0.0])
LEVEL, TOLERANCE = 0.06, 0.002


def bowl(lift: float = 0.0) -> ContainerMesh:
    """A bowl of wood, 10 cm high and 1 cm thick at its round rim."""
    angles = np.linspace(0, np.pi, 9)[1:-1]
    rim = np.stack([0.105 + 0.005 * np.cos(angles), 0.1 + 0.005 * np.sin(angles)], axis=1)
    profile = [[0, 0], [0.06, 0], [0.11, 0.1], *rim.tolist(), [0.1, 0.1], [0.05, 0.01], [0, 0.01]]
    body = trimesh.creation.revolve(np.array(profile), sections=64)
    return ContainerMesh(body.vertices[:, [0, 2, 1]] * [1, 1, -1] + lift * UP, body.faces)


def pool() -> ContainerMesh:
    """The surface of the liquid in the bowl."""
    disc = trimesh.creation.revolve(np.array([[0, LEVEL - 0.001], [0.07, LEVEL - 0.001], [0.078, LEVEL], [0, LEVEL]]))
    return ContainerMesh(disc.vertices[:, [0, 2, 1]] * [1, 1, -1], disc.faces)


def camera_at(name: str, angle: float, pitch: float = 33.0) -> Camera:
    angle, pitch = np.deg2rad([angle, pitch])
    eye = 0.9 * np.array([np.cos(pitch) * np.sin(angle), np.sin(pitch), np.cos(pitch) * np.cos(angle)])
    return Camera(name, 240, 200, np.array([[420.0, 0, 120], [0, 420, 100], [0, 0, 1]]), look_at(eye))


def finely(mesh: ContainerMesh, camera: Camera) -> np.ndarray:
    """Its depth on a grid of eight points a pixel side."""
    return depth_image(mesh, camera.scaled(8))


def shares(seen: np.ndarray) -> np.ndarray:
    height, width = seen.shape
    return seen.reshape(height // 8, 8, width // 8, 8).mean(axis=(1, 3))


@dataclass
class PoolInABowl:
    """still liquid in the bowl, cut by its near rim for each of the cameras; none of it where `dry`."""

    dry: bool = False
    name: str = "pool_in_a_bowl"
    n_frames: int = 3
    cameras: dict[str, Camera] = field(default_factory=dict)

    def __post_init__(self) -> None:
        self.cameras = {str(n): camera_at(str(n), angle) for n, angle in enumerate((-60, -30, 0, 30, 60))}
        self.train = tuple(self.cameras)

    def mask(self, camera: str, t: int) -> np.ndarray:
        view = self.cameras[camera]
        seen = finely(pool(), view) < finely(bowl(), view)
        return np.asarray(shares(seen) >= 0.5) & (not self.dry)


def wall_of(camera: Camera, mesh: ContainerMesh) -> NearWall:
    vessel = Vessel.of(mesh, -UP)
    assert vessel is not None
    wall = near_wall(mesh, room_beside(mesh, vessel), UP, camera, TOLERANCE)
    assert wall is not None
    return wall


def rim(
    mesh: ContainerMesh, scene: PoolInABowl, source: ContainerSource = "mesh", gravity: np.ndarray | None = -UP
) -> Rim:
    known = KnownContainer(ContainerOcclusion(mesh, gravity), gravity, source)
    failed = np.zeros((scene.n_frames, len(scene.train)), dtype=bool)
    return rim_of(known, cast(TrainingScene, scene), failed)


def test_the_wall_takes_the_share_of_each_pixel_in_which_it_hides_the_pool() -> None:
    camera = camera_at("a", 20)
    wall = wall_of(camera, bowl())
    surface, container = finely(pool(), camera), finely(bowl(), camera)
    hidden = shares(np.isfinite(surface) & (container < surface))
    somewhere = shares(np.isfinite(surface)) > 0.99
    assert 0.1 < hidden[somewhere].mean() < 0.6
    assert np.abs(wall.share - hidden)[somewhere].mean() < 0.01
    # Where one looks into the bowl there is no wall, at its far side either.
    into = np.isfinite(surface) & ~(container < surface)
    assert wall.share[shares(into) == 1].max() == 0


def test_points_are_hidden_deep_behind_the_wall_alone() -> None:
    camera = camera_at("a", 0)
    wall = wall_of(camera, bowl())
    line = np.array([[0, LEVEL, z] for z in np.linspace(0, 0.078, 79)])
    column, row = np.floor(camera.project(line)[0]).astype(int).T
    edge = line[np.flatnonzero(wall.share[row, column] > 0.5)[0] + 1]
    middle, deep, before = [0, LEVEL, 0], [0, 0.02, 0.055], [0, 0.08, 0.14]
    points = np.array([middle, deep, before, edge])
    assert wall.hidden(points, TOLERANCE).tolist() == [0, 1, 0, 0]
    assert wall.in_front(points, TOLERANCE).tolist() == [False, False, True, False]
    assert not wall.in_front(np.array([[0, 0, 5.0], [9, 0, 0]]), TOLERANCE).any()


def test_liquid_that_runs_down_the_outside_is_not_cut() -> None:
    camera = camera_at("a", 0)
    wall = wall_of(camera, bowl())
    heights = np.linspace(0.02, 0.09, 15)
    outside = np.stack([np.zeros(15), heights, 0.06 + 0.5 * heights], axis=1)
    film = outside + np.array([0, 0, 0.001])
    assert wall.in_front(film, TOLERANCE).all()
    assert wall.hidden(film, TOLERANCE).max() < 0.5
    within = outside - np.array([0, 0, 0.012])
    assert not wall.in_front(within, TOLERANCE).any()


@pytest.mark.parametrize("lift", [0.003, -0.004])
def test_a_container_that_is_too_high_or_too_low_is_moved_to_where_masks_end(lift: float) -> None:
    found = rim(bowl(lift), PoolInABowl())
    assert found.room is not None
    assert "moved by" in str(found)
    for angle in (-45, 10, 45):  # views that no mask is of
        camera = camera_at("new", angle)
        true, before, after = (wall_of(camera, mesh).share for mesh in (bowl(), bowl(lift), found.mesh))
        assert np.abs(after - true).sum() < 0.3 * np.abs(before - true).sum()


def test_a_rim_that_is_lifted_leaves_the_floor_where_it_is(balls_copy: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    trimesh.creation.box((0.1, 0.1, 0.1)).apply_translation((5, 0, 5)).export(balls_copy / "box.ply")
    path = balls_copy / "scene.json"
    path.write_text(json.dumps(json.loads(path.read_text()) | {"container_mesh": "box.ply"}))
    scene = Scene.open(balls_copy).training()
    settings = SplashSplatConfig.preset("quick", {"hull_cells": 32, "transport_cells": 16, "control_cells": 4}).fields

    def lifted(known: KnownContainer, *_: object) -> Rim:
        assert known.occlusion is not None
        return Rim(ContainerMesh(known.occlusion.mesh.vertices + 0.02 * UP, known.occlusion.mesh.faces), None, None, "")

    monkeypatch.setattr(observations, "rim_of", lifted)
    assert scene.gravity is not None
    container = observations.observe(scene, settings, Run(), lambda done, message: None).container
    assert container is not None
    assert container.floor == pytest.approx(0.05)
    assert container.mesh.vertices[:, 1].min() == pytest.approx(-0.03)


def test_without_masks_that_end_there_a_mesh_is_taken_at_its_word_and_a_guess_is_not() -> None:
    dry = PoolInABowl(dry=True)
    stated = rim(bowl(), dry)
    assert stated.room is not None
    assert np.array_equal(stated.mesh.vertices, bowl().vertices)
    guessed = rim(bowl(), dry, source="masks")
    assert guessed.room is None
    assert guessed.occlusion(TOLERANCE).wall(camera_at("a", 0)) is None
    unknown = rim(bowl(), PoolInABowl(), gravity=None)
    assert unknown.room is None
    assert "gravity" in str(unknown)


def test_masks_that_end_elsewhere_leave_the_edge_blurred() -> None:
    # A rim that waves by a centimetre is at no lift where the masks end.
    mesh = bowl()
    around = np.arctan2(mesh.vertices[:, 0], mesh.vertices[:, 2])
    waves = 0.006 * np.sin(12 * around) * (mesh.vertices[:, 1] > 0.05)
    assert rim(ContainerMesh(mesh.vertices + waves[:, None] * UP, mesh.faces), PoolInABowl()).room is None


def test_liquid_is_cut_by_the_wall_except_before_it() -> None:
    camera = replace(camera_at("a", 0), width=40, height=40, K=np.array([[100.0, 0, 20], [0, 100, 20], [0, 0, 1]]))
    eye = torch.tensor(camera.center, dtype=torch.float32)
    at = torch.stack([0.02 * (eye / eye.norm()), 0.5 * eye])  # the second is nearer, and before the wall
    children = Children(
        means=at[:, None].clone().requires_grad_(),
        factors=0.02 * torch.eye(3).expand(2, 1, 3, 3),
        opacities=torch.full((2, 1), 0.9),
        colors=torch.tensor([[[1.0, 0, 0]], [[0, 1.0, 0]]]),
        offsets=torch.zeros(2, 1, 3),
    )
    background = torch.full((40, 40, 3), 0.5)
    wall = torch.zeros(40, 40)
    wall[:, 20:] = 0.75

    def drawn(in_front: list[bool] | None) -> tuple[torch.Tensor, torch.Tensor]:
        front = None if in_front is None else torch.tensor(in_front)
        return composite(children, camera, background, wall=wall, in_front=front)

    whole, opacity = composite(children, camera, background)
    cut, cut_opacity = drawn([False, False])
    again, _ = drawn(None)
    assert torch.equal(cut, again)
    assert torch.allclose(cut[:, :20], whole[:, :20])
    assert torch.allclose(cut_opacity[:, 20:], 0.25 * opacity[:, 20:])
    assert torch.allclose(cut[:, 20:], background[:, 20:] + 0.25 * (whole - background)[:, 20:], atol=1e-6)
    both, both_opacity = drawn([False, True])
    assert torch.allclose(both[:, :20], whole[:, :20], atol=1e-5)
    assert bool((both_opacity > cut_opacity)[20, 22:26].all())
    assert bool((both > cut)[20, 22:26, 1].all())
    both.sum().backward()
    assert children.means.grad is not None
    assert bool((children.means.grad.abs().amax((1, 2)) > 0).all())


@pytest.mark.parametrize("covered", [0.0, 0.02, 1.0])
def test_what_is_drawn_over_an_image_is_blended_where_it_is_alone(covered: float) -> None:
    rng = np.random.default_rng(7)
    opacity = np.where(rng.random((30, 40)) < covered, rng.random((30, 40)), 0).astype(np.float32)
    values = [opacity[..., None] * rng.random((30, 40, 3)), opacity, rng.random((30, 40, 3)), rng.random((30, 40))]
    weights = [torch.from_numpy(rng.normal(size=shape).astype(np.float32)) for shape in ((30, 40, 3), (30, 40))]
    outcomes = []
    for compiled in (True, False):
        leaves = [torch.from_numpy(value.astype(np.float32)).requires_grad_() for value in values]
        over, share, image, alpha = (leaf * 1 for leaf in leaves)
        if compiled:
            found = _Over.apply(over, share, image, alpha)
        else:
            found = over + (1 - share[..., None]) * image, share + (1 - share) * alpha
        gradients = torch.autograd.grad(sum((w * f).sum() for w, f in zip(weights, found)), leaves)
        outcomes.append([*found, *gradients])
    drawn = opacity > 0
    for number, (mine, plain) in enumerate(zip(*outcomes)):
        if number == 3:  # by opacity: where nothing is drawn there is no Gaussian that this could move
            assert not mine.numpy()[~drawn].any()
            mine, plain = mine[torch.from_numpy(drawn)], plain[torch.from_numpy(drawn)]
        assert torch.equal(mine, plain)


def test_rows_of_two_parts_get_their_gradients_back() -> None:
    table, other = torch.rand(7, 3, 2, requires_grad=True), torch.rand(7, requires_grad=True)
    first, last = torch.tensor([0, 2, 3, 6]), torch.tensor([1, 4, 5])
    parts = _Parts.apply(first, last, table, other)
    assert [tuple(part.shape) for part in parts] == [(4, 3, 2), (4,), (3, 3, 2), (3,)]
    for part, rows, of in zip(parts, (first, first, last, last), (table, other) * 2):
        assert torch.equal(part, of[rows])
    weights = [torch.rand_like(part) for part in parts]
    found = torch.autograd.grad(sum((w * part).sum() for w, part in zip(weights, parts)), [table, other])
    for gradient, (of_first, of_last) in zip(found, ((weights[0], weights[2]), (weights[1], weights[3]))):
        assert torch.equal(gradient[first], of_first)
        assert torch.equal(gradient[last], of_last)


def test_the_files_keep_the_edge(tmp_path: Path) -> None:
    occlusion = rim(bowl(0.003), PoolInABowl()).occlusion(TOLERANCE)
    occlusion.save(tmp_path)
    loaded = LiquidOcclusion.load(tmp_path)
    assert loaded is not None
    camera = camera_at("a", 10)
    kept, read = occlusion.wall(camera), loaded.wall(camera)
    assert kept is not None
    assert read is not None
    assert np.array_equal(kept.share, read.share)
    with np.load(tmp_path / "container.npz") as stored:
        arrays = dict(stored)
    for name, value, words in (
        ("room", arrays["room"][1:], "do not fit together"),
        ("room", None, "only one of"),
        ("up", np.zeros(3), "no unit vector"),
        ("tolerance", np.array([1e9]), "larger than the container"),
    ):
        changed = {key: array for key, array in (arrays | {name: value}).items() if array is not None}
        np.savez(tmp_path / "container.npz", **changed)
        with pytest.raises(SplashbenchError, match=words):
            LiquidOcclusion.load(tmp_path)


def test_what_is_known_of_an_image_is_found_again_once_it_was_forgotten() -> None:
    occlusion, camera = rim(bowl(0.003), PoolInABowl()).occlusion(TOLERANCE), camera_at("a", 0.4)
    points = np.random.default_rng(6).uniform(-0.4, 0.4, (500, 3))
    before = occlusion.hidden(camera, points), occlusion.depth(camera), occlusion.wall(camera)
    occlusion.forget()
    after = occlusion.hidden(camera, points), occlusion.depth(camera), occlusion.wall(camera)
    assert after[1] is not before[1]
    assert before[2] is not None
    assert after[2] is not None
    np.testing.assert_array_equal(after[0], before[0])
    np.testing.assert_array_equal(after[1], before[1])
    np.testing.assert_array_equal(after[2].share, before[2].share)

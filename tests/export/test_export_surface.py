"""Meshes of signed distances: closed whatever the distance is like, and of the right volume."""

from __future__ import annotations

import numpy as np
import pytest
import trimesh

from splashbench.export.surface import SurfaceMesh, surface_mesh, volume_below
from splashbench.scene import SignedDistance

ORIGIN, VOXEL = np.array([0.3, -1.2, 0.7]), 0.01


def of(steps: np.ndarray) -> SignedDistance:
    return SignedDistance(np.asarray(steps, dtype=np.int8)[None], ORIGIN, VOXEL)


def ball(center: list[float], radius: float, shape: tuple[int, int, int] = (24, 26, 28)) -> SignedDistance:
    """A ball, in voxels."""
    nodes = np.stack(np.meshgrid(*map(np.arange, shape), indexing="ij"), axis=-1)
    return SignedDistance.of(np.linalg.norm(nodes - center, axis=-1)[None] - radius, ORIGIN, VOXEL)


def liquid_volume(distance: SignedDistance, samples: int) -> float:
    """The volume in which a distance is negative, cubic units: 0 stands for [0, .5] steps, and -1 for (-1.5, 0)."""
    steps = np.pad(distance.phi[0].astype(np.float32), 1, constant_values=127)
    steps[steps == 0], steps[steps == -1] = 0.25, -0.75
    return volume_below(steps, samples) * VOXEL**3


def enclosed(mesh: SurfaceMesh) -> float:
    return float(trimesh.Trimesh(mesh.vertices, mesh.faces).volume)


def faults(mesh: SurfaceMesh) -> list[str]:
    """What is wrong with a mesh that has to be closed, as float64 and as a file of float32 has it."""
    exact = trimesh.Trimesh(mesh.vertices, mesh.faces, process=False)
    stored = trimesh.Trimesh(mesh.vertices.astype(np.float32), mesh.faces, process=True)  # equal vertices are merged
    checks = {
        "open": not exact.is_watertight or not stored.is_watertight,
        "turned": not exact.is_winding_consistent or not exact.volume > 0,
        "merged": len(stored.vertices) < len(mesh.vertices),
        "twice": len(np.unique(np.sort(mesh.faces, axis=1), axis=0)) < len(mesh.faces),
        "normals": not np.allclose(np.linalg.norm(mesh.normals, axis=1), 1),
        "empty": not len(mesh.faces),
    }
    return [name for name, bad in checks.items() if bad]


@pytest.mark.parametrize(("radius", "tolerance"), [(8.3, 0.01), (5.0, 0.025), (3.1, 0.06)])
def test_a_ball_has_its_place_its_volume_and_its_normals(radius: float, tolerance: float) -> None:
    center = [11.3, 12.9, 13.6]
    mesh = surface_mesh(ball(center, radius))
    assert faults(mesh) == []
    middle = ORIGIN + VOXEL * np.array(center)
    arms = mesh.vertices - middle
    np.testing.assert_allclose(np.linalg.norm(arms, axis=1), radius * VOXEL, atol=0.1 * VOXEL)
    assert (mesh.normals * arms).sum(axis=1).min() > 0.9 * radius * VOXEL  # they point outwards
    assert enclosed(mesh) == pytest.approx(4 / 3 * np.pi * (radius * VOXEL) ** 3, rel=tolerance)


def test_the_volume_below_zero_is_that_of_known_fields() -> None:
    slab = np.full((5, 6, 7), 1.0)
    slab[:, :, :3] = -1.0  # liquid up to half a voxel beyond the third layer, and to half a one beyond the border
    volume = liquid_volume(SignedDistance.of(slab[None], ORIGIN, VOXEL), samples=16)
    beyond = 1 / (1 + 127 / 16)  # where the border's -1 voxel and the frame's 7.9 meet
    sides = (4 + 2 * beyond) * (5 + 2 * beyond)
    assert volume == pytest.approx(sides * (2.5 + beyond) * VOXEL**3, rel=0.02)
    # One node in the middle: the trilinear field is below 0 where (1 - x)(1 - y)(1 - z) > 1/2.
    drop = np.full((3, 3, 3), 64)
    drop[1, 1, 1] = -64
    half = np.log(2)
    exact = 8 * (1 - (1 + half + half**2 / 2) / 2)
    assert liquid_volume(of(drop), samples=64) == pytest.approx(exact * VOXEL**3, rel=0.01)


def sheet(normal: tuple[int, int, int], thickness: float) -> SignedDistance:
    """A flat layer of liquid that lies obliquely in the grid, in voxels."""
    nodes = np.stack(np.meshgrid(*[np.arange(20)] * 3, indexing="ij"), axis=-1) - 10
    return SignedDistance.of(np.abs(nodes @ normal / np.linalg.norm(normal))[None] - thickness / 2, ORIGIN, VOXEL)


def ripple() -> SignedDistance:
    """A wavy layer, in voxels."""
    x, y, _ = np.indices((20, 20, 20))
    return SignedDistance.of(np.abs(x - 10 - 2 * np.sin(0.7 * y))[None] - 0.8, ORIGIN, VOXEL)


@pytest.mark.parametrize("distance", [sheet((1, 2, 3), 1.0), sheet((3, 1, 2), 1.0), ripple()])
def test_the_mesh_has_the_volume_of_the_field_where_triangles_alone_have_not(distance: SignedDistance) -> None:
    from skimage.measure import marching_cubes

    mesh, wanted = surface_mesh(distance), liquid_volume(distance, samples=24)
    assert faults(mesh) == []
    assert enclosed(mesh) == pytest.approx(wanted, rel=0.01)
    steps = np.pad(distance.phi[0].astype(np.float32), 1, constant_values=127)
    steps[steps == 0], steps[steps == -1] = 0.25, -0.75
    plain, faces, _, _ = marching_cubes(steps, 0.0, gradient_direction="descent")
    assert trimesh.Trimesh(plain, faces).volume * VOXEL**3 > 1.05 * wanted


SHEETS = {
    "one node thick": lambda rng: np.where(np.arange(9)[:, None, None] == 4, -5, 127) * np.ones((9, 8, 7)),
    "the least step thick": lambda rng: np.where(np.arange(9)[:, None, None] == 4, -1, 127) * np.ones((9, 8, 7)),
    "between zeros": lambda rng: np.where(np.arange(9)[:, None, None] == 4, -1, 0) * np.ones((9, 8, 7)),
    "oblique": lambda rng: np.where(np.indices((9, 9, 9)).sum(axis=0) == 11, -3, 90),
    "all liquid": lambda rng: np.full((4, 5, 6), -127),
    "all liquid but a node": lambda rng: np.where(np.indices((5, 5, 5)).sum(axis=0) == 6, 127, -127),
    "clipped everywhere": lambda rng: np.where(rng.random((8, 8, 8)) < 0.4, -127, 127),
    "zeros and the least step": lambda rng: rng.choice([0, -1], (7, 7, 7)),
    "zeros beside depth": lambda rng: rng.choice([0, -127], (7, 7, 7)),
    "two nodes a side": lambda rng: np.array([[[-9, 3], [4, -8]], [[5, -7], [-6, 2]]]),
    "at the border": lambda rng: ball([0.0, 12.0, 27.0], 6.0).phi[0],
    # Where marching cubes as it is leaves holes (scikit-image issue 8116) or doubles faces (8109).
    "ambiguous": lambda rng: rng.choice([-2, -1, 0, 1, 2, 4], (8, 8, 8)),
    "ambiguous ties": lambda rng: 2 * np.array([[[13, -1], [-1, -7]], [[-1, 1], [7, -7]], [[15, -9], [-3, -1]]]),
    # So thin that moving as far as others do for the volume's sake would turn it inside out.
    "the least step, scattered": lambda rng: rng.choice([-1, 127], (4, 2, 4)),
    "noise": lambda rng: rng.integers(-127, 128, (9, 9, 9)),
}


@pytest.mark.parametrize("name", SHEETS)
def test_a_mesh_is_closed_whatever_the_distance_is_like(name: str) -> None:
    for seed in range(8):
        assert faults(surface_mesh(of(SHEETS[name](np.random.default_rng(seed))))) == []


def test_marching_cubes_as_it_is_would_not_do() -> None:
    """What the unrounding is for: the same fields, straight into scikit-image."""
    from skimage.measure import marching_cubes

    rng = np.random.default_rng(0)
    steps = np.pad(SHEETS["ambiguous"](rng).astype(np.float32), 1, constant_values=127)
    vertices, faces, _, _ = marching_cubes(steps, 0.0, gradient_direction="descent")
    assert not trimesh.Trimesh(vertices, faces, process=False).is_watertight


def test_no_liquid_is_an_empty_mesh() -> None:
    for steps in (np.full((3, 4, 5), 127), np.zeros((3, 4, 5))):
        mesh = surface_mesh(of(steps))
        assert (mesh.vertices.shape, mesh.faces.shape, mesh.normals.shape) == ((0, 3), (0, 3), (0, 3))


def test_several_instants_are_refused() -> None:
    with pytest.raises(ValueError, match="2 instants"):
        surface_mesh(SignedDistance(np.zeros((2, 3, 3, 3), np.int8), ORIGIN, VOXEL))

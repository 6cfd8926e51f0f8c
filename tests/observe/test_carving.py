"""The compiled distance to a view's silhouette cone against NumPy in double precision."""

from __future__ import annotations

import os
from pathlib import Path

import numpy as np
import pytest

from splashbench.native.threads import use_threads
from splashbench.observe.carving import BLOCK, KERNEL, blocks_of, carve_hidden_view, carve_view
from splashbench.scene import Camera, look_at

LIMIT = 20.0


class View:
    """A camera, what it sees of a grid before and behind it, and an occluder in steps."""

    def __init__(self, seed: int, shape: tuple[int, int, int] = (21, 18, 83), layers: int = 3) -> None:
        rng = np.random.default_rng(seed)
        eye = rng.normal(size=3)
        # One of three is within the grid.
        eye *= (0.4 if seed % 3 == 0 else 2.5) / np.linalg.norm(eye)
        self.camera = Camera("a", 60, 50, np.array([[70.0, 0, 31], [0, 80, 24], [0, 0, 1]]), look_at(eye))
        self.shape, self.origin, self.voxel = shape, np.array([-0.507, -0.451, -1.003]), 0.025
        self.focal, self.corner = 75.0, np.array([4.0, 7.0])
        self.layers = rng.normal(scale=9, size=(layers + 1, 31, 44)).astype(np.float32)
        self.nearest = rng.uniform(1.5, 3.5, (31, 44)).astype(np.float32)
        self.starts = np.sort(rng.uniform(1.5, 3.5, layers))
        self.blocks = rng.random(blocks_of(shape)) < 0.6

    def carve(self, phi: np.ndarray, second: np.ndarray | None = None, blocks: np.ndarray | None = None) -> None:
        place = (self.origin, self.voxel, self.camera.projection, self.focal)
        depths = (self.layers, self.corner, self.nearest, self.starts, 0.03)
        carve_hidden_view(phi, *place, *depths, LIMIT, second, blocks)

    def distances(self) -> tuple[np.ndarray, np.ndarray]:
        """What the view says of every node in voxels, and whether it is before the camera: [nx, ny, nz]."""
        nodes = np.stack(np.meshgrid(*map(np.arange, self.shape), indexing="ij"), axis=-1) * self.voxel + self.origin
        homogeneous = nodes @ self.camera.projection[:, :3].T + self.camera.projection[:, 3]
        depth = homogeneous[..., 2]
        with np.errstate(divide="ignore", invalid="ignore"):
            pixel = homogeneous[..., :2] / np.where(depth > 0, depth, np.nan)[..., None] - 0.5 - self.corner
        pixel[np.isnan(pixel)] = 0
        last = np.array(self.layers.shape[:0:-1]) - 1
        within = np.clip(pixel, 0, last)
        beyond = np.linalg.norm(pixel - within, axis=-1)
        column, row = np.moveaxis(np.minimum(within.astype(int), last - 1), -1, 0)
        across, down = np.moveaxis(within - np.stack([column, row], axis=-1), -1, 0)
        near_column, near_row = np.moveaxis((within + 0.5).astype(int), -1, 0)
        layer = (self.starts[:, None, None, None] + 0.03 <= depth).sum(axis=0)
        covered = (beyond == 0) & (self.nearest[near_row, near_column] < depth - 0.03) if len(self.starts) else False
        layer = np.minimum(layer + covered, len(self.starts))
        above, below = (
            self.layers[layer, row + step, column] * (1 - across) + self.layers[layer, row + step, column + 1] * across
            for step in (0, 1)
        )
        pixels = above * (1 - down) + below * down + beyond
        return np.clip(pixels * depth / (self.focal * self.voxel), -LIMIT, LIMIT), depth > 0


def nodes_of(blocks: np.ndarray, shape: tuple[int, int, int]) -> np.ndarray:
    """bool `shape`: the nodes of the blocks that are wanted."""
    wanted = blocks.repeat(BLOCK, 0).repeat(BLOCK, 1).repeat(BLOCK, 2)
    return wanted[: shape[0], : shape[1], : shape[2]]


#: Where the kernels are that are to be tested: those of `make sanitize` lie elsewhere.
FOLDER = Path(os.environ.get("SPLASHBENCH_KERNEL") or KERNEL.folder)


@pytest.fixture(params=[name for name in KERNEL.built_variants(FOLDER) if name.isalnum()])
def variant(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> str:
    """The kernel of one variant after the other."""
    if not KERNEL.runs(request.param):
        pytest.skip(f"this processor does not run {request.param}")
    monkeypatch.setitem(KERNEL.__dict__, "library", KERNEL.open_variant(request.param, FOLDER))
    return str(request.param)


@pytest.mark.usefixtures("variant")
@pytest.mark.parametrize("seed", range(9))
@pytest.mark.parametrize("layers", [0, 3])
def test_a_view_says_what_numpy_says(seed: int, layers: int) -> None:
    view = View(seed, layers=layers)
    before = np.random.default_rng([seed, 1]).uniform(-LIMIT, LIMIT, view.shape).astype(np.float32)
    phi = before.copy()
    view.carve(phi, blocks=view.blocks)
    distance, ahead = view.distances()
    wanted = nodes_of(view.blocks, view.shape)
    assert (~ahead).any() == (seed % 3 == 0)
    expected = np.where(wanted, np.maximum(before, np.where(ahead, distance, LIMIT)), before)
    np.testing.assert_array_equal(phi[~wanted], before[~wanted])
    np.testing.assert_allclose(phi, expected, atol=2e-4)


@pytest.mark.parametrize("seed", range(4))
def test_the_second_largest_is_kept_too(seed: int) -> None:
    phi = np.full((21, 18, 83), -LIMIT, np.float32)
    second = phi.copy()
    said = []
    for number in range(4):
        view = View(10 * seed + number)
        view.carve(phi, second)
        distance, ahead = view.distances()
        said.append(np.where(ahead, distance, -LIMIT))
    ranked = np.sort(said, axis=0)
    np.testing.assert_allclose(phi, ranked[-1], atol=2e-4)
    np.testing.assert_allclose(second, ranked[-2], atol=2e-4)


@pytest.mark.parametrize("shape", [(0, 5, 5), (5, 5, 0), (1, 1, 1), (1, 7, 65), (5, 1, 64), (6, 6, 1)])
def test_grids_of_any_size(shape: tuple[int, int, int]) -> None:
    view = View(4, shape)
    phi = np.full(shape, -LIMIT, np.float32)
    view.carve(phi)
    distance, ahead = view.distances()
    np.testing.assert_allclose(phi, np.where(ahead, distance, LIMIT), atol=2e-4)


@pytest.mark.usefixtures("variant")
def test_threads_and_blocks_change_no_bit() -> None:
    view = View(5, (23, 19, 301))
    whole = np.full(view.shape, -LIMIT, np.float32)
    with use_threads(1):
        view.carve(whole)
    parts = np.full(view.shape, -LIMIT, np.float32)
    with use_threads(3):
        view.carve(parts, blocks=view.blocks)
        view.carve(parts, blocks=~view.blocks)
    np.testing.assert_array_equal(parts, whole)


@pytest.mark.usefixtures("variant")
@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf, 1e308, 0.0])
def test_a_camera_that_is_none_reads_nothing_beside_the_images(value: float) -> None:
    """All images of the view hold one value, and what lies before and after them in memory no number: what is said is
    linear in that value."""
    view = View(1)
    around = np.full((len(view.layers) + 2, *view.nearest.shape), 1e30, np.float32)
    layers = around[1:-1]
    for row in range(3):
        for column in range(4):
            projection = view.camera.projection.copy()
            projection[row, column] = value
            said = []
            for everywhere in (-1, 0, 1):
                layers[:] = everywhere
                phi = np.full(view.shape, -LIMIT, np.float32)
                depths = (layers, view.corner, view.nearest, view.starts, 0.03)
                carve_hidden_view(phi, view.origin, view.voxel, projection, view.focal, *depths, LIMIT)
                assert np.abs(phi).max() <= LIMIT
                said.append(phi)
            unclipped = np.max(np.abs(said), axis=0) < LIMIT
            low, middle, high = (phi[unclipped] for phi in said)
            np.testing.assert_allclose(low + high, 2 * middle, atol=1e-4)


@pytest.mark.usefixtures("variant")
@pytest.mark.parametrize("name", ["layers", "nearest", "starts"])
@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf])
def test_images_and_depths_that_are_no_numbers_leave_numbers(name: str, value: float) -> None:
    view = View(2)
    getattr(view, name).reshape(-1)[::3] = value
    phi = np.full(view.shape, -LIMIT, np.float32)
    view.carve(phi)
    assert np.isfinite(phi).all()


def read_only() -> np.ndarray:
    field = np.zeros((3, 3, 3), np.float32)
    field.flags.writeable = False
    return field


@pytest.mark.parametrize(
    ("change", "error", "named"),
    [
        ({"phi": np.zeros((3, 3, 3))}, TypeError, "phi"),
        ({"phi": np.zeros((3, 3, 6), np.float32)[..., ::2]}, TypeError, "phi"),
        ({"phi": np.zeros((3, 3), np.float32)}, ValueError, "phi"),
        ({"phi": read_only()}, ValueError, "phi"),
        ({"second": read_only()}, ValueError, "second"),
        ({"second": np.zeros((3, 3, 2), np.float32)}, ValueError, "second"),
        ({"second": np.zeros((3, 3, 3))}, TypeError, "second"),
        ({"layers": np.zeros((3, 9, 9), np.float32)}, ValueError, "starts"),
        ({"layers": np.zeros((2, 1, 9), np.float32)}, ValueError, "layers"),
        ({"layers": np.zeros((9, 9), np.float32)}, ValueError, "layers"),
        ({"layers": np.zeros((0, 9, 9), np.float32)}, ValueError, "layers"),
        ({"layers": np.broadcast_to(np.float32(0), (2, 2**16, 2**15))}, ValueError, "layers"),
        ({"nearest": np.zeros((9, 8), np.float32)}, ValueError, "nearest"),
        ({"projection": np.eye(3)}, ValueError, "projection"),
        ({"origin": np.zeros(2)}, ValueError, "origin"),
        ({"corner": np.zeros(3)}, ValueError, "corner"),
        ({"blocks": np.ones((2, 1, 1), bool)}, ValueError, "blocks"),
        ({"voxel": 0.0}, ValueError, "voxel"),
        ({"voxel": np.nan}, ValueError, "voxel"),
        ({"focal": -9.0}, ValueError, "focal"),
        ({"limit": np.inf}, ValueError, "limit"),
    ],
)
def test_what_does_not_fit_together_is_named(change: dict, error: type[Exception], named: str) -> None:
    given = {
        "phi": np.zeros((3, 3, 3), np.float32),
        "origin": np.zeros(3),
        "voxel": 0.1,
        "projection": np.eye(3, 4),
        "focal": 9.0,
        "layers": np.zeros((2, 9, 9), np.float32),
        "corner": np.zeros(2),
        "nearest": np.zeros((9, 9), np.float32),
        "starts": np.ones(1),
        "tolerance": 0.0,
        "limit": LIMIT,
    }
    carve_hidden_view(**given)
    with pytest.raises(error, match=f"^{named} "):
        carve_hidden_view(**(given | change))


def test_an_image_of_one_row_is_refused() -> None:
    with pytest.raises(ValueError, match=r"^silhouette is \[1, 9\]"):
        carve_view(
            np.zeros((3, 3, 3), np.float32),
            np.zeros(3),
            0.1,
            np.eye(3, 4),
            9.0,
            np.zeros((1, 9), np.float32),
            np.zeros(2),
            LIMIT,
        )

"""Where the near wall's edge is: moved until the liquid ends there in the training masks. Not in the paper.

A pool that reaches behind the near rim ends at its edge in the image, frame after frame. A mesh that is a millimetre
too high ends it half a pixel early, and half a pixel shows. A vessel found by its masks is its outside, while its edge
is that of a lip with thickness. So the container is moved along its axis, by a plane over its opening, as far as liquid
that masks show and the wall's outline disagree.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from scipy.ndimage import map_coordinates
from scipy.optimize import least_squares
from skimage.measure import find_contours

from splashbench.scene.container import ContainerMesh
from splashbench.scene.scene import TrainingScene

from .container import KnownContainer
from .near_wall import NearWall, near_wall, room_beside
from .occlusion import LiquidOcclusion
from .vessel import Vessel, upright

# How far an edge is looked for, in pixels, and as a share of the image's longer side; and in what steps.
_SEARCH, _SEARCH_SHARE, _STEP = 3.0, 0.008, 0.1
# Edges as deep below the rim as this share of the container's height are no rim's.
_RIM_SHARE = 0.35
# Frames that have to show liquid at a pixel, where there are as many; and frames that are looked at.
_FRAMES, _LOOKED_AT = 2, 48
# Views, and edge points of all of them, from which a displacement is taken.
_LEAST_VIEWS, _LEAST_POINTS = 2, 40
# By what half of the edge points may be off afterwards, for the edge to be sharp: pixels, or a share of the radius. And
# pixels from which an edge point is an outlier.
_SHARP, _SHARP_SHARE, _OUTLIER = 0.5, 0.01, 0.3
# What a pixel of tilt costs, in pixels of every edge point: where one side is seen alone, it is next to unknown.
_TILT_WEIGHT = 0.1
# Movement by which derivatives are taken, in radii.
_SMALL = 0.01


@dataclass(frozen=True)
class RimFit:
    """How the container was moved to meet the masks.

    lift: [3] along the axis: at the opening's middle, and by how much more a radius away along two directions across;
    scene units. points, views: that it rests on. error: median distance of the edge points afterwards, pixels. unit:
    radii of the container that a pixel is.
    """

    lift: np.ndarray
    points: int
    views: int
    error: float
    unit: float

    @property
    def sharp(self) -> bool:
        """Whether the masks end where the moved wall does."""
        enough = self.views >= _LEAST_VIEWS and self.points >= _LEAST_POINTS
        return enough and (self.error <= _SHARP or self.error * self.unit <= _SHARP_SHARE)


@dataclass(frozen=True)
class _Edge:
    """Edge points of one view: at [N, 3] on the wall, offsets [N] pixels by which masks end beyond the wall's edge
    (negative: liquid is seen where the wall should be), outwards: [N, 2] unit vectors in the image, away from the
    wall."""

    at: np.ndarray
    offsets: np.ndarray
    outwards: np.ndarray


@dataclass(frozen=True)
class Rim:
    """A container whose near wall is where masks end, as far as that can be told.

    mesh: in its place, scene units. room, up: see `LiquidOcclusion`; None where its edges are not sharp enough to cut
    pixels. found: how it was found, in words.
    """

    mesh: ContainerMesh
    room: np.ndarray | None
    up: np.ndarray | None
    found: str

    def __str__(self) -> str:
        return self.found

    def occlusion(self, tolerance: float) -> LiquidOcclusion:
        """What it hides from cameras. tolerance: see there."""
        return LiquidOcclusion(self.mesh, tolerance, self.room, self.up)


def rim_of(known: KnownContainer, scene: TrainingScene, failed: np.ndarray) -> Rim:
    """The rim of the opaque container `known`. failed: bool [T, V], masks of `scene` that are not to be trusted.

    Its near wall cuts pixels where masks end at its rim, or where nothing contradicts the scene's mesh.
    """
    assert known.occlusion is not None
    mesh, gravity = known.occlusion.mesh, known.gravity
    if gravity is None:
        return Rim(mesh, None, None, "not looked for, as gravity is not known")
    vessel = Vessel.of(mesh, gravity)
    if vessel is None:
        return Rim(mesh, None, None, "none: the container encloses nothing")
    up, room = -np.asarray(gravity, dtype=np.float64), room_beside(mesh, vessel)
    walls = [near_wall(mesh, room, up, scene.cameras[name], 0.0) for name in scene.train]
    fit = fit_rim(mesh, up, walls, scene, failed)
    if fit is not None and fit.sharp:
        words = f"moved by {fit.lift[0]:.3g} units along the axis, to within {fit.error:.2f} px of where masks end"
        return Rim(moved(mesh, up, fit), room, up, words)
    if known.source == "mesh" and (fit is None or fit.points < _LEAST_POINTS):
        return Rim(mesh, room, up, "that of the mesh: too few masks end there to tell better")
    return Rim(mesh, None, None, "blurred: masks do not end there")


def fit_rim(
    mesh: ContainerMesh, up: np.ndarray, walls: Sequence[NearWall | None], scene: TrainingScene, failed: np.ndarray
) -> RimFit | None:
    """How `mesh` is to be moved along `up` (unit vector [3]); None where no mask ends at the rim.

    walls: of the training views of `scene`, in their order. failed: bool [T, V], masks that are not to be trusted.
    """
    edges: list[tuple[NearWall, _Edge]] = []
    for view, wall in enumerate(walls):
        if wall is not None and (edge := _edge(wall, _liquid(scene, view, failed), mesh, up)) is not None:
            edges.append((wall, edge))
    if not edges:
        return None
    middle, radius, across = _opening(mesh, up)
    rows, offsets = [], []
    for wall, edge in edges:
        places = (edge.at - middle) @ across.T / radius
        small = _SMALL * radius
        motion = wall.camera.project(edge.at + small * up)[0] - wall.camera.project(edge.at)[0]
        lifted = (motion * edge.outwards).sum(axis=1) / small
        rows.append(lifted[:, None] * np.column_stack([np.ones(len(places)), places]))
        offsets.append(edge.offsets)
    matrix, wanted = np.concatenate(rows), np.concatenate(offsets)
    scale = max(float(np.abs(matrix[:, 0]).mean()), 1e-12)
    weights = _TILT_WEIGHT * np.sqrt(len(wanted)) * np.array([0.0, 1.0, 1.0])

    def residuals(values: np.ndarray) -> np.ndarray:
        # Numbers in pixels, so that the loss and the weights mean the same in every scene.
        return np.concatenate([matrix @ values / scale - wanted, weights * values])

    found = least_squares(residuals, np.zeros(3), loss="soft_l1", f_scale=_OUTLIER)
    error = float(np.median(np.abs(residuals(found.x)[: len(wanted)])))
    return RimFit(found.x / scale, len(wanted), len(edges), error, 1 / (scale * radius))


def moved(mesh: ContainerMesh, up: np.ndarray, fit: RimFit) -> ContainerMesh:
    """`mesh`, moved along `up` by `fit`."""
    middle, radius, across = _opening(mesh, up)
    places = (mesh.vertices - middle) @ across.T / radius
    lift = fit.lift[0] + places @ fit.lift[1:]
    return ContainerMesh(mesh.vertices + lift[:, None] * up, mesh.faces)


def _opening(mesh: ContainerMesh, up: np.ndarray) -> tuple[np.ndarray, float, np.ndarray]:
    """Middle [3] and radius of the container, and two unit vectors [2, 3] across `up`."""
    across = upright(-up)[:2]
    middle = 0.5 * (mesh.vertices.min(axis=0) + mesh.vertices.max(axis=0))
    radius = float(np.linalg.norm((mesh.vertices - middle) @ across.T, axis=1).max())
    return middle, max(radius, 1e-12), across


def _liquid(scene: TrainingScene, view: int, failed: np.ndarray) -> np.ndarray:
    """bool [H, W]: pixels that trusted masks of the view call liquid, in more than one frame. failed: bool [T, V]."""
    frames = np.flatnonzero(~failed[:, view])
    frames = frames[np.unique(np.linspace(0, len(frames) - 1, min(len(frames), _LOOKED_AT)).round().astype(int))]
    counts = np.zeros(scene.mask(scene.train[view], 0).shape, dtype=np.int32)
    for t in frames:
        counts += scene.mask(scene.train[view], int(t))
    return np.asarray(counts >= min(_FRAMES, max(1, len(frames) // 2)))


def _edge(wall: NearWall, liquid: np.ndarray, mesh: ContainerMesh, up: np.ndarray) -> _Edge | None:
    """Where the wall's outline near the rim has liquid beyond it; `liquid`: bool [H, W]."""
    # Middles of pixels are whole numbers here.
    points = np.concatenate([np.zeros((0, 2)), *find_contours(wall.share, 0.5)])
    slope = np.stack(np.gradient(cv2.GaussianBlur(wall.share, (0, 0), 1.0)))
    slopes = np.stack([map_coordinates(part, points.T, order=1) for part in slope], axis=1)
    steepness = np.linalg.norm(slopes, axis=1)
    points, outwards = points[steepness > 1e-6], -slopes[steepness > 1e-6] / steepness[steepness > 1e-6, None]
    last = np.array(wall.share.shape) - 1
    row, column = np.clip(np.rint(points - outwards), 0, last).astype(int).T
    depth = wall.depth[row, column]
    shown = np.isfinite(depth)
    points, outwards = points[shown], outwards[shown]
    camera = wall.camera
    pixels = np.column_stack([points[:, ::-1] + 0.5, np.ones(len(points))])
    local = np.linalg.solve(camera.K, pixels.T).T * depth[shown][:, None]
    at = (local - camera.w2c[:3, 3]) @ camera.w2c[:3, :3]
    heights = mesh.vertices @ up
    deepest = heights.max() - _RIM_SHARE * np.ptp(heights)
    search = max(_SEARCH, _SEARCH_SHARE * max(wall.share.shape))
    steps = np.arange(-search, search + _STEP / 2, _STEP)
    places = np.rint(points[:, None] + steps[:, None] * outwards[:, None])
    within = ((places >= 0) & (places <= last)).all(axis=2)
    row, column = np.clip(places, 0, last).astype(int).transpose(2, 0, 1)
    wet = liquid[row, column] & within
    several = round(1 / _STEP)
    ends = wet[:, -several:].all(axis=1) & ~wet[:, : several // 2].any(axis=1)
    used = ends & (at @ up >= deepest)
    if not used.any():
        return None
    offsets = search - _STEP * (wet[used].sum(axis=1) - 0.5)
    return _Edge(at[used], offsets, outwards[used][:, ::-1])

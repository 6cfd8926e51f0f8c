"""Carving where views do not see: a view is no evidence about what it does not show, and walls hold no liquid.

A view whose line of sight to x the container blocks says nothing about x. One view at least must see x all the same.
Nor does a view whose image ends before x where it cuts liquid off (cut_off.py); the images of most views must have x.
In a view the hidden pixels join the silhouette, at each depth those that are hidden there. So phi keeps its sub-voxel
outline where the view sees, and does not break off where the container begins.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Literal

import numpy as np

from splashbench.observe.carving import carve_hidden_view
from splashbench.observe.container import depth_image, hidden, solid_distance
from splashbench.observe.cut_off import in_images, places_in_images
from splashbench.observe.grid import Grid
from splashbench.observe.image_window import ImageWindow
from splashbench.observe.mask_distance import inner_distance, signed_distance_2d
from splashbench.observe.silhouettes import NO_EVIDENCE, Silhouettes
from splashbench.scene.camera import Camera
from splashbench.scene.container import ContainerMesh
from splashbench.scene.scene import Scene, TrainingScene

#: phi is clipped to this many voxels: nothing farther from the interface matters to transport, carriers or opacity
LIMIT_VOXELS = 20.0
# Of what is hidden, between the nearest and the farthest surface of the container.
_LAYERS = 4
# Stored in eighths of a pixel, to halve the memory.
_PER_PIXEL = 8
_FARTHEST_PIXELS = 4000.0
# Voxels behind the mesh's surface where it begins to hide, for errors of the mesh and of its place.
_TOLERANCE_VOXELS = 1.0
# Voxels below the floor from which nothing is liquid: droplets that lie on it are thinner than a voxel, and cut at the
# floor itself they would fall between the nodes. Liquid in the container may then seem to reach up to a voxel below its
# foot, too. Views would see that through a transparent one, and not through others.
_FLOOR_VOXELS = 1.0
# Share of the views whose images have to have a place, where some cut liquid off: all but one of five. What fewer have
# is hardly bounded along their lines of sight: with three of five a hull in a box of .42 units went on for .77.
_IMAGES = 0.75
# So far about the places that these images have, voxels, a view is looked at past its sides. Deeper within liquid that
# goes on past them distances are smaller than they would be.
_NEAR_VOXELS = 4.0


def focal_length(camera: Camera) -> float:
    """Pixels per unit of x / z, the mean of both axes: one pixel at depth z spans z / f scene units."""
    return 0.5 * float(camera.K[0, 0] + camera.K[1, 1])


@dataclass(frozen=True, eq=False)
class ContainerOcclusion:
    """The container as carving needs it.

    mesh: in scene units. gravity: unit vector [3] or None; where known, no liquid lies below `floor`.
    hides: False for a transparent container, which blocks no line of sight. foot: position along gravity (scene units)
    of what the container stands on; None for the mesh's lowest point.
    """

    mesh: ContainerMesh
    gravity: np.ndarray | None = None
    hides: bool = True
    foot: float | None = None

    @classmethod
    def of(cls, scene: Scene | TrainingScene) -> ContainerOcclusion | None:
        """The container of `scene`, or None where it has no mesh."""
        mesh = scene.container_mesh()
        if mesh is None:
            return None
        return cls(mesh, scene.gravity, hides=not scene.container_transparent)

    def with_mesh(self, mesh: ContainerMesh) -> ContainerOcclusion:
        """The same container with its walls in another place, scene units. What it stands on is not lifted with them,
        so that droplets that lie there are not forbidden; walls that are lowered take it along."""
        moved = replace(self, mesh=mesh, foot=None)
        if self.floor is None or moved.floor is None:
            return moved
        return replace(moved, foot=max(self.floor, moved.floor))

    @property
    def floor(self) -> float | None:
        """Position along gravity (scene units) of what liquid cannot fall through; None where gravity is not known."""
        if self.gravity is None:
            return None
        if self.foot is not None:
            return self.foot
        return float((self.mesh.vertices @ self.gravity).max())

    def forbidden(self, grid: Grid) -> np.ndarray:
        """Signed distance, in voxels, into where the container allows liquid: > 0 in its walls and below its floor; of
        an opaque container from a voxel below."""
        distance = -solid_distance(self.mesh, grid)
        floor = self.floor
        if self.gravity is not None and floor is not None:
            i, j, k = (np.arange(n) * grid.voxel * g for n, g in zip(grid.shape, self.gravity))
            start = float(grid.origin @ self.gravity) - floor - (_FLOOR_VOXELS * grid.voxel if self.hides else 0.0)
            depth = (start + i[:, None, None] + j[:, None] + k) / grid.voxel
            np.maximum(distance, depth.astype(np.float32), out=distance)
        return np.clip(distance, -LIMIT_VOXELS, LIMIT_VOXELS)


class ViewOcclusion:
    """What the container hides from one view: its depth, and the hidden pixels at growing depths."""

    def __init__(self, camera: Camera, mesh: ContainerMesh, window: ImageWindow) -> None:
        """window: of what the view says of liquid; the occlusion's own holds it and the whole container. Past the image
        nothing is hidden."""
        import cv2

        self.camera = camera
        depth = depth_image(mesh, camera)
        # A pixel wider, as mask and mesh never meet exactly.
        depth = cv2.erode(depth, np.ones((3, 3), np.uint8), borderType=cv2.BORDER_REPLICATE)
        covered = np.isfinite(depth)
        if covered.any():
            window = window.joined(ImageWindow.around(covered))
        self.window = window
        image = ImageWindow(0, camera.height, 0, camera.width)
        larger = image.joined(window)
        if larger != image:
            depth = np.pad(depth, image.margins(larger), constant_values=np.inf)
        self.nearest = np.ascontiguousarray(depth[window.within(larger).slices])
        depths = self.nearest[np.isfinite(self.nearest)]
        quantiles = np.unique(np.quantile(depths, np.arange(1, _LAYERS) / _LAYERS)) if len(depths) else np.zeros(0)
        #: depths from which each layer but the first counts
        self.starts = np.append(quantiles, depths.max() * (1 + 1e-6)) if len(depths) else np.zeros(0)
        self._hidden = np.zeros((len(self.starts), *self.nearest.shape), dtype=np.int16)
        for layer, start in enumerate(self.starts):
            pixels = np.clip(signed_distance_2d(self.nearest < start), -_FARTHEST_PIXELS, _FARTHEST_PIXELS)
            self._hidden[layer] = np.rint(pixels * _PER_PIXEL)

    def hidden_at(self, layer: int) -> np.ndarray:
        """Signed distance in pixels to what is hidden at layer number `layer`, from 1: float32 [h, w], < 0 there."""
        return self._hidden[layer - 1].astype(np.float32) / np.float32(_PER_PIXEL)

    def hides(self, points: np.ndarray, grid: Grid) -> np.ndarray:
        """bool [n]: whether the view cannot see `points` [n, 3] in scene units, as far as `grid` resolves it."""
        (x0, y0), (height, width) = self.window.corner, self.window.shape
        camera = self.camera.cropped(int(x0), int(y0), width, height)
        return hidden(points, self.nearest, camera, _TOLERANCE_VOXELS * grid.voxel)

    def visibility(self) -> np.ndarray:
        """How far each pixel lies within what is seen at each layer: float32 [K + 1, h, w] pixels, < 0 where hidden."""
        layers = np.full((len(self.starts) + 1, *self.nearest.shape), _FARTHEST_PIXELS, dtype=np.float32)
        for layer in range(1, len(layers)):
            layers[layer] = self.hidden_at(layer)
        return layers

    def evidence(self, silhouette: np.ndarray) -> np.ndarray:
        """`silhouette` (signed distance in pixels [h, w]) joined with what is hidden, at each layer: [K + 1, h, w]."""
        layers = np.empty((len(self.starts) + 1, *silhouette.shape), dtype=np.float32)
        layers[0] = silhouette
        liquid = silhouette < 0
        for layer in range(1, len(layers)):
            behind = self.hidden_at(layer)
            either = liquid | (behind < 0)
            joined = np.minimum(silhouette, behind)
            # Where the two meet, the outline of neither is one of their union. (A view that says nothing has none.)
            outlined = liquid & ((behind > -silhouette) | (silhouette <= NO_EVIDENCE))
            layers[layer] = np.where(either & ~outlined, -inner_distance(either), joined)
        return layers

    def carve(
        self,
        phi: np.ndarray,
        grid: Grid,
        layers: np.ndarray,
        second: np.ndarray | None = None,
        blocks: np.ndarray | None = None,
    ) -> None:
        """phi = max(phi, what `layers` say), in place, in voxels of `grid`; see `carve_hidden_view`."""
        tolerance = _TOLERANCE_VOXELS * grid.voxel
        self._carve(phi, grid, layers, self.nearest, self.starts, tolerance, LIMIT_VOXELS, second, blocks)

    def carve_least(self, phi: np.ndarray, grid: Grid, layers: np.ndarray, limit: float, reach: float) -> None:
        """As `carve`, with the least that `layers` say no more than `reach` (scene units) deeper than a node. limit: in
        voxels."""
        # A point that is hidden at its own depth looks one layer deeper, and no point looks farther.
        starts = np.append(-np.inf, self.starts[:-1]) if len(self.starts) else self.starts
        self._carve(phi, grid, layers, np.full_like(self.nearest, np.inf), starts, -reach, limit)

    def carve_most(
        self, phi: np.ndarray, grid: Grid, layers: np.ndarray, limit: float, reach: float, voxel: float
    ) -> None:
        """As `carve` on a grid of `voxel`, with the most that `layers` say no more than `reach` nearer than a node."""
        tolerance = _TOLERANCE_VOXELS * voxel + reach
        self._carve(phi, grid, layers, np.full_like(self.nearest, np.inf), self.starts, tolerance, limit)

    def _carve(
        self,
        phi: np.ndarray,
        grid: Grid,
        layers: np.ndarray,
        nearest: np.ndarray,
        starts: np.ndarray,
        tolerance: float,
        limit: float,
        second: np.ndarray | None = None,
        blocks: np.ndarray | None = None,
    ) -> None:
        camera, corner = self.camera, self.window.corner
        place = (grid.origin, grid.voxel, camera.projection, focal_length(camera))
        carve_hidden_view(phi, *place, layers, corner, nearest, starts, tolerance, limit, second, blocks)


class CarvingOcclusion:
    """What the views of `silhouettes` do not see of `grid`, for a container or for where their images end.

    Attributes:
        outside: float32 on `grid`, voxels: > 0 where no liquid can be, whatever the masks say: where it is
            `ContainerOcclusion.forbidden`, where fewer views than `witnesses` see past the container, and where too
            few have it in their images.
        windows: of each view, the window beyond which it says that there is no liquid on `grid`.
        views: what the container hides from each view; empty where it hides nothing.
    """

    def __init__(
        self, container: ContainerOcclusion | None, silhouettes: Silhouettes, grid: Grid, witnesses: Literal[1, 2] = 1
    ) -> None:
        """witnesses: views that have to see a place past the container.

        One is enough to reconstruct: a rim hides the edge of a pool from all views but one, and what that view shows
        there is liquid. Two are for those who hold views against each other.
        """
        if container is None:
            self.outside = np.full(grid.shape, -LIMIT_VOXELS, dtype=np.float32)
        else:
            self.outside = container.forbidden(grid)
        self.windows = _evidence_windows(silhouettes, grid)
        self.views: list[ViewOcclusion] = []
        if container is not None and container.hides:
            for camera, window in zip(silhouettes.cameras, self.windows):
                self.views.append(ViewOcclusion(camera, container.mesh, window))
            np.maximum(self.outside, -self._seen(grid)[witnesses - 1], out=self.outside)
        if any(silhouettes.cut_off):
            np.maximum(
                self.outside, -in_images(silhouettes.that_see_liquid, grid, _IMAGES, LIMIT_VOXELS), out=self.outside
            )

    @classmethod
    def of(
        cls,
        container: ContainerOcclusion | None,
        silhouettes: Silhouettes,
        grid: Grid,
        witnesses: Literal[1, 2] = 1,
    ) -> CarvingOcclusion | None:
        """That of `container`, or None where views see all there is: no container, and no liquid cut off."""
        if container is None and not any(silhouettes.cut_off):
            return None
        return cls(container, silhouettes, grid, witnesses)

    def _seen(self, grid: Grid) -> tuple[np.ndarray, np.ndarray]:
        """Voxels by which a node lies within what at least one view sees, and two; < 0 where fewer do."""
        best = np.full(grid.shape, -LIMIT_VOXELS, dtype=np.float32)
        second = best.copy()
        for view in self.views:
            view.carve(best, grid, view.visibility(), second)
        return best, second


def _evidence_windows(silhouettes: Silhouettes, grid: Grid) -> list[ImageWindow]:
    """Those of the masks, with what lies past the images where they cut liquid off, as far as enough images have it."""
    windows = list(silhouettes.windows)
    if not any(silhouettes.cut_off):
        return windows
    places, apart = places_in_images(silhouettes.that_see_liquid, grid, _IMAGES)
    reach = apart + _NEAR_VOXELS * grid.voxel
    for view, (camera, cut_off) in enumerate(zip(silhouettes.cameras, silhouettes.cut_off)):
        if cut_off is not None:
            windows[view] = cut_off.window_of(camera, places, reach)
    return windows

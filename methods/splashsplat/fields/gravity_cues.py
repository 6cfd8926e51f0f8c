"""What gravity says of a sequence before any frame is reconstructed: where the jet is, and how high the pool stands.

Both follow from gravity, the container and the masks of all frames; see jet.py and pool.py. Not in the paper.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from splashbench.observe.grid import Bounds, Grid
from splashbench.observe.occlusion import ContainerOcclusion
from splashbench.observe.signed_distance import signed_distance_frames
from splashbench.observe.silhouettes import Silhouettes

from .jet import STANDARD_GRAVITY, Jet, Slices, fit_jets, framed, open_floor, slices_of
from .pool import LiquidPool
from .vessel import Vessel, upright

_CELLS = 96
# What is within so many voxels above a container's rim may rest on it.
_RIM_MARGIN = 4


@dataclass(frozen=True)
class GravityCues:
    """What is known of the liquid before it is reconstructed.

    turn: [3, 3] scene axes to upright ones. jets: per frame, or None. floor: height above which the jets were found,
    scene units. pool, levels: the pool and its height per frame (NaN: none), or None and all NaN. container_depths:
    per view the container's depth image, None where it hides nothing. scaled: whether gravity's strength was told.
    """

    turn: np.ndarray
    jets: list[Jet | None]
    floor: float
    pool: LiquidPool | None
    levels: np.ndarray
    container_depths: list[np.ndarray | None]
    scaled: bool = True

    def fall(self) -> str | None:
        """How the jet falls, in words; None where there is none."""
        jet = next((jet for jet in self.jets if jet is not None), None)
        if jet is None:
            return None
        whence = "of the scene" if self.scaled else "by how its first drop and its last fall"
        return (
            f"passes height {jet.top:.3g} at {jet.speed:.3g} scene units/s; "
            f"gravity {jet.gravity:.3g} scene units/s^2, {whence}"
        )

    def refined(self, phi: np.ndarray, grid: Grid, t: int) -> np.ndarray:
        """The hull's distance `phi` of frame `t` on `grid` (voxels), with a full pool and without what floats on it;
        it is changed in place."""
        if self.pool is None or not np.isfinite(self.levels[t]):
            return phi
        return self.pool.lowered(phi, grid, float(self.levels[t]), self.container_depths, self.jets[t])

    def jet_floor(self, t: int) -> float:
        """Height down to which the jet of frame `t` flies freely: to the pool, or to the wall that its axis meets.

        Where nobody sees how high the pool stands, it stands no higher than when it is seen next, as it fills up; where
        it is not seen any more, it is taken for empty. Without a vessel a jet flies down to where jets were found.
        """
        known = self.levels[t:][np.isfinite(self.levels[t:])]
        if len(known):
            return float(known[0])
        jet, vessel = self.jets[t], None if self.pool is None else self.pool.vessel
        return self.floor if jet is None or vessel is None else min(self.floor, vessel.foot(jet.axis))

    def landed(self, grid: Grid, t: int, start: np.ndarray, end: np.ndarray) -> np.ndarray:
        """Where carriers that fly from `start` to `end` [N, 3] (nodes of `grid`) until frame `t` come to rest.

        A fall ends where it meets the pool or the container's wall.
        """
        vessel = None if self.pool is None else self.pool.vessel
        level = float(self.levels[t])
        if vessel is None:
            return end
        stays = np.ones(len(start), dtype=np.float32)
        from_height, to_height = vessel.height(grid.to_scene(start)), vessel.height(grid.to_scene(end))
        falls = (from_height > level) & (to_height < level)  # neither where the level is not known (NaN)
        stays[falls] = (from_height[falls] - level) / (from_height[falls] - to_height[falls])
        way = np.linalg.norm(end - start, axis=1)
        far = np.nonzero(way > 1)[0]  # a voxel at a time: no wall is thinner
        for step in range(1, int(np.ceil(way.max(initial=0))) + 1):
            far = far[(step - 1) / way[far] < stays[far]]
            share = np.minimum(step / way[far], stays[far]).astype(np.float32)
            points = start[far] + share[:, None] * (end[far] - start[far])
            walled = far[vessel.walled(grid.to_scene(points))]
            stays[walled] = (step - 1) / way[walled]
        return (start + stays[:, None] * (end - start)).astype(np.float32)


def gravity_cues(
    silhouettes: Silhouettes,
    container: ContainerOcclusion | None,
    gravity: np.ndarray,
    container_depths: list[np.ndarray | None],
    find_pool: bool = True,
    falling: FallingJets | None = None,
) -> GravityCues:
    """What follows from `gravity`, a unit vector [3]. container_depths: see `GravityCues`. falling: the jets, where
    they were looked for."""
    vessel = None if container is None else Vessel.of(container.mesh, gravity)
    pool = (
        None
        if vessel is None or container is None or not find_pool
        else LiquidPool(vessel, silhouettes, container.hides)
    )
    levels = np.full(silhouettes.n_frames, np.nan) if pool is None else pool.levels()
    if falling is None:
        falling = FallingJets([None] * silhouettes.n_frames, -np.inf, True)
    return GravityCues(upright(gravity), falling.jets, falling.floor, pool, levels, container_depths, falling.scaled)


@dataclass(frozen=True)
class FallingJets:
    """jets: per frame, or None. floor, scaled: see `GravityCues`."""

    jets: list[Jet | None]
    floor: float
    scaled: bool


def falling_jets(
    silhouettes: Silhouettes,
    coarse: Silhouettes,
    bounds: Bounds,
    container: ContainerOcclusion | None,
    gravity: np.ndarray,
    metres_per_unit: float | None,
    times: np.ndarray,
) -> FallingJets:
    """The jets of all frames, by hulls on a coarse grid over `bounds`.

    coarse: the masks as that grid needs them. gravity: unit vector [3]. metres_per_unit: None where the scale or the
    frames' times are not known; then a jet has to tell by itself how fast it falls.
    """
    turn = upright(gravity)
    vessel = None if container is None else Vessel.of(container.mesh, gravity)
    grid = Grid.over(bounds, _CELLS)
    upright_nodes = grid.nodes().reshape(-1, 3) @ turn.T
    frames: list[Slices] = []
    for phi in signed_distance_frames(coarse, grid, "silhouette", container):
        filled = np.clip(0.5 - phi.reshape(-1), 0, 1)
        inside = filled > 0
        frames.append(slices_of(upright_nodes[inside], filled[inside], grid.voxel))
    floor = open_floor(frames, grid.voxel) if vessel is None else vessel.rim + _RIM_MARGIN * grid.voxel
    airborne = [framed(frame.above(floor), silhouettes.cameras, turn) for frame in frames]
    strength = None if metres_per_unit is None else STANDARD_GRAVITY / metres_per_unit
    lowest = None
    if container is None or not container.hides:
        lowest = [float(frame.height[0]) if len(frame.height) else np.inf for frame in frames]
    jets = fit_jets(airborne, times, strength, grid.voxel, lowest)
    return FallingJets(jets, floor, strength is not None)

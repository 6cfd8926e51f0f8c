"""What the masks of a sequence say of its liquid, before motion and appearance (paper, "Observation fields").

`observe` looks at all frames at once: masks that failed, the box that holds the liquid, the jet and the pool. The
signed distance phi_t then comes frame by frame from `Observations.signed_distances`.
The runs of one study share both (`Run.reuse`): they are most of a short fit, and its rows seldom differ in them.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import asdict, dataclass
from functools import cached_property, partial
from pathlib import Path
from typing import Any

import numpy as np
import torch

from splashbench.background.clean_plate import make_clean_plates
from splashbench.container.footage_vessel import Standing, standing_about_liquid
from splashbench.errors import SplashbenchError
from splashbench.harness.contract import Decision, Run, Rung
from splashbench.observe import Grid, Silhouettes, sequence_bounds, signed_distance_frames, trusted_bounds
from splashbench.observe.grid import Bounds
from splashbench.observe.hull import REFINED_CELLS
from splashbench.observe.kernels import resample
from splashbench.observe.observable import Observable, observable
from splashbench.observe.occlusion import ContainerOcclusion, focal_length
from splashbench.observe.reduced_masks import HeldMasks, ReducedScene, reduction
from splashbench.observe.signed_distance import PADDING, SignedDistanceMethod
from splashbench.scene.geometry import SignedDistance
from splashbench.scene.scene import TrainingScene

from .container import KnownContainer, known_container
from .gravity_cues import FallingJets, GravityCues, falling_jets, gravity_cues
from .occlusion import LiquidOcclusion
from .repeats import repeated_frames
from .rim import Rim, rim_of

Report = Callable[[float, str], None]

# Raised when a change alters what is stored for other runs, so that no study takes over what is from before.
_REVISION = 15
# Pixels that a voxel of a coarse grid spans, at least, where smaller masks stand for large ones.
_COARSE_PIXELS = 3.0


@dataclass(frozen=True)
class FieldSettings:
    """What phi_t depends on; see `SplashSplatConfig`. transport_cells: along the longest side, as hull_cells; both are
    the most that there are, where voxel_pixels asks for fewer. fewest_cells: hull cells that it leaves."""

    hull_cells: int
    transport_cells: int
    voxel_pixels: float
    clear_voxel_pixels: float
    fewest_cells: int
    signed_distance: SignedDistanceMethod
    container: bool
    container_masks: bool
    container_footage: bool
    cut_at_rim: bool
    detect_failed_masks: bool
    replace_empty_masks: bool
    camera_times: bool
    pool: bool
    ballistic: bool
    tight_bounds: bool = True
    repeats: bool = True
    observable: bool = False
    observable_share: float = 0.45

    def key(self) -> dict[str, Any]:
        """What a stored phi_t was computed with; it is on the hull grid, whatever the transport grid."""
        values = asdict(self)
        del values["transport_cells"]
        return {"observations": _REVISION, **values}


@dataclass(frozen=True)
class Observations:
    """What was observed of a sequence.

    silhouettes: the masks; those that failed are distrusted. hull_grid, grid: the fine grid of phi_t, and the coarser
    one of transport, with one origin. container: what carving knows of it, or None. occlusion: what it hides from
    cameras, or None. container_depths: per view its depth image, None where it hides nothing. cues: jet and pool, or
    None where gravity is not known. repeated: bool [T], frames that show nothing new. pixel: what one spans at the
    liquid, scene units, in the median of the views; None where none of them looks there.
    """

    settings: FieldSettings
    silhouettes: Silhouettes
    hull_grid: Grid
    grid: Grid
    container: ContainerOcclusion | None
    occlusion: LiquidOcclusion | None
    container_depths: list[np.ndarray | None]
    cues: GravityCues | None
    repeated: np.ndarray
    pixel: float | None

    @property
    def n_frames(self) -> int:
        return self.silhouettes.n_frames

    @property
    def in_transparent_container(self) -> bool:
        """Whether the liquid is in a container that is known, and seen through."""
        return self.container is not None and not self.container.hides

    @property
    def ratio(self) -> float:
        """Hull voxels per transport voxel."""
        return self.grid.voxel / self.hull_grid.voxel

    @property
    def voxel_pixels(self) -> float | None:
        """Pixels that a transport voxel spans at the liquid; None where no view looks there."""
        return None if self.pixel is None else self.grid.voxel / self.pixel

    def signed_distances(self, run: Run) -> Iterator[np.ndarray]:
        """phi_t of one frame after another: float16 on `hull_grid`, in its voxels.

        Half precision is a thousandth of a voxel near the surface. Every run has it, so that what is stored for other
        runs takes half the room and is what they would compute.
        """
        frames = signed_distance_frames(
            self.silhouettes,
            self.hull_grid,
            self.settings.signed_distance,
            self.container,
            np.flatnonzero(~self.repeated).tolist(),
        )
        phi: np.ndarray | None = None
        for t in range(self.n_frames):
            if phi is None or not self.repeated[t]:
                with run.stage("signed distance"):
                    phi = next(frames)
                    if self.cues is not None:
                        phi = self.cues.refined(phi, self.hull_grid, t)
                    phi = _converted(phi, np.float16)
            yield phi
            if t + 1 < self.n_frames and not self.repeated[t + 1]:
                phi = None  # large, while the next one is carved

    def in_transport_voxels(self, phi: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """`phi` of `signed_distances` as float32 in transport voxels, on the hull grid and on the transport grid."""
        phi = _converted(phi, np.float32)
        phi /= np.float32(self.ratio)
        return phi, resample(phi, self.grid.shape, self.ratio)

    def landed(self, t: int, start: np.ndarray, end: np.ndarray) -> np.ndarray:
        """Where carriers that fly from `start` to `end` [N, 3] (transport grid) come to rest in frame `t`."""
        return end if self.cues is None else self.cues.landed(self.grid, t, start, end)


def _converted(phi: np.ndarray, kind: type[np.floating[Any]]) -> np.ndarray:
    """`phi` as `kind`: by PyTorch, which is faster than NumPy, into memory from NumPy, which asks for huge pages."""
    converted = np.empty(phi.shape, kind)
    if phi.flags.writeable:
        torch.from_numpy(converted).copy_(torch.from_numpy(phi))
    else:
        converted[:] = phi  # from a file that runs share, of which PyTorch would warn
    return converted


def pack_signed_distance(phi: np.ndarray) -> np.ndarray:
    """Signed distance in voxels to int8.

    It is needed between frames only and matters within a few voxels of the interface: 1/16 voxel, up to +-7.9 voxels.
    """
    return SignedDistance.of(phi[None], np.zeros(3), 1.0).phi[0]


def _standing(scene: TrainingScene) -> Standing:
    return standing_about_liquid(scene, make_clean_plates(scene))


@dataclass(frozen=True)
class Sighting:
    """What the masks of `scene` say whatever the grids. silhouettes, container: see `Observations`. coarse: the masks
    as coarse grids need them, smaller where they are large. rim: of the container, where it was looked for. bounds:
    the padded box around all liquid. gravity: unit vector [3], None where it is not known."""

    scene: TrainingScene
    silhouettes: Silhouettes
    coarse: Silhouettes
    container: ContainerOcclusion | None
    rim: Rim | None
    bounds: Bounds
    gravity: np.ndarray | None

    @cached_property
    def jets(self) -> FallingJets | None:
        """The jets of all frames; None where gravity is not known."""
        if self.gravity is None:
            return None
        scene = self.scene
        metres = None if scene.times_source == "nominal" else scene.metres_per_unit
        return falling_jets(
            self.silhouettes, self.coarse, self.bounds, self.container, self.gravity, metres, scene.times
        )

    @cached_property
    def observable(self) -> Observable:
        """The smallest length that the cameras can show."""
        return observable(self.scene, self.silhouettes, self.bounds, self.container)


#: Sightings of one scene with one known container, by what they depend on: for those who trace it on several grids.
Sightings = dict[tuple[Any, ...], Sighting]


def observe(
    scene: TrainingScene,
    settings: FieldSettings,
    run: Run,
    report: Report,
    known: KnownContainer | None = None,
    before: Sightings | None = None,
) -> Observations:
    """Look at the masks of all frames of `scene`. known: its container, where it was looked for already. before: what
    was sighted already, of the same scene and container; to which comes what is sighted now.

    Raises SplashbenchError when the masks have no common hull.
    """
    if known is None:
        footage = partial(_standing, scene) if settings.container_footage else None
        with run.stage("signed distance"):
            known = known_container(scene, settings.container, settings.container_masks, footage)
    gravity = known.gravity
    run.note("container", str(known))
    if gravity is not None:
        run.note(
            "gravity",
            "of the scene" if scene.gravity is not None else f"{known.gravity_from}, {np.round(gravity, 4).tolist()}",
        )
    sighting = _sighting(scene, settings, run, report, known, {} if before is None else before)
    silhouettes, container, rim, bounds = sighting.silhouettes, sighting.container, sighting.rim, sighting.bounds
    if rim is not None:
        run.note("rim", str(rim))
    seen_through = container is not None and not container.hides
    voxel_pixels = settings.clear_voxel_pixels if seen_through else settings.voxel_pixels
    if settings.observable:
        with run.stage("observable length"):
            found = sighting.observable
        wanted = max(settings.observable_share * found.pixels, settings.voxel_pixels, 1e-3)
        run.decide(_grid_decision(found, settings.observable_share, wanted, scene.metres_per_unit))
        voxel_pixels = wanted
    pixel = _pixel(bounds, scene)
    hull_cells, transport_cells = _cells(bounds, pixel, settings, voxel_pixels)
    run.note("grid", f"{hull_cells} cells along the longest side of {bounds.longest_side:.3g}")
    hull_grid, grid = Grid.over(bounds, hull_cells), Grid.over(bounds, transport_cells)
    occlusion = None
    if rim is not None:
        occlusion = rim.occlusion(hull_grid.voxel)
    elif container is not None and container.hides:
        occlusion = LiquidOcclusion(container.mesh, hull_grid.voxel)
    depths = [None if occlusion is None else occlusion.depth(camera) for camera in silhouettes.cameras]
    cues = None
    if gravity is not None and (settings.pool or settings.ballistic):
        report(0.0, "looking for the jet and the pool")
        with run.stage("jet and pool"):
            falling = sighting.jets if settings.ballistic else None
            cues = gravity_cues(silhouettes, container, gravity, depths, settings.pool, falling)
        fall = cues.fall()
        if fall is not None:
            run.note("jet", fall)
    repeated = repeated_frames(scene, silhouettes) if settings.repeats else np.zeros(scene.n_frames, dtype=bool)
    if repeated.any():
        run.note(
            "repeated frames", f"{int(repeated.sum())} of {len(repeated)} timesteps show what the one before shows"
        )
    return Observations(settings, silhouettes, hull_grid, grid, container, occlusion, depths, cues, repeated, pixel)


def _sighting(
    scene: TrainingScene,
    settings: FieldSettings,
    run: Run,
    report: Report,
    known: KnownContainer,
    before: Sightings,
) -> Sighting:
    """That of `scene` by `settings`, from `before` where it is there."""
    report(0.0, "reading masks")
    with run.stage("signed distance"):
        factor = reduction(scene, settings.hull_cells) if settings.signed_distance == "silhouette" else 1
    key = (
        factor, settings.cut_at_rim, settings.detect_failed_masks, settings.replace_empty_masks,
        settings.camera_times, settings.tight_bounds,
    )  # fmt: skip
    if key in before:
        return before[key]
    with run.stage("signed distance"):
        silhouettes = _silhouettes(scene, factor, settings)
        coarse = _coarse(scene, silhouettes, settings)
    container, rim = known.occlusion, None
    if container is not None and container.hides and settings.cut_at_rim:
        report(0.0, "looking where the container's rim ends the liquid")
        with run.stage("rim"):
            rim = rim_of(known, scene, silhouettes.failed_masks)
        container = container.with_mesh(rim.mesh)
    bounds = _bounds(scene, silhouettes, coarse, container, settings, run, report)
    found = before[key] = Sighting(scene, silhouettes, coarse, container, rim, bounds, known.gravity)
    return found


def _silhouettes(scene: TrainingScene | HeldMasks, factor: int, settings: FieldSettings) -> Silhouettes:
    """The masks of `scene`, reduced by `factor`."""
    return Silhouettes(
        ReducedScene(scene, factor) if factor > 1 else scene,
        interpolate_times=None if settings.camera_times else False,
        replace_empty=settings.replace_empty_masks,
    )


def _coarse(scene: TrainingScene, silhouettes: Silhouettes, settings: FieldSettings) -> Silhouettes:
    """`silhouettes` of `scene` as coarse grids need them: distances in masks of millions of pixels took most of the
    look for failed masks. The same where they are small, or where liquid would be lost."""
    held = HeldMasks(scene, silhouettes)
    factor = reduction(held, REFINED_CELLS, _COARSE_PIXELS) if settings.signed_distance == "silhouette" else 1
    if factor == 1:
        return silhouettes
    try:
        coarse = _silhouettes(held, factor, settings)
    except SplashbenchError:  # hardly any liquid is left
        return silhouettes
    return coarse if np.array_equal(coarse.sees_liquid, silhouettes.sees_liquid) else silhouettes


def _grid_decision(found: Observable, share: float, wanted: float, metres: float | None) -> Decision:
    """What the smallest length that the cameras can show is made of, and the hull's voxels that follow from it."""

    def length(pixels: float) -> str:
        size = pixels * found.pixel
        unit = f"{1000 * metres * size:.2f} mm" if metres is not None else f"{size:.3g} scene units"
        return f"{pixels:.2f} px, {unit}"

    edge = "is not told by the photographs" if found.edge is None else f"is {found.edge:.2f} px wide"
    terms = {
        "pixel": (1.0, "what a pixel spans at the liquid"),
        "edge": (found.edge or 0.0, f"the liquid's edge in the photographs {edge}"),
        "disagreement": (found.disagreement, "width of the rim of masks that the other views do not allow"),
        "all together": (found.pixels, f"{length(found.pixels)}; views differ by up to {found.angle:.0f} degrees"),
    }
    return Decision(
        name="hull voxel",
        basis="scene",
        chosen=length(wanted),
        because=f"{share:g} of the smallest length that the cameras can show, or voxel_pixels if larger",
        rungs=[
            Rung(value=f"{name}: {pixels:.2f} px", bought=True, reason=reason)
            for name, (pixels, reason) in terms.items()
        ],
    )


def _pixel(bounds: Bounds, scene: TrainingScene) -> float | None:
    """What a pixel spans in the middle of the bounds, scene units, in the median of the views before which they lie."""
    middle = (bounds.low + bounds.high) / 2
    spans = []
    for camera in (scene.cameras[name] for name in scene.train):
        depth = float((camera.w2c[2, :3] @ middle) + camera.w2c[2, 3])
        if depth > 0:
            spans.append(depth / focal_length(camera))
    return float(np.median(spans)) if spans else None


def _cells(bounds: Bounds, pixel: float | None, settings: FieldSettings, voxel_pixels: float) -> tuple[int, int]:
    """Cells of the hull grid and of the transport grid along the longest side, as the photographs need them."""
    if voxel_pixels == 0 or pixel is None:
        return settings.hull_cells, settings.transport_cells
    needed = bounds.longest_side / (voxel_pixels * pixel)
    share = min(1.0, max(needed, min(settings.fewest_cells, settings.hull_cells)) / settings.hull_cells)
    # The transport grid first, so that its voxels stay the same number of the hull's.
    transport = max(2, round(share * settings.transport_cells))
    return round(transport * settings.hull_cells / settings.transport_cells), transport


def _bounds(
    scene: TrainingScene,
    silhouettes: Silhouettes,
    coarse: Silhouettes,
    container: ContainerOcclusion | None,
    settings: FieldSettings,
    run: Run,
    report: Report,
) -> Bounds:
    """The padded box around all liquid. Failed masks are looked for first, and distrusted from then on. coarse: see
    `Sighting`."""

    def find() -> tuple[np.ndarray, Bounds]:
        if settings.detect_failed_masks:
            report(0.0, "looking for failed masks")
            with run.stage("failed masks"):
                bounds = trusted_bounds(coarse, container)
        else:
            with run.stage("signed distance"):
                bounds = sequence_bounds(coarse, container, settings.tight_bounds)
        return coarse.failed_masks, bounds.padded(PADDING)

    def save(result: tuple[np.ndarray, Bounds], directory: Path) -> None:
        failed, bounds = result
        np.savez(directory / "bounds.npz", failed=failed, low=bounds.low, high=bounds.high)

    def load(directory: Path) -> tuple[np.ndarray, Bounds]:
        with np.load(directory / "bounds.npz") as stored:
            return stored["failed"], Bounds(stored["low"], stored["high"])

    failed, bounds = run.reuse("bounds", scene, settings.key(), find, save, load, seeded=False)
    for masks in (silhouettes, coarse):
        masks.distrust(failed)
    return bounds

"""What the masks say of the liquid, frame by frame: phi_t, and the motion between frames (paper, "Observation fields").

The runs of one study share them (`Run.reuse`): they are most of a short fit, and its rows seldom differ in them.
"""

from __future__ import annotations

import shutil
import tempfile
from collections.abc import Callable, Iterator
from dataclasses import asdict
from pathlib import Path
from typing import IO, Any

import numpy as np

from splashbench.harness.contract import Run
from splashbench.observe import Grid, Silhouettes, sequence_bounds, signed_distance_frames
from splashbench.observe.failures import distrust_failed_masks
from splashbench.observe.grid import Bounds
from splashbench.observe.kernels import resample
from splashbench.observe.occlusion import ContainerShadow
from splashbench.observe.reduced_masks import reduced
from splashbench.observe.signed_distance import PADDING
from splashbench.scene.scene import TrainingScene

from ..appearance.occlusion import Occlusion
from ..appearance.visibility import seen_by_any
from ..model import pack_phi
from ..motion.gate import gated
from ..motion.step import Fall, Motion
from ..motion.velocity import control_shape, fit_velocity
from ..settings import SplashSplatConfig
from .survey import Survey, survey

Report = Callable[[float, str], None]

# A carrier is seen through at most this many shells of liquid.
SEEN_THROUGH = 1.5
# Raised when a change alters what is kept for other runs, so that no study takes over what is from before.
_REVISION = 2
# The settings that phi_t depends on.
_PHI = ("hull_cells", "distance", "container", "detect_failures", "camera_times", "pool", "ballistic")
_FILE = "phi.float16"
_COPIED_AT_ONCE = 1 << 22
# Parts of the progress where a study keeps them.
_DISTANCES_DONE, _VELOCITIES_DONE = 0.5, 0.9


class Observations:
    """phi_t of one frame after another, and on the way the motion between them; two frames in memory at a time.

    Iterating yields phi_t on `hull_grid`, float32 in transport voxels. By the time phi_t is yielded, step t - 1 of
    `motion` and packed[t] (int8, see `pack_phi`) are filled in.
    """

    def __init__(self, scene: TrainingScene, config: SplashSplatConfig, run: Run, report: Report) -> None:
        self._scene, self._config, self._run, self._report = scene, config, run, report
        self._key: dict[str, Any] = {"observations": _REVISION, **config.model_dump(mode="json", include=set(_PHI))}
        self._times = scene.times
        self.n_frames = scene.n_frames
        report(0.0, "reading masks")
        with run.stage("signed distance"):
            observed = reduced(scene, config.hull_cells) if config.distance == "silhouette" else scene
            self.silhouettes = Silhouettes(observed, interpolate_times=None if config.camera_times else False)
            self._container = ContainerShadow.of(scene) if config.container else None
        bounds = self._bounds()
        self.hull_grid, self.grid = Grid.over(bounds, config.hull_cells), Grid.over(bounds, config.transport_cells)
        #: what the container hides, where it does
        self.occlusion: Occlusion | None = None
        if self._container is not None and self._container.hides:
            self.occlusion = Occlusion(self._container.mesh, self.hull_grid.voxel)
        cameras = self.silhouettes.cameras
        self._shadows = [None if self.occlusion is None else self.occlusion.depth(camera) for camera in cameras]
        self._survey: Survey | None = None
        if scene.gravity is not None and (config.pool or config.ballistic):
            report(0.0, "looking for the jet and the pool")
            with run.stage("survey"):
                self._survey = survey(
                    self.silhouettes,
                    bounds,
                    self._container,
                    scene.gravity,
                    None if scene.times_source == "nominal" else scene.metres_per_unit,
                    scene.times,
                    self._shadows,
                    find_pool=config.pool,
                    find_jets=config.ballistic,
                )
        control = control_shape(self.grid.shape, config.control_factor)
        velocities = np.zeros((self.n_frames - 1, *control, 3), dtype=np.float32)
        self.motion = Motion(velocities, config.control_factor, [self._fall(t) for t in range(self.n_frames - 1)])
        self.packed = np.zeros((self.n_frames, *self.grid.shape), dtype=np.int8)

    def __iter__(self) -> Iterator[np.ndarray]:
        if self._run.cache is None:
            yield from self._followed(self._frames(), self._moves)
            return
        with self._stored() as stream:
            if self._moves:
                self.motion.velocities[:] = self._shared_velocities(stream)
            yield from self._followed(self._read(stream), fit_motion=False, start=_VELOCITIES_DONE)

    def _followed(self, frames: Iterator[np.ndarray], fit_motion: bool, start: float = 0.0) -> Iterator[np.ndarray]:
        """phi_t of `frames`, with what follows from it. start: the part of the progress that lies behind."""
        before: np.ndarray | None = None
        for t, phi in enumerate(frames):
            with self._run.stage("signed distance"):
                phi, now = self._in_transport_voxels(phi)
                self.packed[t] = pack_phi(now)
            if fit_motion and before is not None:
                self.motion.velocities[t - 1] = self._fitted(before, now)
            before = now
            with self._run.stage("carriers"):  # what is done with phi until the next is asked for
                yield phi
            what = "signed distance, velocity, carriers" if fit_motion else "carriers"
            self._report(start + (1 - start) * (t + 1) / self.n_frames, what)

    @property
    def _moves(self) -> bool:
        return self._config.variant != "per_frame"

    def landed(self, t: int, start: np.ndarray, end: np.ndarray) -> np.ndarray:
        """Where carriers that fly from `start` to `end` [N, 3] (transport grid) come to rest in frame `t`."""
        return end if self._survey is None else self._survey.landed(self.grid, t, start, end)

    def seen(self, phi: np.ndarray, points: np.ndarray) -> np.ndarray:
        """Which hull-grid coordinates `points` [N, 3] the training views see in phi (transport voxels): bool [N]."""
        ratio = self.grid.voxel / self.hull_grid.voxel
        limit = SEEN_THROUGH * self._config.shell_depth * ratio
        return seen_by_any(phi, self.hull_grid, points, self.silhouettes.cameras, self._shadows, limit, ratio)

    def _bounds(self) -> Bounds:
        """The padded box around all liquid. Failed masks are found on the way, and distrusted from then on."""

        def find() -> tuple[np.ndarray, Bounds]:
            if self._config.detect_failures:
                self._report(0.0, "looking for failed masks")
                with self._run.stage("failed masks"):
                    distrust_failed_masks(self.silhouettes, self._container)
            with self._run.stage("signed distance"):
                bounds = sequence_bounds(self.silhouettes, self._container).padded(PADDING)
            return self.silhouettes.failed_masks, bounds

        def save(found: tuple[np.ndarray, Bounds], directory: Path) -> None:
            failed, bounds = found
            np.savez(directory / "bounds.npz", failed=failed, low=bounds.low, high=bounds.high)

        def load(directory: Path) -> tuple[np.ndarray, Bounds]:
            with np.load(directory / "bounds.npz") as stored:
                return stored["failed"], Bounds(stored["low"], stored["high"])

        failed, bounds = self._run.reuse("bounds", self._scene, self._key, find, save, load, seeded=False)
        self.silhouettes.distrust(failed)
        return bounds

    def _frames(self) -> Iterator[np.ndarray]:
        """phi_t on `hull_grid`, in its voxels. At half precision, which is a thousandth of a voxel near the surface, in
        every run: what is kept for other runs takes half the room, and is what they would compute."""
        method = self._config.distance
        frames = signed_distance_frames(self.silhouettes, self.hull_grid, method, self._container)
        for t in range(self.n_frames):
            with self._run.stage("signed distance"):
                phi = next(frames)
                if self._survey is not None:
                    phi = self._survey.refined(phi, self.hull_grid, t)
                phi = phi.astype(np.float16)
            yield phi

    def _stored(self) -> IO[bytes]:
        """`_frames` one after another in a file that the study keeps, float16."""

        kept: list[IO[bytes]] = []

        def write() -> IO[bytes]:
            # Nameless: of a run that is killed nothing stays behind.
            stream = tempfile.TemporaryFile(dir=self._run.cache)  # noqa: SIM115
            try:
                for t, phi in enumerate(self._frames()):
                    stream.write(phi.tobytes())
                    self._report(_DISTANCES_DONE * (t + 1) / self.n_frames, "signed distance")
            except BaseException:
                stream.close()
                raise
            return stream

        def save(stream: IO[bytes], directory: Path) -> None:
            with stream, (directory / _FILE).open("wb") as copy:
                stream.seek(0)
                shutil.copyfileobj(stream, copy, _COPIED_AT_ONCE)
            kept.append((directory / _FILE).open("rb"))  # read from here on, so that there are not two of them for long

        def load(directory: Path) -> IO[bytes]:
            return (directory / _FILE).open("rb")

        found = self._run.reuse("distances", self._scene, self._key, write, save, load, seeded=False)
        return kept[0] if kept else found

    def _read(self, stream: IO[bytes]) -> Iterator[np.ndarray]:
        """`_frames` as `_stored` has them, one in memory at a time."""
        shape = self.hull_grid.shape
        stream.seek(0)
        for _ in range(self.n_frames):
            yield np.frombuffer(stream.read(2 * int(np.prod(shape))), np.float16).reshape(shape)

    def _in_transport_voxels(self, phi: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """`phi` of `_frames` as float32 in transport voxels, on the hull grid and on the transport grid."""
        ratio = self.grid.voxel / self.hull_grid.voxel
        phi = phi.astype(np.float32) / np.float32(ratio)
        return phi, resample(phi, self.grid.shape, ratio)

    def _shared_velocities(self, stream: IO[bytes]) -> np.ndarray:
        """u of all steps from the phi_t of `stream`, float32 [T - 1, cx, cy, cz, 3] voxels per frame."""
        config = self._config

        def fit() -> np.ndarray:
            velocities = np.zeros_like(self.motion.velocities)
            before: np.ndarray | None = None
            for t, phi in enumerate(self._read(stream)):
                _, now = self._in_transport_voxels(phi)
                if before is not None:
                    velocities[t - 1] = self._fitted(before, now)
                before = now
                done = (t + 1) / self.n_frames
                self._report(_DISTANCES_DONE + (_VELOCITIES_DONE - _DISTANCES_DONE) * done, "velocity")
            return velocities

        key = {
            **self._key,
            **config.model_dump(mode="json", include={"transport_cells", "control_cells", "gate_motion"}),
            "velocity": asdict(config.velocity),
        }

        def save(velocities: np.ndarray, directory: Path) -> None:
            np.save(directory / "velocities.npy", velocities)

        def load(directory: Path) -> np.ndarray:
            return np.load(directory / "velocities.npy")

        return self._run.reuse("velocities", self._scene, key, fit, save, load, seeded=False)

    def _fitted(self, before: np.ndarray, after: np.ndarray) -> np.ndarray:
        """u_t on the control grid, voxels per frame."""
        config, factor = self._config, self._config.control_factor
        with self._run.stage("velocity"):
            control = fit_velocity(before, after, factor, config.velocity).control
            return gated(control, factor, before, after) if config.gate_motion else control

    def _fall(self, t: int) -> Fall | None:
        """The jet's, from frame `t` to the next."""
        found = self._survey
        if found is None or (jet := found.jets[t]) is None or not self._moves:
            return None
        return Fall(jet, found.jet_floor(t), found.turn, self.grid, float(self._times[t + 1] - self._times[t]))

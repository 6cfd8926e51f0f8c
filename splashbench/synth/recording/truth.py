"""The ground truth of a synthetic session: `truth/truth.json` (conventions in `TruthFile`) and what lies beside it."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel, ConfigDict

from splashbench.files import read_model, read_npz
from splashbench.synth.imaging.lens import LensCamera

Array = NDArray[np.float64]
Matrix = list[list[float]]


class _TruthTable(BaseModel):
    model_config = ConfigDict(extra="forbid")


class TruthLens(_TruthTable):
    """`K` in pixels with pixel centres at +0.5; `distortion` k1, k2, p1, p2, k3 (Brown-Conrady, OpenCV's order)."""

    width: int
    height: int
    K: Matrix
    distortion: list[float]


class TruthCamera(TruthLens):
    """Adds the pose (world-to-camera, OpenCV axes, metres, y up) and clock: t_common = start_s + clock_rate * local."""

    w2c: Matrix
    start_s: float
    clock_rate: float
    fps: float

    def camera(self) -> LensCamera:
        """As a camera that can project points."""
        return LensCamera(self.width, self.height, np.array(self.K), np.array(self.distortion), np.array(self.w2c))


class TruthSound(_TruthTable):
    """When the clap sounds (common time, seconds), and where the sounds come from (world, metres)."""

    clap_time_s: float
    clap_position: list[float]
    pour_position: list[float]


class TruthPour(_TruthTable):
    """The common time, in seconds, at which liquid comes into view, and at which the simulated motion ends."""

    start_s: float
    end_s: float


class TruthFile(_TruthTable):
    """truth/truth.json. Common time is the local time of the camera `reference`."""

    schema_version: int
    reference: str
    cameras: dict[str, TruthCamera]
    sweep: TruthLens
    sound: TruthSound
    gravity: list[float]
    pour: TruthPour
    board_pose: Matrix
    seed: int


class Truth:
    """The truth of the session in `session`. Raises SplashbenchError where it has none."""

    def __init__(self, session: Path) -> None:
        self.directory = Path(session) / "truth"
        self.file = read_model(self.directory / "truth.json", TruthFile)

    def mask_path(self, camera: str, source_frame: int) -> Path:
        """The true mask of a frame of the raw recording; frames without liquid have none."""
        return self.directory / "masks" / camera / f"{source_frame:06d}.png"

    def particles_at(self, times: Array) -> tuple[NDArray[np.float32], NDArray[np.float32], NDArray[np.bool_]]:
        """Positions [T, N, 3], velocities [T, N, 3] (world, metres) and existence [T, N] at common `times` [T].

        Between the stored instants a particle follows the cubic Hermite curve of its positions and velocities.
        """
        stored = read_npz(self.directory / "particles.npz", {"positions": 3, "active": 2, "velocities": 3, "times": 1})
        grid, step = stored["times"], stored["times"][1] - stored["times"][0]
        at = np.clip((np.asarray(times, np.float64) - grid[0]) / step, 0, len(grid) - 1)
        before = np.minimum(at.astype(int), len(grid) - 2)
        s = (at - before).astype(np.float32)[:, None, None]
        x0, x1 = stored["positions"][before], stored["positions"][before + 1]
        v0, v1 = stored["velocities"][before], stored["velocities"][before + 1]
        h = np.float32(step)
        positions = (2 * s**3 - 3 * s**2 + 1) * x0 + (3 * s**2 - 2 * s**3) * x1
        positions += h * ((s**3 - 2 * s**2 + s) * v0 + (s**3 - s**2) * v1)
        velocities = (6 * s**2 - 6 * s) / h * (x0 - x1) + (3 * s**2 - 4 * s + 1) * v0 + (3 * s**2 - 2 * s) * v1
        # A particle that is about to appear or to leave is there at the one instant only: no curve to follow.
        first, second = stored["active"][before], stored["active"][before + 1]
        outside = np.asarray(times) < grid[0]
        active = np.where(s[..., 0] < 0.5, first, second) & ~outside[:, None]
        lone = (first ^ second)[..., None]
        positions = np.where(lone & first[..., None], x0 + s * h * v0, positions)
        positions = np.where(lone & second[..., None], x1 - (1 - s) * h * v1, positions)
        velocities = np.where(lone & first[..., None], v0, np.where(lone, v1, velocities))
        return positions, velocities, active

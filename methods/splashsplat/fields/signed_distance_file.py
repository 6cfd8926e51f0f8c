"""phi_t of all frames in one file that the runs of a study share: one frame in memory at a time."""

from __future__ import annotations

import shutil
import tempfile
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import IO

import numpy as np

from splashbench.harness.contract import Run
from splashbench.scene.scene import TrainingScene

from .observations import Observations, Report

_FILE = "phi.float16"
_COPIED_AT_ONCE = 1 << 22


@dataclass(frozen=True)
class SignedDistanceFile:
    """Frames of float16 in `stream`, one after another; each of `shape`. Iterating starts at the first."""

    stream: IO[bytes]
    shape: tuple[int, int, int]
    n_frames: int

    def __iter__(self) -> Iterator[np.ndarray]:
        self.stream.seek(0)
        for _ in range(self.n_frames):
            yield np.frombuffer(self.stream.read(2 * int(np.prod(self.shape))), np.float16).reshape(self.shape)

    def __enter__(self) -> SignedDistanceFile:
        return self

    def __exit__(self, *_: object) -> None:
        self.stream.close()


def shared_signed_distances(
    observations: Observations, scene: TrainingScene, run: Run, report: Report
) -> SignedDistanceFile:
    """`Observations.signed_distances` in a file of the study's cache, computed now or by an earlier run."""
    stored: list[IO[bytes]] = []

    def write() -> IO[bytes]:
        # Nameless: of a run that is killed nothing stays behind.
        stream = tempfile.TemporaryFile(dir=run.cache)  # noqa: SIM115
        try:
            for t, phi in enumerate(observations.signed_distances(run)):
                stream.write(phi.tobytes())
                report((t + 1) / observations.n_frames, "signed distance")
        except BaseException:
            stream.close()
            raise
        return stream

    def save(stream: IO[bytes], directory: Path) -> None:
        with stream, (directory / _FILE).open("wb") as copy:
            stream.seek(0)
            shutil.copyfileobj(stream, copy, _COPIED_AT_ONCE)
        # Read from here on, so that there are not two copies for long.
        stored.append((directory / _FILE).open("rb"))

    def load(directory: Path) -> IO[bytes]:
        return (directory / _FILE).open("rb")

    stream = run.reuse("distances", scene, observations.settings.key(), write, save, load, seeded=False)
    return SignedDistanceFile(stored[0] if stored else stream, observations.hull_grid.shape, observations.n_frames)

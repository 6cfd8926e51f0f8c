"""What scenes exist: the 20 real ones with Table S1's facts, the archive that holds them, figures to reach.

The release itself carries no timestamps; `load_scenes()["bowl_001"].times()` is where they come from when a scene
has no `scene.json`. The tables are data files beside this module and install with it. README.md names the source of
each column and the statements of the paper that contradict one another.
"""

from __future__ import annotations

import csv
from functools import cache
from importlib.resources import files
from typing import Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel, ConfigDict, Field

__all__ = [
    "Archive",
    "ArchiveEntry",
    "DatasetFacts",
    "Evaluation",
    "NeuroFluidSource",
    "SceneFacts",
    "Target",
    "load_archive",
    "load_comparison",
    "load_evaluation",
    "load_neurofluid",
    "load_scenes",
    "load_targets",
]


class _Record(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True)


class SceneFacts(_Record):
    """One row of Table S1.

    Attributes:
        name: the scene's folder name, such as "bowl_001".
        container: what the liquid is poured into.
        session: the recording session; null for every scene, since the paper does not say which scenes share one.
        interval_s: wall-clock span from the first timestep to the last, seconds.
        mean_step_ms: mean spacing of the timesteps, milliseconds.
        sync_rms_ms: RMS over the seven cameras of their offsets about the mean, milliseconds, measured within the
            sequence by GCC-PHAT.
        fewer_than_seven_measured: (dagger) the offset of at least one camera could not be measured.
        camera_a_frame_off: (double dagger) one camera is a full source frame or more from the reference.
    """

    name: str
    container: Literal["bowl", "tank"]
    session: str | None
    interval_s: float = Field(gt=0)
    mean_step_ms: float = Field(gt=0)
    sync_rms_ms: float = Field(ge=0)
    fewer_than_seven_measured: bool
    camera_a_frame_off: bool

    def times(self, n_frames: int = 50) -> NDArray[np.float64]:
        """Seconds since the first timestep, [n_frames], evenly spaced by the mean step.

        True gaps alternate about the mean by up to half a source frame (8.3 ms) and the release does not give them.
        The step, known to 0.05 ms, is used rather than the interval, known to 5 ms: over 49 steps it errs by half as
        much. Raises ValueError for a negative `n_frames`.
        """
        if n_frames < 0:
            raise ValueError(f"n_frames is {n_frames}; it cannot be negative")
        return np.arange(n_frames, dtype=np.float64) * (self.mean_step_ms / 1000.0)


class Evaluation(_Record):
    """What every real scene has in common, and how the paper scores it (Sections 3 and 5, supplement)."""

    schema_version: Literal[1]
    source: str
    train_cameras: tuple[str, ...]
    test_cameras: tuple[str, ...]
    n_frames: int
    width: int
    height: int
    source_fps: float
    test_view_angle_degrees: tuple[float, float]
    arc_degrees: float
    scored_variant: str
    crop: str
    crop_padding_px: int
    crop_multiple_px: int
    mean_crop_size: tuple[int, int]


class ArchiveEntry(_Record):
    """One kind of file in the released archive."""

    path: str
    what: str


class Archive(_Record):
    """The released archive: where it is, under which licence, and what lies in it.

    `bytes` and `sha256` are null because the authors publish neither; `checksum_note` says so for a user to read.
    """

    schema_version: Literal[1]
    name: str
    drive_file_id: str
    url: str
    repository: str
    license: str
    attribution: str
    bytes: int | None
    sha256: str | None = Field(pattern=r"^[0-9a-f]{64}$")
    checksum_note: str
    scene_folders: tuple[str, ...]
    layout: tuple[ArchiveEntry, ...]


class NeuroFluidSource(_Record):
    """Where the authors of NeuroFluid put their synthetic scenes, and which of them the paper scores or names.

    `license` is null because the authors state none.
    """

    schema_version: Literal[1]
    name: str
    drive_folder_id: str
    url: str
    repository: str
    license: str | None
    attribution: str
    checksum_note: str
    scenes: tuple[str, ...]


class DatasetFacts(_Record):
    """One row of Table 1, the comparison of fluid datasets; null means not applicable or not reported there."""

    dataset: str
    source: Literal["real", "synthetic"]
    medium: Literal["smoke", "liquid"]
    scenes: int | None
    images: int | None
    views: int
    views_note: str | None
    synchronized: bool | None
    width: int | None
    height: int | None
    fps: float | None
    dynamics: str
    liquid_masks: bool


class Target(_Record):
    """A figure of the paper to reach: SplashSplat's own and the best of its three baselines, in the paper's units."""

    scene_set: str
    metric: str
    unit: str | None
    higher_is_better: bool
    splashsplat: float
    best_baseline: float | None
    best_baseline_method: str | None
    source: str


def _text(name: str) -> str:
    return files("splashbench_data_manifest").joinpath(name).read_text(encoding="utf-8")


def _rows(name: str) -> list[dict[str, str | None]]:
    """The rows of a CSV file of this package; an empty cell is None."""
    return [{key: cell or None for key, cell in row.items()} for row in csv.DictReader(_text(name).splitlines())]


def load_scenes() -> dict[str, SceneFacts]:
    """The 20 real scenes by name, in the order of Table S1."""
    scenes = (SceneFacts.model_validate(row) for row in _rows("scenes.csv"))
    return {scene.name: scene for scene in scenes}


def load_evaluation() -> Evaluation:
    """The split, the size and the crop that all real scenes share."""
    return Evaluation.model_validate_json(_text("evaluation.json"))


def load_archive() -> Archive:
    """Where the released archive is and what it holds."""
    return Archive.model_validate_json(_text("archive.json"))


@cache
def load_neurofluid() -> NeuroFluidSource:
    """Where NeuroFluid's scenes are, and their names."""
    return NeuroFluidSource.model_validate_json(_text("neurofluid.json"))


def load_comparison() -> list[DatasetFacts]:
    """Table 1: this dataset beside seven others."""
    return [DatasetFacts.model_validate(row) for row in _rows("dataset_comparison.csv")]


def load_targets() -> list[Target]:
    """The paper's figures to reach, one for each set of scenes and metric."""
    return [Target.model_validate(row) for row in _rows("targets.csv")]

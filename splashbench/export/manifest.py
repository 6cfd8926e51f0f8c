"""manifest.json of an export: what its files are of, when, and in which units; and the folder that they are written to.

The files of single instants lie in frames/, apart from the manifest: viewers of sequences take a folder for one only
where it holds nothing else.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel, ConfigDict

from splashbench.errors import SplashbenchError
from splashbench.export.placement import Placement, Up
from splashbench.files import atomic_directory, require_unsealed_place, write_model
from splashbench.replay import Reconstruction
from splashbench.version import __version__

#: The file by which an export is recognised.
MANIFEST = "manifest.json"
Format = Literal["ply", "mesh", "particles", "velocity", "nerfstudio"]


class Source(BaseModel):
    """What was exported. digest: SHA-256 of the submission's SHA256SUMS, which names its exact bytes."""

    model_config = ConfigDict(extra="forbid")
    method: str
    method_version: str
    preset: str
    seed: int
    scene: str
    digest: str


class Manifest(BaseModel):
    """manifest.json.

    times: seconds of each frame on the scene's clock; times_source "nominal" means an order, not seconds. files: of all
    frames in their order, or those that hold all of them. up: "scene" where the axes are the scene's own.
    scene_to_export: [4, 4], which takes the scene's places to the files'. options: of the format, as asked for, and
    background_color of Gaussians. counts: of each frame, what the format counts. notes: what the files lack.
    """

    model_config = ConfigDict(extra="forbid")
    schema_version: Literal[1] = 1
    splashbench_version: str
    format: Format
    submission: Source
    times: list[float]
    times_source: str
    files: list[str]
    units: Literal["scene units", "metres"]
    metres_per_unit: float | None
    up: Up | Literal["scene"]
    scene_to_export: list[list[float]]
    options: dict[str, Any]
    counts: dict[str, list[int]]
    notes: list[str]


@contextmanager
def export_folder(reconstruction: Reconstruction, out: Path | str, replace: bool) -> Iterator[Path]:
    """Yield a folder to write into; success makes it `out`, failure leaves nothing.

    Raises SplashbenchError where `out` holds something else than an earlier export, or lies in a submission.
    """
    out, submission = Path(out), reconstruction.submission.directory
    require_unsealed_place(out)
    inputs = [submission, *([reconstruction.scene.directory] if reconstruction.scene else [])]
    with atomic_directory(out, replace, holds=MANIFEST, keys=Manifest.model_fields, inputs=inputs) as staging:
        yield staging


def frame_files(count: int, ending: str) -> list[str]:
    """Names of the files of `count` instants, relative to the export: frames/frame0001.ply and so on."""
    digits = max(4, len(str(count)))
    return [f"frames/frame{number:0{digits}d}.{ending}" for number in range(1, count + 1)]


def write_manifest(
    directory: Path,
    reconstruction: Reconstruction,
    format_name: Format,
    times: NDArray[np.float64],
    placement: Placement,
    files: Sequence[str],
    *,
    options: dict[str, Any] | None = None,
    counts: dict[str, list[int]] | None = None,
    notes: Sequence[str] = (),
) -> Manifest:
    """Write manifest.json into `directory`; arguments as the fields of Manifest."""
    identity = reconstruction.submission.identity
    order = ["the scene has no timestamps; times are an order, not seconds"]
    manifest = Manifest(
        splashbench_version=__version__,
        format=format_name,
        submission=Source(
            **identity.model_dump(include={"method", "method_version", "preset", "seed", "scene"}),
            digest=reconstruction.submission.digest,
        ),
        times=times.tolist(),
        times_source=reconstruction.times_source,
        files=list(files),
        units=placement.units,
        metres_per_unit=reconstruction.metres_per_unit,
        up=placement.up or "scene",
        scene_to_export=placement.matrix.tolist(),
        options=options or {},
        counts=counts or {},
        notes=[*notes, *(order if reconstruction.times_source == "nominal" else [])],
    )
    write_model(directory / MANIFEST, manifest)
    return manifest


def nothing_of(reconstruction: Reconstruction, what: str, instead: str) -> SplashbenchError:
    """The error for a submission that has no `what`; `instead` says what to export."""
    directory, name = reconstruction.submission.directory, reconstruction.name
    if reconstruction.has_model:
        return SplashbenchError(f"{directory} has no {what}: method {name} hands out none; {instead}")
    if (directory / "model").is_dir():
        cause = f"method {name} is not installed here; install it, or name it by --method FILE.py:CLASS"
    else:
        cause = f"it keeps no model of {name} to ask; {instead}"
    return SplashbenchError(f"{directory} has no {what}: {cause}")

"""A method's velocity field on its grid, all instants in one .npz.

A long recording's field is larger than memory may be, so that it is written instant by instant.
"""

from __future__ import annotations

import zipfile
from pathlib import Path
from typing import IO

import numpy as np
from numpy.typing import NDArray

from splashbench.errors import SplashbenchError
from splashbench.export.instants import all_or
from splashbench.export.manifest import Manifest, export_folder, nothing_of, write_manifest
from splashbench.export.placement import Placement
from splashbench.files import atomic_path
from splashbench.progress import track
from splashbench.replay import Reconstruction
from splashbench.scene import VelocityField

VELOCITY = "velocity.npz"
# zlib's fastest: the slower levels gain a few hundredths.
_LEVEL = 1


def export_velocity(
    reconstruction: Reconstruction,
    out: Path | str,
    times: NDArray[np.float64] | None = None,
    placement: Placement | None = None,
    *,
    replace: bool = False,
) -> Manifest:
    """Write velocity.npz into the folder `out`: the field at each of `times` [F] (seconds; all timesteps by default).

    times [F]; values [F, nx, ny, nz, 3] float32, units per second; liquid [F, nx, ny, nz] bool, outside which values
    mean nothing; origin [3] and axes [3, 3]: node (i, j, k) lies at `origin + (i, j, k) @ axes`; spacing [3], the
    lengths of the axes. placement: units and axes of it all, the scene's own by default.

    Raises SplashbenchError for a method without a velocity field, for a grid that changes, for values that are not
    finite, and for places that are taken.
    """
    instants, placed = all_or(reconstruction, times), placement or Placement()
    first = _field(reconstruction, float(instants[0]), None)
    liquid: list[NDArray[np.bool_]] = []
    with export_folder(reconstruction, out, replace) as staging:
        path = staging / VELOCITY
        with (
            atomic_path(path) as temporary,
            zipfile.ZipFile(temporary, "w", zipfile.ZIP_DEFLATED, compresslevel=_LEVEL) as archive,
        ):
            with archive.open("values.npy", "w", force_zip64=True) as stream:
                _write_header(stream, (len(instants), *first.values.shape), np.dtype("<f4"))
                for time in track(instants, "exporting velocities", total=len(instants)):
                    field = _field(reconstruction, float(time), first)
                    stream.write(placed.points(field.values).astype("<f4").tobytes())
                    liquid.append(field.liquid)
            others = {
                "liquid": np.stack(liquid),
                "times": instants,
                "origin": placed.points(first.origin),
                "spacing": first.spacing * placed.scale,
                "axes": placed.points(np.diag(first.spacing)),
            }
            for name, array in others.items():
                with archive.open(f"{name}.npy", "w", force_zip64=True) as stream:
                    np.lib.format.write_array(stream, np.ascontiguousarray(array), allow_pickle=False)
        counts = {"nodes": [int(np.prod(first.liquid.shape))] * len(instants)}
        counts["liquid_nodes"] = [int(inside.sum()) for inside in liquid]
        return write_manifest(staging, reconstruction, "velocity", instants, placed, [VELOCITY], counts=counts)


def _field(reconstruction: Reconstruction, time: float, like: VelocityField | None) -> VelocityField:
    """The field at `time`, on the grid of `like`."""
    directory, name = reconstruction.submission.directory, reconstruction.name
    field = reconstruction.velocity(time)
    if field is None:
        raise nothing_of(reconstruction, "velocity field", "its particles may have velocities (--format particles)")
    if not np.isfinite(field.values).all():
        raise SplashbenchError(f"{directory}: velocities of method {name} are not finite; fit again")
    if like is not None and not (
        field.values.shape == like.values.shape
        and np.array_equal(field.origin, like.origin)
        and np.array_equal(field.spacing, like.spacing)
    ):
        raise SplashbenchError(
            f"{directory}: the grid of {name}'s velocities changes over time; export single instants (--times)"
        )
    return field


def _write_header(stream: IO[bytes], shape: tuple[int, ...], kind: np.dtype) -> None:
    """The header of a .npy file whose data follow."""
    facts = {"descr": np.lib.format.dtype_to_descr(kind), "fortran_order": False, "shape": shape}
    np.lib.format.write_array_header_1_0(stream, facts)

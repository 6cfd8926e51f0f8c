"""One .ply file of 3D Gaussians, with the properties of the published code (Kerbl et al. 2023).

x y z, nx ny nz (zero), f_dc_* and f_rest_* (spherical harmonics, all of red first), opacity as a logit, scale_* as
logarithms of standard deviations, rot_* as a quaternion w x y z; binary, little endian.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from splashbench.export.coloured import Coloured
from splashbench.files.ply import write_vertices

# A logit of 1 is infinite; viewers clamp at .99 to .999.
_FULLEST = 1 - 1e-6
# Thinnest axis, of the Gaussian's longest, and the least length of any: logarithms have to be finite.
_THINNEST, _SHORTEST = 1e-6, 1e-12


def write_gaussians(path: Path, groups: Sequence[Coloured]) -> None:
    """Write the Gaussians of all `groups`, whose colours are of one degree, atomically."""
    tables = [_tables(group) for group in groups]
    write_vertices(path, {names: np.concatenate([each[names] for each in tables]) for names in tables[0]})


def _tables(group: Coloured) -> dict[tuple[str, ...], NDArray[np.float32]]:
    """Names of properties -> their values [N, number of names]."""
    gaussians, n = group.gaussians, len(group)
    rest = group.coefficients[:, 1:].transpose(0, 2, 1).reshape(n, 3 * (group.coefficients.shape[1] - 1))
    deviations, quaternions = gaussians.axes()
    longest = deviations.max(axis=1, initial=0.0, keepdims=True)
    scales = np.log(np.maximum(deviations, np.maximum(_THINNEST * longest, _SHORTEST)))
    opacities = np.minimum(gaussians.opacities.astype(np.float64), _FULLEST)[:, None]
    return {
        ("x", "y", "z"): gaussians.means,
        ("nx", "ny", "nz"): np.zeros((n, 3), np.float32),
        ("f_dc_0", "f_dc_1", "f_dc_2"): group.coefficients[:, 0],
        tuple(f"f_rest_{i}" for i in range(rest.shape[1])): rest,
        ("opacity",): np.log(opacities / (1 - opacities)).astype(np.float32),
        ("scale_0", "scale_1", "scale_2"): scales.astype(np.float32),
        ("rot_0", "rot_1", "rot_2", "rot_3"): quaternions,
    }

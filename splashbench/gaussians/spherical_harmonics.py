"""View-dependent colour by real spherical harmonics to degree 3 (Kerbl et al. 2023, Sec. 4).

Signs and order are those that the published point clouds of 3D Gaussian splatting use: degree by degree, orders -l to
l, with the Condon-Shortley phase.
"""

from __future__ import annotations

import math

import torch
from torch import Tensor

#: The harmonic of degree 0, a constant.
CONSTANT = 0.5 / math.sqrt(math.pi)
_LINEAR = math.sqrt(3 / (4 * math.pi))


def basis(directions: Tensor, degree: int) -> Tensor:
    """The harmonics [N, (degree + 1)^2] of unit directions [N, 3]; `degree` 0 to 3."""
    x, y, z = directions.unbind(1)
    columns = [torch.full_like(x, CONSTANT)]
    if degree >= 1:
        columns += [-_LINEAR * y, _LINEAR * z, -_LINEAR * x]
    if degree >= 2:
        a, b, c = 0.5 * math.sqrt(15 / math.pi), 0.25 * math.sqrt(5 / math.pi), 0.25 * math.sqrt(15 / math.pi)
        columns += [a * x * y, -a * y * z, b * (3 * z * z - 1), -a * x * z, c * (x * x - y * y)]
    if degree >= 3:
        a, b = 0.25 * math.sqrt(35 / (2 * math.pi)), 0.5 * math.sqrt(105 / math.pi)
        c, d = 0.25 * math.sqrt(21 / (2 * math.pi)), 0.25 * math.sqrt(7 / math.pi)
        columns += [
            -a * y * (3 * x * x - y * y),
            b * x * y * z,
            -c * y * (5 * z * z - 1),
            d * z * (5 * z * z - 3),
            -c * x * (5 * z * z - 1),
            0.5 * b * z * (x * x - y * y),
            -a * x * (x * x - 3 * y * y),
        ]
    return torch.stack(columns, dim=1)


def colors(constant: Tensor, rest: Tensor, directions: Tensor, degree: int) -> Tensor:
    """Colours [N, 3], not below 0, of coefficients constant [N, 3] and rest [N, K, 3] seen along `directions` [N, 3].

    Of `rest`, the first (degree + 1)^2 - 1 are used; it holds as many or more.
    """
    total = CONSTANT * constant + 0.5
    if degree > 0:
        shape = basis(directions, degree)[:, 1:]
        total = total + (shape[:, :, None] * rest[:, : shape.shape[1]]).sum(dim=1)
    return total.clamp(min=0)


def constant_of(colors: Tensor) -> Tensor:
    """The constant coefficients [N, 3] that give `colors` [N, 3] from everywhere."""
    return (colors - 0.5) / CONSTANT

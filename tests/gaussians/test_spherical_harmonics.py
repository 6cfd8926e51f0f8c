"""View-dependent colours: the basis, its order and signs, and active degrees."""

from __future__ import annotations

import numpy as np
import torch
from torch import nn

from splashbench.gaussians import spherical_harmonics as harmonics


class TestHarmonics:
    def test_the_basis_is_orthonormal_on_the_sphere(self) -> None:
        # Gauss-Legendre in z and even steps in the angle integrate polynomials of degree 6 exactly.
        z, weight = np.polynomial.legendre.leggauss(8)
        angle = np.arange(16) / 16 * 2 * np.pi
        s = np.sqrt(1 - z**2)
        directions = np.stack(
            [np.outer(s, np.cos(angle)), np.outer(s, np.sin(angle)), np.outer(z, np.ones(16))], axis=-1
        ).reshape(-1, 3)
        values = harmonics.basis(torch.from_numpy(directions), 3).numpy()
        weights = np.repeat(weight, 16) * 2 * np.pi / 16
        np.testing.assert_allclose((values * weights[:, None]).T @ values, np.eye(16), atol=1e-12)

    def test_order_and_signs_are_those_of_published_point_clouds(self) -> None:
        axes = harmonics.basis(torch.eye(3, dtype=torch.float64), 1).numpy()
        c0, c1 = 0.28209479177387814, 0.4886025119029199
        np.testing.assert_allclose(axes, [[c0, 0, 0, -c1], [c0, -c1, 0, 0], [c0, 0, c1, 0]], atol=1e-15)
        diagonal = torch.full((1, 3), 3**-0.5, dtype=torch.float64)
        second, third = np.split(harmonics.basis(diagonal, 3).numpy()[0, 4:], [5])
        np.testing.assert_allclose(
            second, [1.0925484305920792 / 3, -1.0925484305920792 / 3, 0, -1.0925484305920792 / 3, 0], atol=1e-12
        )
        a, b, c, d = 0.5900435899266435, 2.890611442640554, 0.4570457994644658, 0.3731763325901154
        np.testing.assert_allclose(third * 3**1.5, [-2 * a, b, -2 * c, -4 * d, -2 * c, 0, 2 * a], atol=1e-12)

    def test_a_colour_comes_back_from_its_constant(self) -> None:
        colors = torch.tensor([[0.1, 0.5, 0.9]])
        seen = harmonics.colors(harmonics.constant_of(colors), torch.zeros(1, 0, 3), torch.tensor([[0.0, 0, 1]]), 0)
        torch.testing.assert_close(seen, colors)

    def test_only_the_active_degree_takes_part(self) -> None:
        rest = torch.randn(5, 15, 3)
        direction = nn.functional.normalize(torch.randn(5, 3), dim=1)
        constant = torch.full((5, 3), 0.3)
        flat = harmonics.colors(constant, rest, direction, 0)
        torch.testing.assert_close(flat, harmonics.CONSTANT * constant + 0.5)
        linear = harmonics.colors(constant + 10, rest, direction, 1)
        zeroed = rest.clone()
        zeroed[:, 3:] = 0
        torch.testing.assert_close(linear, harmonics.colors(constant + 10, zeroed, direction, 3))

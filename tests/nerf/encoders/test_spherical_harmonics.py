import math

import pytest
import torch

from nerf_lightning.nerf.encoders.spherical_harmonics import SphericalHarmonicsEncoder


def sphere(rows=64):
    """Directions and weights that integrate polynomials of low degree over the sphere exactly."""
    import numpy as np

    z, weight = (torch.from_numpy(x) for x in np.polynomial.legendre.leggauss(rows))
    angle = 2 * math.pi * torch.arange(2 * rows, dtype=torch.float64) / (2 * rows)
    radius = (1 - z**2).sqrt()[:, None]
    points = torch.stack([radius * angle.cos(), radius * angle.sin(), z[:, None].expand(-1, 2 * rows)], dim=-1)
    return points.reshape(-1, 3), (weight[:, None].expand(-1, 2 * rows) * math.pi / rows).reshape(-1)


@pytest.mark.parametrize("degree", [1, 2, 3, 4])
def test_the_functions_are_orthonormal_on_the_sphere(degree):
    points, weights = sphere()
    values = SphericalHarmonicsEncoder(degree)(points)
    gram = values.T @ (weights[:, None] * values)
    torch.testing.assert_close(gram, torch.eye(degree**2, dtype=torch.float64))


def test_each_degree_has_its_parity():
    """Y_lm(-d) = (-1)^l Y_lm(d)."""
    directions = torch.nn.functional.normalize(torch.randn(20, 3), dim=-1)
    encode = SphericalHarmonicsEncoder(4)
    sign = torch.tensor([1.0] + [-1.0] * 3 + [1.0] * 5 + [-1.0] * 7)
    torch.testing.assert_close(encode(-directions), sign * encode(directions))


def test_only_degrees_1_to_4_exist():
    with pytest.raises(ValueError, match="degree=5"):
        SphericalHarmonicsEncoder(5)

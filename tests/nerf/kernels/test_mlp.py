from itertools import pairwise

import pytest
import torch

from nerf_lightning.nerf.kernels.mlp.mlp import mlp, mlp_torch
from nerf_lightning.nerf.matmul_precision import TILE_ROWS as TILE


def weights(*sizes):
    return [torch.randn(b, a) / a**0.5 for a, b in pairwise(sizes)]


@pytest.mark.parametrize("rows", [0, 1, TILE, 2 * TILE + 17])
@pytest.mark.parametrize("sizes", [(32, 64, 16), (32, 64, 64, 3), (5, 2)])
def test_tiles_equal_the_reference_in_value_and_gradient(rows, sizes):
    # In float64: in float32 a unit within rounding of zero is on in one and off in the other.
    points, used = torch.randn(rows, sizes[0], dtype=torch.float64), [w.double() for w in weights(*sizes)]
    results = []
    for fn in (mlp, mlp_torch):
        leaves = [x.detach().clone().requires_grad_() for x in (points, *used)]
        out = fn(leaves[0], leaves[1:])
        out.square().sum().backward()
        results.append([out.detach(), *(leaf.grad for leaf in leaves)])
    for found, expected in zip(*results, strict=True):
        assert float((found - expected).norm()) <= 1e-12 * float(expected.norm())


@pytest.mark.parametrize("rows", [100, TILE + 700])
def test_it_multiplies_bfloat16_where_it_is_told_to_and_adds_up_gradients_in_float32(rows):
    points, used = torch.randn(rows, 32), weights(32, 64, 3)
    exact = mlp(points, used)
    half = mlp(points, [weight.requires_grad_() for weight in used], "bfloat16")
    half.sum().backward()
    error = float((half.detach() - exact).norm() / exact.norm())
    assert 1e-4 < error < 2e-2
    assert half.dtype == torch.float32
    assert all(weight.grad.dtype == torch.float32 for weight in used)
    leaves = [weight.detach().requires_grad_() for weight in used]
    mlp(points, leaves).sum().backward()
    # Beside the rounding itself, units near zero are on in one precision and off in the other.
    for found, expected in zip(used, leaves, strict=True):
        assert float((found.grad - expected.grad).norm()) < 6e-2 * float(expected.grad.norm())

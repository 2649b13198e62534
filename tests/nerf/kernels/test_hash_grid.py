"""The twins of the hash grid against the reference in plain torch, with fresh random inputs."""

import pytest
import torch

from nerf_lightning.nerf.kernels import backends
from nerf_lightning.nerf.kernels.hash_grid import cpu
from nerf_lightning.nerf.kernels.hash_grid.layout import HashGridLayout, hash_grid_layout
from nerf_lightning.nerf.kernels.hash_grid.op import interpolate
from nerf_lightning.nerf.kernels.hash_grid.reference import interpolate_torch

LAYOUTS = [
    hash_grid_layout(num_levels=3, log2_table_size=10, min_resolution=4, max_resolution=40),
    hash_grid_layout(num_levels=1, log2_table_size=12, min_resolution=5, max_resolution=5),
    hash_grid_layout(num_levels=8, log2_table_size=14, min_resolution=16, max_resolution=512),
]


def inputs(layout, features, count=3000, reach=1.0):
    table = torch.randn(layout.offsets[-1], features)
    points = reach * torch.rand(count, 3) - (reach - 1) / 2
    grad = torch.randn(count, len(layout.resolutions) * features)
    return table, points, grad


def values_and_gradients(fn, table, points, grad, layout):
    table, points = table.clone().requires_grad_(), points.clone().requires_grad_()
    out = fn(table, points, layout)
    out.backward(grad.to(out.dtype))
    return out.detach(), table.grad, points.grad


@pytest.mark.parametrize("layout", LAYOUTS)
@pytest.mark.parametrize("features", [1, 2, 4])
def test_the_numba_twin_equals_the_reference(layout, features):
    assert backends.backend("nerf_lightning.nerf.kernels.hash_grid.cpu") is not None
    given = inputs(layout, features, reach=1.2)  # some points lie outside
    fast = values_and_gradients(interpolate, *given, layout)
    slow = values_and_gradients(interpolate_torch, *given, layout)
    for found, expected in zip(fast, slow, strict=True):
        assert float((found - expected).norm() / expected.norm()) < 1e-5


def test_the_reference_interpolates_linear_functions_exactly():
    """A dense level whose vertices hold a linear function of their place gives it back everywhere."""
    layout = HashGridLayout((6,), (0, 343), 512)
    z, y, x = torch.meshgrid(*[torch.arange(7, dtype=torch.float64) / 6] * 3, indexing="ij")
    table = (2 * x - 3 * y + 5 * z).reshape(-1, 1)
    points = torch.rand(500, 3, dtype=torch.float64)
    expected = points @ torch.tensor([[2.0], [-3.0], [5.0]], dtype=torch.float64)
    torch.testing.assert_close(interpolate_torch(table, points, layout), expected)


def test_gradients_of_the_reference_are_right():
    layout = hash_grid_layout(2, 6, 2, 5)
    table = torch.randn(layout.offsets[-1], 2, dtype=torch.float64, requires_grad=True)
    points = (0.1 + 0.8 * torch.rand(4, 3, dtype=torch.float64)).requires_grad_()
    assert torch.autograd.gradcheck(lambda t, p: interpolate_torch(t, p, layout), (table, points))


def test_a_hashed_level_shares_its_entries_and_gradients_are_added_in_place_where_an_optimizer_keeps_them():
    layout = hash_grid_layout(2, 8, 4, 64)
    assert [layout.is_hashed(level) for level in (0, 1)] == [False, True]
    assert layout.offsets == (0, 125, 125 + 256)
    table, points, grad = inputs(layout, 2, count=20_000)
    _, gradient, _ = values_and_gradients(interpolate, table, points, grad, layout)
    assert bool((gradient[125:] != 0).all())  # every shared entry is used
    layout = LAYOUTS[0]
    table, points, grad = inputs(layout, 2)
    kept = table.clone().requires_grad_()
    kept.grad, kept.grad_in_place = torch.ones_like(table), True
    place = kept.grad.data_ptr()
    interpolate(kept, points, layout).backward(grad)
    _, expected, _ = values_and_gradients(interpolate, table, points, grad, layout)
    assert kept.grad.data_ptr() == place
    torch.testing.assert_close(kept.grad, expected + 1.0)


def test_the_result_does_not_depend_on_the_threads(set_threads):
    layout = LAYOUTS[2]
    given, results = inputs(layout, 4), []
    for threads in (1, 2):
        set_threads(threads)
        results.append(values_and_gradients(interpolate, *given, layout))
    assert all(torch.equal(a, b) for a, b in zip(*results, strict=True))


@pytest.mark.parametrize("features", [2, 4])
def test_a_point_does_not_depend_on_where_it_stands(features):
    layout = hash_grid_layout(4, 8, 2, 40)
    table, points, _ = inputs(layout, features, count=333)
    order = torch.randperm(333)
    assert torch.equal(cpu.forward(table, points, layout)[order], cpu.forward(table, points[order], layout))
    assert torch.equal(cpu.forward(table, points, layout)[5:6], cpu.forward(table, points[5:6], layout))


def test_points_that_are_none_stay_in_the_table():
    """A camera that has lost itself must not read or write memory that is not the table's."""
    layout = hash_grid_layout(4, 8, 2, 40)
    points = torch.tensor([[torch.nan, 0.5, 0.5], [torch.inf, -torch.inf, torch.nan], [1e30, -1e30, 0.0]])
    table, into = torch.rand(layout.offsets[-1], 4), torch.zeros(layout.offsets[-1] + 2 * layout.offsets[-1], 4)
    cpu.forward(table, points, layout)
    middle = into[layout.offsets[-1] : 2 * layout.offsets[-1]]
    cpu.add_table_gradient(middle, points, torch.ones(3, 16), layout)
    assert bool((into[: layout.offsets[-1]] == 0).all())
    assert bool((into[2 * layout.offsets[-1] :] == 0).all())

"""The CUDA twin of the hash grid against its reference: on a GPU, or through triton's interpreter."""

import torch

from nerf_lightning.nerf.kernels.hash_grid.layout import hash_grid_layout
from nerf_lightning.nerf.kernels.hash_grid.reference import interpolate_torch


def check_against_the_reference(device: str, count: int) -> None:
    """Compare values and gradients, of tables in float32 and in half precision."""
    from nerf_lightning.nerf.kernels.hash_grid import cuda as backend

    backend.trial(device)
    # Each has dense levels and hashed ones.
    for features, levels, size in ((2, 2, 10), (4, 3, 12)):
        layout = hash_grid_layout(levels, size, 4, 64)
        table = torch.randn(layout.offsets[-1], features, device=device)
        points = 1.2 * torch.rand(count, 3, device=device) - 0.1
        grad = torch.randn(count, levels * features, device=device)
        leaf = table.clone().requires_grad_()
        expected = interpolate_torch(leaf, points, layout)
        expected.backward(grad)
        found, gradient = backend.forward(table, points, layout), torch.zeros_like(table)
        backend.add_table_gradient(gradient, points, grad, layout)
        assert float((found - expected.detach()).norm() / expected.detach().norm()) < 1e-5
        assert float((gradient - leaf.grad).norm() / leaf.grad.norm()) < 1e-5
        for rows in (0, 1, count - 1, count):
            used, cut = torch.full((1,), rows, device=device), grad.clone()
            cut[rows:] = 0.0
            some, of_some, of_cut = backend.forward(table, points, layout, used), gradient * 0.0, gradient * 0.0
            assert torch.equal(some[:rows], found[:rows])
            assert not some[-(-rows // backend.BLOCK) * backend.BLOCK :].any()
            backend.add_table_gradient(of_some, points, cut, layout, used)
            backend.add_table_gradient(of_cut, points, cut, layout)
            assert torch.equal(of_some, of_cut) or str(device) != "cpu"  # a GPU adds in any order
        half = backend.forward(table.half(), points, layout)
        assert 1e-6 < float((half - expected.detach()).norm() / expected.detach().norm()) < 2e-3

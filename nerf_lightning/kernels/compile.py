"""Compile the CPU kernels ahead of their first use (`python -m nerf_lightning.kernels.compile`); numba keeps them."""

import torch

from nerf_lightning.kernels.adam import adam_step
from nerf_lightning.kernels.hash_grid import hash_grid_layout, interpolate
from nerf_lightning.kernels.march import March, OccupancyCells, blocks_of, march
from nerf_lightning.kernels.packed import integrate, num_visible
from nerf_lightning.types.rays import RayBundle


def compile_kernels() -> None:
    """Run every kernel once on next to nothing."""
    layout = hash_grid_layout(2, 6, 2, 8)
    for features in (2, 4):  # the widths that conf/model uses
        table = torch.zeros(layout.offsets[-1], features, requires_grad=True)
        interpolate(table, torch.rand(4, 3), layout).sum().backward()
    aabb, one = torch.tensor([[-1.0] * 3, [1.0] * 3]), torch.ones(1)
    along = torch.tensor([[0.0, 0.0, 1.0]])
    rays = RayBundle(torch.tensor([[0.0, 0.0, -2.0]]), along, one, 3 * one, one.long(), along)
    cells = torch.ones(1, 4, 4, 4, dtype=torch.uint8)
    grid = OccupancyCells(aabb, cells, blocks_of(cells), cells.float())
    samples, _ = march(rays, March(one, 3 * one, 0 * one, 0 * one.long()), torch.linspace(1.0, 3.2, 12), grid)
    density = torch.ones(samples.starts.shape[0], requires_grad=True)
    integrate(density, torch.rand(density.shape[0], 3), samples)[1].sum().backward()
    num_visible(density, samples, 0.01)
    adam_step(torch.ones(4), torch.ones(4), torch.zeros(4), torch.zeros(4), 0.1, 1.0, (0.9, 0.99), 1e-15)


if __name__ == "__main__":
    compile_kernels()

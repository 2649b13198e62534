"""The march: what it keeps, against looking every interval up."""

import pytest
import torch
from support.scenes import some_rays

from nerf_lightning.nerf.geometry.boxes import distances_in_box
from nerf_lightning.nerf.kernels.march.grid import FARTHEST, MarchState, OccupancyCells, blocks_of, leaps_over
from nerf_lightning.nerf.kernels.march.op import march
from nerf_lightning.nerf.kernels.march.reference import march_torch

AABB = torch.tensor([[-1.0, -1.2, -0.9], [1.0, 1.2, 0.9]])


def a_march(count=300, share=0.05, resolution=16):
    rays = some_rays(count)
    cells = (torch.rand(resolution, resolution, resolution) < share).to(torch.uint8)
    enter, leave = distances_in_box(rays, AABB)
    state = MarchState(enter, leave, torch.rand(count), torch.zeros(count, dtype=torch.long))
    edges = [1.9]
    while edges[-1] < 6.1:
        edges.append(edges[-1] + 0.02)
    return rays, state, torch.tensor([*edges, 2 * edges[-1] - edges[-2]]), grid_of(cells)


def grid_of(cells):
    return OccupancyCells(AABB, cells, leaps_over(blocks_of(cells)))


@pytest.mark.parametrize("limit", [None, 1, 5])
@pytest.mark.parametrize("share", [0.0, 0.02, 0.5, 1.0])
def test_skipping_keeps_what_looking_everywhere_keeps(share, limit):
    given = a_march(share=share)
    fast, fast_next = march(*given, limit)
    slow, slow_next = march_torch(*given, limit, None)
    counts = [found.bounds.diff() for found in (fast, slow)]
    same = (counts[0] == counts[1]) & (fast_next == slow_next)
    # A midpoint on a cell's face, to the last bit, may fall to either side.
    assert int((~same).sum()) <= 1
    a, b = (found.at(*_of_rays(found, same)) for found in (fast, slow))
    assert torch.equal(a.ray_index, b.ray_index)
    torch.testing.assert_close(a.starts, b.starts)
    torch.testing.assert_close(a.ends, b.ends)


@pytest.mark.parametrize(("share", "limit"), [(0.02, None), (0.3, None), (0.3, 4), (0.0, None)])
def test_padding_is_spread_over_the_rays(share, limit):
    given, capacity = a_march(share=share), 1 << 15
    exact, _ = march_torch(*given, limit, None)
    padded, _ = march_torch(*given, limit, capacity)
    count = exact.starts.numel()
    assert torch.equal(padded.bounds, exact.bounds)
    for name in ("ray_index", "starts", "ends"):
        assert torch.equal(getattr(padded, name)[:count], getattr(exact, name))
    assert not bool(padded.deltas[count:].any())
    most = int(exact.bounds.diff().max()) + -(-(capacity - count) // 300)
    assert int(padded.ray_index.bincount().max()) <= most
    assert int(exact.bounds.diff().max()) <= padded.longest == exact.longest


def test_large_empty_spaces_are_left_at_one_leap():
    """A few cells in a large grid: leaps over many blocks, past whatever is next to them."""
    given = a_march(count=2000, resolution=96, share=1e-3)
    (fast, fast_next), (slow, slow_next) = march(*given), march_torch(*given, None, None)
    assert int(((fast.bounds.diff() != slow.bounds.diff()) | (fast_next != slow_next)).sum()) <= 2
    assert int(slow.bounds[-1]) > 100


def test_leaps_are_distances_to_the_next_occupied_block():
    blocks = (torch.rand(12, 10, 11) < 0.003).to(torch.uint8)
    blocks[3, 4, 5] = 1
    a, b = torch.cartesian_prod(*map(torch.arange, blocks.shape)), blocks.nonzero()
    expected = (a[:, None] - b).abs().amax(dim=-1).amin(dim=-1).clamp(max=FARTHEST)
    assert torch.equal(leaps_over(blocks).flatten().long(), expected)


def _of_rays(samples, chosen):
    counts = samples.bounds.diff() * chosen
    return chosen[samples.ray_index].nonzero()[:, 0], torch.cat([counts.new_zeros(1), counts.cumsum(0)])


def test_a_full_grid_gives_every_interval_whose_middle_is_in_the_box():
    rays, state, lattice, grid = a_march(count=50, share=2.0)
    samples, _ = march(rays, state, lattice, grid)
    lengths = torch.zeros(50).index_add(0, samples.ray_index, samples.deltas)
    chord = (state.leave - state.enter).clamp(min=0)
    assert float((lengths - chord).abs().max()) <= 0.021  # an interval at either end, half of it each
    assert bool((samples.deltas > 0).all())

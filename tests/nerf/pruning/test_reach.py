"""Which entries of a hash grid are looked up, against looking up many points."""

import torch
from support.configs import composed
from support.scenes import ball_scene, some_rays

from nerf_lightning.config.instantiate import build
from nerf_lightning.nerf.kernels.hash_grid.layout import hash_grid_layout
from nerf_lightning.nerf.kernels.hash_grid.reference import interpolate_torch
from nerf_lightning.nerf.pruning.reach import entries_of_cells, reached_entries

LAYOUT = hash_grid_layout(num_levels=4, log2_table_size=12, min_resolution=5, max_resolution=37)


def occupied(side, share, seed=0):
    return torch.rand(side, side, side, generator=torch.Generator().manual_seed(seed)) < share


def looked_up(cells, count=400):
    """The entries of points in cells, corners and faces of cells among them."""
    within = torch.rand(count, 1, 3)
    within[:30] = within[:30].round()
    points = ((cells.nonzero() + within) / cells.shape[0]).flatten(0, 1)
    table = torch.zeros(LAYOUT.offsets[-1], 1, requires_grad=True)
    interpolate_torch(table, points, LAYOUT).sum().backward()
    return table.grad[:, 0] != 0


def test_all_that_points_of_occupied_cells_look_up_is_reached_and_little_else():
    torch.manual_seed(0)
    for side, share in ((8, 0.015), (16, 0.002)):
        cells = occupied(side, share)
        reached, seen = entries_of_cells(LAYOUT, cells), looked_up(cells)
        assert not bool((seen & ~reached).any())
        for first, last in zip(LAYOUT.offsets, LAYOUT.offsets[1:], strict=False):
            few, more = int(seen[first:last].sum()), int(reached[first:last].sum())
            assert more <= 1.5 * few
        assert int(reached.sum()) < 0.5 * reached.numel()
    assert not bool(entries_of_cells(LAYOUT, torch.zeros(8, 8, 8, dtype=torch.bool)).any())


def test_of_a_crowded_level_none_is_left_out():
    reached = entries_of_cells(LAYOUT, occupied(8, 0.9))
    assert bool(reached[LAYOUT.offsets[3] :].all())


def fast_model(*more):
    small = ("encoder.log2_table_size=12", "encoder.num_levels=3", "encoder.max_resolution=32", "field.width=16")
    grid = "model.levels.fine.sampler.resolution=12", "model.levels.fine.sampler.num_steps=48"
    model = build(composed("train", "model=fast_small", *small, *grid, *more).model)
    model.fit_to(ball_scene())
    return model.eval()


def test_rays_see_the_same_whatever_stands_where_they_look_nothing_up():
    torch.manual_seed(3)
    model = fast_model()
    level, rays = model.last, some_rays(200)
    table = level.field.position_encoder.table
    torch.nn.init.normal_(table)
    level.sampler.grid.occupy(occupied(12, 0.01)[None])
    reached = reached_entries(level)
    assert 0 < int(reached.sum()) < 0.8 * reached.numel()
    with torch.no_grad():
        before = model(rays, None, None)[-1]
        table[~reached] = 100.0
        after = model(rays, None, None)[-1]
        assert torch.equal(before.rgb, after.rgb)
        assert float(before.opacity.max()) > 0.1
        table[reached] = 100.0
        assert not torch.equal(before.rgb, model(rays, None, None)[-1].rgb)


def test_where_it_cannot_be_told_nothing_is_said():
    assert reached_entries(fast_model("field.contraction=true").last) is None
    moved = fast_model()
    moved.last.field.aabb += 0.1
    assert reached_entries(moved.last) is None
    dense = build(composed("train", "model=nerf_tiny").model)
    assert reached_entries(dense.last) is None

"""Batches of few photographs, and rays through pixels of known distance: functions of the step alone."""

from dataclasses import replace

import pytest
import torch
from support.scenes import ball_scene
from support.steps import make_step

from nerf_lightning.compute import ranks
from nerf_lightning.data.datamodule import RayDataModule
from nerf_lightning.data.ray_batches import RayBatches
from nerf_lightning.messages.errors import InputError
from nerf_lightning.nerf.types.progress import Progress
from nerf_lightning.nerf.types.rays import KnownDepths, PixelIndex

RAYS, VIEWS = 24, 2


def loader(seed=0, views=VIEWS, crop_steps=0, scene=None):
    made = RayBatches(ball_scene(num_views=10, size=6) if scene is None else scene, Progress(), seed, RAYS, views=views)
    made.crop_to(0.5, crop_steps, restart_steps=5)
    return made


def rows(pixels):
    return torch.stack([pixels.view, pixels.y, pixels.x], dim=1)


def test_a_step_has_as_many_rays_of_each_of_few_photographs():
    made = loader(scene=ball_scene(num_views=8, size=6))
    for step in range(10):
        view, count = made.pixels_at(0, RAYS * step).view.unique(return_counts=True)
        assert len(view) == VIEWS
        assert count.tolist() == [RAYS // VIEWS] * VIEWS


def test_every_photograph_comes_once_in_a_lap_and_each_pixel_once_before_it_comes_again():
    """Five training views of 36 pixels: five steps of two take each view twice, 12 pixels at a time."""
    made = loader()
    assert len(made.whole.views) == 5
    pixels = [made.pixels_at(0, RAYS * step) for step in range(15)]
    each = [part.view[0] for step in pixels for part in (step[:12], step[12:])]
    for lap in range(6):
        assert sorted(map(int, each[5 * lap : 5 * lap + 5])) == sorted(made.whole.views.tolist())
    seen = torch.cat([rows(step) for step in pixels[:7]] + [rows(pixels[7][:12])])
    assert len(seen.unique(dim=0)) == len(seen) == 5 * 36


def test_steps_seeds_and_attempts_have_orders_of_their_own_and_a_step_always_the_same():
    first = rows(loader().pixels_at(0, 5 * RAYS))
    assert torch.equal(first, rows(loader().pixels_at(0, 5 * RAYS)))
    assert not torch.equal(first, rows(loader().pixels_at(0, 6 * RAYS)))
    assert not torch.equal(first, rows(loader(seed=1).pixels_at(0, 5 * RAYS)))
    made = loader()
    made.restart_crop_steps = 0
    assert not torch.equal(first, rows(made.pixels_at(1, 5 * RAYS)))


def test_processes_share_the_batch_of_one(monkeypatch):
    whole = rows(loader().pixels_at(0, 3 * RAYS))
    parts = []
    for rank in range(2):
        monkeypatch.setattr(ranks, "share", lambda count, rank=rank: slice(rank * count // 2, (rank + 1) * count // 2))
        parts.append(rows(loader().pixels_at(0, 3 * RAYS)))
    assert torch.equal(torch.cat(parts), whole)


def test_the_crop_comes_first_and_pictures_smaller_than_their_share_of_rays_come_again():
    made = loader(crop_steps=2)
    for step in range(2):
        pixels = made.pixels_at(0, RAYS * step)
        assert int(pixels.x.min()) >= 1
        assert int(pixels.x.max()) < 5
    assert int(made.pixels_at(0, RAYS * 2).x.min()) < 1
    scene = ball_scene(num_views=4, size=3)
    pixels, counts = rows(loader(scene=scene).pixels_at(0, 0)).unique(dim=0, return_counts=True)
    assert len(pixels) == 2 * 9
    assert int(counts.max()) == 2


@pytest.mark.parametrize(
    ("settings", "said"),
    [
        ({"views_per_step": 3, "batch_rays": 32}, "divides the number of rays"),
        ({"views_per_step": 0}, "divides the number of rays"),
        ({"views_per_step": 2, "sample_budget": 1000}, "cannot be combined with data.sample_budget"),
        ({"views_per_step": 2, "patch": 4}, "loss.patch"),
    ],
)
def test_what_cannot_be_shared_evenly_is_refused(settings, said):
    with pytest.raises(InputError, match=said):
        RayDataModule(ball_scene(), Progress(), 0, **({"batch_rays": 64, "val_rays": 8} | settings))


def scene_with_depths(count=20, **settings):
    """The ball, with distances of a few pixels; every third is of a view that is not trained on."""
    scene = ball_scene(**settings)
    number = torch.arange(count)
    view = torch.where(number % 3 == 2, scene.splits["test"][0], number % 2)
    pixels = PixelIndex(view, number % 12, (5 * number + number // 12) % 12)
    return replace(scene, depths=KnownDepths(pixels, 1.0 + number, torch.full((count,), 0.5)))


def loader_of(scene, batch_rays=32, every=4, patch=1):
    return RayBatches(scene, Progress(), 0, batch_rays, patch=patch, depth_every=every)


def test_every_known_pixel_of_a_training_view_comes_once_an_epoch_with_its_distance():
    scene = scene_with_depths()
    loader, seen = loader_of(scene), []
    trained = [row for row in range(20) if row % 3 != 2]
    for step in range(7):
        batch = loader.batch_at(0, 32 * step)
        assert batch.certainty.count_nonzero() == 8
        assert not batch.certainty[:24].any()
        rows = (batch.distance[24:] - 1.0).long()
        assert torch.equal(batch.pixels.x[24:], scene.depths.pixels.x[rows])
        assert torch.equal(batch.pixels.view[24:], scene.depths.pixels.view[rows])
        seen += rows.tolist()
    assert sorted(seen[:14]) == sorted(seen[14:28]) == trained
    assert seen[:14] != seen[14:28]


def test_the_other_rays_still_show_every_pixel_once_an_epoch():
    scene = scene_with_depths()
    loader, total = loader_of(scene), 3 * 144
    parts = [loader.pixels_at(0, 32 * step)[torch.arange(24)] for step in range(total // 24)]
    flat = torch.cat([scene.pixels.index_of(part.view, part.x, part.y) for part in parts])
    assert torch.equal(flat.sort().values, torch.arange(total))


@pytest.mark.parametrize("batch_rays", [5, 40, 50])
def test_batches_of_another_size_show_the_same_rays(batch_rays):
    """What is seen is a function of how many rays were seen, so a resume under a budget goes on exactly."""
    scene = scene_with_depths()
    whole = loader_of(scene, 400).batch_at(0, 0)
    parts = [loader_of(scene, batch_rays).batch_at(0, first, batch_rays) for first in range(0, 400, batch_rays)]
    known = torch.cat([part.distance[part.certainty > 0] for part in parts])
    assert torch.equal(known, whole.distance[whole.certainty > 0])


def test_processes_share_one_batch_with_depths(monkeypatch):
    scene, whole = scene_with_depths(), loader_of(scene_with_depths()).batch_at(0, 64)
    parts = []
    for rank in range(2):
        monkeypatch.setattr(ranks, "share", lambda count, rank=rank: slice(rank * count // 2, (rank + 1) * count // 2))
        parts.append(loader_of(scene).batch_at(0, 64))
    for mine, all_of_it in zip(zip(*(part.tensors() for part in parts), strict=True), whole.tensors(), strict=True):
        assert torch.equal(torch.cat(mine), all_of_it)


def test_squares_hold_their_known_pixel():
    scene = scene_with_depths()
    batch = loader_of(scene, 128, 4, patch=4).batch_at(0, 0)
    assert batch.num_rays == 128
    assert batch.certainty.view(8, 16).count_nonzero(dim=1).tolist() == [0, 0, 0, 0, 0, 0, 1, 1]
    for ray in batch.certainty.nonzero()[:, 0].tolist():
        row = int(batch.distance[ray]) - 1
        assert (int(batch.pixels.x[ray]), int(batch.pixels.y[ray])) == (row % 12, (5 * row + row // 12) % 12)


def test_without_depths_or_a_loss_for_them_batches_are_as_ever_and_masked_pixels_tell_no_distance():
    scene = scene_with_depths()
    plain = RayBatches(scene, Progress(), 0, 32).batch_at(0, 64)
    assert plain.distance is None
    without = RayBatches(ball_scene(), Progress(), 0, 32, depth_every=4).batch_at(0, 64)
    assert torch.equal(plain.pixels.x, without.pixels.x)
    held_out = replace(scene, depths=scene.depths[2:3])
    assert RayBatches(held_out, Progress(), 0, 32, depth_every=4).batch_at(0, 64).distance is None
    masked = replace(scene, pixels=replace(scene.pixels, mask=torch.zeros(len(scene.pixels.rgba), dtype=torch.uint8)))
    assert not loader_of(masked).batch_at(0, 0).certainty.any()


def test_tiles_add_up_with_distances():
    from nerf_lightning.nerf.losses.depth import DepthLoss

    found = []
    for tile_points in (None, 200):
        train_step = make_step(tile_points)
        train_step.objective.loss = DepthLoss(every=4, beside=1.0)
        batch = RayBatches(scene_with_depths(), train_step.progress, 0, 64, depth_every=4).batch_at(0, 0)
        seen = train_step.gradients(batch, train_step.key)
        found.append(seen.losses)
        # What is seen from beside the cameras is compared with no photograph, by nobody.
        assert torch.equal(seen.weight == 0, batch.certainty > 0)
    assert float(found[0][-1]) > 0
    torch.testing.assert_close(found[0], found[1])

"""Batches of few photographs: which they are and which of their rays, as functions of the step alone."""

import pytest
import torch
from support.scenes import ball_scene

from nerf_lightning.compute import ranks
from nerf_lightning.data.datamodule import RayDataModule
from nerf_lightning.data.ray_batches import RayBatches
from nerf_lightning.messages.errors import InputError
from nerf_lightning.nerf.types.progress import Progress

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


def test_the_crop_comes_first():
    made = loader(crop_steps=2)
    for step in range(2):
        pixels = made.pixels_at(0, RAYS * step)
        assert int(pixels.x.min()) >= 1
        assert int(pixels.x.max()) < 5
    assert int(made.pixels_at(0, RAYS * 2).x.min()) < 1


def test_pictures_smaller_than_their_share_of_rays_come_again():
    scene = ball_scene(num_views=4, size=3)
    pixels, counts = rows(loader(scene=scene).pixels_at(0, 0)).unique(dim=0, return_counts=True)
    assert len(pixels) == 2 * 9
    assert int(counts.max()) == 2


@pytest.mark.parametrize(
    ("settings", "said"),
    [
        ({"views_per_step": 3, "batch_rays": 32}, "divides the number of rays"),
        ({"views_per_step": 0}, "divides the number of rays"),
        ({"views_per_step": 2, "sample_budget": 1000}, "neither with data.sample_budget"),
        ({"views_per_step": 2, "patch": 4}, "loss.patch"),
    ],
)
def test_what_cannot_be_shared_evenly_is_refused(settings, said):
    with pytest.raises(InputError, match=said):
        RayDataModule(ball_scene(), Progress(), 0, **({"batch_rays": 64, "val_rays": 8} | settings))

from dataclasses import replace

import pytest
import torch
from support.pixel_batches import check_pixels
from support.scenes import ball_scene

from nerf_lightning.data.datamodule import RayDataModule
from nerf_lightning.data.ray_batches import FixedRays, PixelDomain, RayBatches, gather_batch
from nerf_lightning.messages.errors import InputError
from nerf_lightning.nerf.contrast import FLAT, shares
from nerf_lightning.nerf.kernels.pixels import cpu
from nerf_lightning.nerf.types.progress import Progress


def batches(scene, batch_rays=32, crop_steps=0, seed=0, crop_fraction=0.5):
    loader = RayBatches(scene, Progress(), seed, batch_rays)
    loader.crop_to(crop_fraction, crop_steps, restart_steps=5)
    return loader


def flat(scene, pixels):
    return scene.pixels.offset[pixels.view] + pixels.y * scene.pixels.width[pixels.view] + pixels.x


def test_an_epoch_is_every_training_pixel_once_and_batches_straddle_epochs():
    scene = ball_scene()
    total = 3 * 144
    loader = batches(scene, batch_rays=50)
    seen = torch.cat([flat(scene, loader.pixels_at(0, 50 * step)) for step in range(2 * total // 50 + 1)])
    first, second = seen[:total], seen[total : 2 * total]
    assert torch.equal(first.sort().values, torch.arange(total))
    assert torch.equal(second.sort().values, torch.arange(total))
    assert not torch.equal(first, second)


def test_the_shuffle_reaches_all_rays():
    """The fault: a shuffle buffer of a few batches; early batches would show the first view only."""
    scene = ball_scene(num_views=20, size=16)
    pixels = batches(scene, batch_rays=100).pixels_at(0, 0)
    assert pixels.view.unique().numel() == 10
    assert pixels.y.unique().numel() == 16


def test_seeds_attempts_and_zero_differ():
    scene = ball_scene()
    orders = [
        flat(scene, batches(scene, seed=seed).pixels_at(attempt, 0)) for seed, attempt in [(0, 0), (1, 0), (0, 1)]
    ]
    assert not torch.equal(orders[0], orders[1])
    assert not torch.equal(orders[0], orders[2])
    assert torch.equal(orders[0], flat(scene, batches(scene, seed=0).pixels_at(0, 0)))


def test_the_crop_shows_centres_only_counts_no_epoch_and_comes_again_with_a_restart():
    scene = ball_scene()
    loader = batches(scene, batch_rays=48, crop_steps=3)
    for step in range(3):
        pixels = loader.pixels_at(0, 48 * step)
        assert int(pixels.x.min()) >= 3
        assert int(pixels.x.max()) < 9
        assert int(pixels.y.min()) >= 3
        assert int(pixels.y.max()) < 9
    after = torch.cat([flat(scene, loader.pixels_at(0, 48 * (3 + step))) for step in range(9)])
    assert torch.equal(after.sort().values, torch.arange(432))
    loader = batches(scene)
    assert int(loader.pixels_at(0, 0).x.min()) < 3
    for step in range(5):
        assert int(loader.pixels_at(1, 32 * step).x.min()) >= 3
    assert int(loader.pixels_at(1, 32 * 5).x.min()) < 3


def test_a_gathered_batch_is_the_pixels_own_colour_and_the_loader_follows_the_runs_progress():
    scene = ball_scene()
    pixels = batches(scene).pixels_at(0, 0)
    batch = gather_batch(scene, pixels)
    assert batch.pixels is pixels
    assert batch.num_rays == 32
    for row in range(5):
        view, x, y = int(pixels.view[row]), int(pixels.x[row]), int(pixels.y[row])
        assert torch.equal((batch.rgba[row] * 255).round().to(torch.uint8), scene.pixels.view(view)[y, x])
    loader = batches(scene)
    stream = iter(loader)
    first = next(stream)
    assert torch.equal(next(stream).rgba, first.rgba)  # nothing was trained on: the same batch again
    loader.progress.advance(32)
    assert torch.equal(next(stream).rgba, loader.batch_at(0, 32).rgba)
    assert len(loader) == 14  # 3 views of 12 x 12 pixels, 32 at a time


def test_validation_rays_are_fixed_and_keep_their_tail():
    """The fault: validation that drops its last, smaller batch."""
    scene = ball_scene()
    rays = FixedRays(scene, "val", 100, 30)
    assert [chunk.rgba.shape[0] for chunk in rays] == [30, 30, 30, 10]
    assert all(torch.equal(a.rgba, b.rgba) for a, b in zip(rays, FixedRays(scene, "val", 100, 30), strict=True))
    everything = FixedRays(scene, "val", 10**6, 1000)
    assert sum(chunk.rgba.shape[0] for chunk in everything) == 3 * 144
    assert set(next(iter(rays)).pixels.view.tolist()) <= {3, 4, 5}


def test_views_of_different_sizes_share_one_domain():
    scene = ball_scene()
    domain = PixelDomain(scene, [1, 4], fraction=0.5)
    located = domain.locate(torch.arange(len(domain)))
    assert len(domain) == 2 * 36
    assert located.view.tolist() == [1] * 36 + [4] * 36
    assert (int(located.x.min()), int(located.x.max())) == (3, 8)


def test_random_backgrounds_behind_pictures_without_alpha_are_questioned(caplog):
    scene = ball_scene(background="random")
    RayDataModule(scene, Progress(), seed=0)
    assert caplog.text == ""
    rgba = scene.pixels.rgba.clone()
    rgba[:, 3] = 255
    opaque = replace(scene.pixels, rgba=rgba, has_transparency=False)
    RayDataModule(replace(scene, pixels=opaque), Progress(), seed=0)
    assert "pictures of ball have no transparent pixels" in caplog.text
    assert "scene.background=black" in caplog.text


def squares(scene, patch=4, batch_rays=64):
    return RayBatches(scene, Progress(), 0, batch_rays, patch=patch)


def test_squares_are_whole_lie_in_one_view_and_an_epoch_shows_every_pixel():
    scene = ball_scene()  # 3 views of 12 x 12 for training
    loader = squares(scene, patch=5, batch_rays=75)
    pixels = loader.pixels_at(0, 0)
    for number in range(3):
        view, x, y = (part[25 * number : 25 * (number + 1)].view(5, 5) for part in (pixels.view, pixels.x, pixels.y))
        assert view.unique().numel() == 1
        assert torch.equal(x - x[0, 0], torch.arange(5).expand(5, 5))
        assert torch.equal(y - y[0, 0], torch.arange(5)[:, None].expand(5, 5))
        assert 0 <= int(x[0, 0]) <= 7
        assert 0 <= int(y[0, 0]) <= 7
    for shift in range(5):
        places = loader.whole.locate(torch.arange(len(loader.whole)), shift)
        assert torch.equal(flat(scene, places).unique(), torch.arange(3 * 144))


def test_squares_follow_from_the_place_alone_and_their_grid_moves_from_epoch_to_epoch():
    scene = ball_scene()
    loader = squares(scene)
    everything = loader.pixels_at(0, 0, 640)
    parts = [loader.pixels_at(0, 64 * step, 64) for step in range(10)]
    for name in ("view", "x", "y"):
        assert torch.equal(getattr(everything, name), torch.cat([getattr(part, name) for part in parts]))
    corners = [set((loader.pixels_at(0, epoch * loader.whole.num_rays).x[::16] % 4).tolist()) for epoch in range(8)]
    assert len(set(map(frozenset, corners))) > 1


def test_squares_that_fit_no_picture_or_no_batch_are_refused_with_a_cure_and_the_crop_holds_whole_ones():
    scene = ball_scene()
    loader = squares(scene)
    loader.crop_to(0.5, steps=3, restart_steps=3)
    pixels = loader.pixels_at(0, 0)
    assert int(pixels.x.min()) >= 3
    assert int(pixels.x.max()) < 9
    with pytest.raises(InputError, match=r"loss\.patch=16 .* ball_0 of ball has 12 x 12"):
        RayDataModule(ball_scene(), Progress(), 0, batch_rays=256, patch=16)
    with pytest.raises(InputError, match=r"data\.batch_rays=100 is not a multiple .* data\.batch_rays=96"):
        RayDataModule(ball_scene(), Progress(), 0, batch_rays=100, patch=4)


def test_rays_prefer_contrast_and_weigh_less_there():
    scene = ball_scene()
    colors = scene.pixels.rgba.float()[:432, 0]  # of the three training views
    loader = RayBatches(scene, Progress(), 0, 432, candidates=4)
    drawn = [loader.batch_at(0, 432 * number) for number in range(100)]
    number = torch.cat([flat(scene, batch.pixels) for batch in drawn])
    weight = torch.cat([batch.weight for batch in drawn])
    edges = shares(scene.pixels)[number] > 10 * FLAT
    assert float(edges.float().mean()) > 1.5 * float((weight * edges).mean())
    # Weighted, it is as if pixels were drawn evenly: 43,200 colors of a standard deviation below 128.
    assert float((weight * colors[number]).mean()) == pytest.approx(float(colors.mean()), abs=4 * 128 / 43_200**0.5)
    assert float(weight.mean()) == pytest.approx(1.0, abs=0.02)
    counts = number.bincount(minlength=432)
    assert int(counts.min()) > 0


def test_one_place_has_one_ray_whatever_the_batch_and_masked_pixels_are_a_last_resort():
    scene = ball_scene()
    mask = (torch.arange(len(scene.pixels.rgba)) % 2).to(torch.uint8)
    scene = replace(scene, pixels=replace(scene.pixels, mask=mask))
    loader = RayBatches(scene, Progress(), 0, 64, candidates=3)
    whole, half = loader.batch_at(1, 128, 64), loader.batch_at(1, 160, 32)
    assert all(torch.equal(one[32:], other) for one, other in zip(whole.tensors(), half.tensors(), strict=True))
    kept = mask[flat(scene, whole.pixels)] > 0
    assert torch.equal(kept, whole.weight > 0)
    assert float(kept.float().mean()) > 0.75  # 7 of 8, on average: half of evenly drawn ones


def test_equal_pixels_are_drawn_alike():
    scene = ball_scene()
    scene = replace(scene, pixels=replace(scene.pixels, rgba=torch.full_like(scene.pixels.rgba, 99)))
    assert bool((RayBatches(scene, Progress(), 0, 64, candidates=4).batch_at(0, 0).weight == 1).all())


def test_the_kernel_of_batches_is_their_reference_bit_by_bit():
    check_pixels(cpu, "cpu", torch.Generator().manual_seed(0), 777)

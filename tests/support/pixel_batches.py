"""The kernels that make batches against their reference."""

from dataclasses import replace
from itertools import product
from unittest.mock import patch

import torch
from support.scenes import ball_scene

from nerf_lightning.data.ray_batches import RayBatches
from nerf_lightning.nerf.kernels.backends import without
from nerf_lightning.nerf.kernels.pixels import op
from nerf_lightning.nerf.types.progress import Progress
from nerf_lightning.nerf.types.rays import KnownDepths, PixelIndex
from nerf_lightning.nerf.types.scene import PixelStore


def check_pixels(kernels, device, generator, rays):
    """Bit for bit: within an epoch and across some, in the crop, of views of other sizes, with masks and distances."""
    width, height = torch.tensor([[7, 300, 1, 40], [5, 2, 9, 30]])
    sizes = width * height
    total = int(sizes.sum())
    rgba, mask = torch.randint(256, (total, 4), generator=generator).to(torch.uint8), torch.arange(total) % 3 != 1
    view = torch.tensor([3, 0, 2, 3, 0])
    known = PixelIndex(view, width[view] - 1, height[view] - 1)
    depths = KnownDepths(known, *torch.rand(2, 5, generator=generator))

    def batches(place, masked, every, candidates):
        arrays = (each.to(place) for each in (rgba, sizes.cumsum(0) - sizes, width, height))
        store = PixelStore(*arrays, True, mask.to(torch.uint8).to(place) if masked else None)
        scene = replace(ball_scene(4), pixels=store, splits={"train": (3, 0, 2)}, depths=depths)
        made = RayBatches(scene, Progress(), 3, rays, depth_every=every, candidates=candidates)
        made.crop_to(0.5, 2, 2)
        return made

    places = (False, 0, 0, 0), (True, 8, 1, 33 * rays), (True, 3, 0, (1 << 33) + 5)
    for (masked, every, attempt, seen), candidates in product(places, (1, 3)):
        with without("pixels.cpu"):
            expected = batches("cpu", masked, every, candidates).batch_at(attempt, seen)
        with patch.object(op, "backend_for", lambda *given: kernels):
            found = batches(device, masked, every, candidates).batch_at(attempt, seen)
        assert len(found.tensors()) == (7 if every else 5)
        for one, other in zip(found.tensors(), expected.tensors(), strict=True):
            assert torch.equal(one.cpu(), other)
    with patch.object(op, "backend_for", lambda *given: kernels):
        assert batches(device, True, 0, 3).batch_at(0, 0, 0).num_rays == 0

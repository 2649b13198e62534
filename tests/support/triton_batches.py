"""The triton kernels that make batches and rays against their references."""

from itertools import product
from types import SimpleNamespace
from unittest.mock import patch

import torch

from nerf_lightning.data.ray_batches import RayBatches
from nerf_lightning.nerf.geometry.cameras import rays_through_pixels
from nerf_lightning.nerf.kernels.pixels import op
from nerf_lightning.nerf.kernels.rays.cuda import LENSES
from nerf_lightning.nerf.types.progress import Progress
from nerf_lightning.nerf.types.rays import KnownDepths, PixelIndex
from nerf_lightning.nerf.types.scene import Cameras, PixelStore


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
        scene = SimpleNamespace(pixels=store, splits={"train": (3, 0, 2)}, depths=depths)
        made = RayBatches(scene, Progress(), 3, rays, depth_every=every, candidates=candidates)
        made.crop_to(0.5, 2, 2)
        return made

    places = (False, 0, 0, 0), (True, 8, 1, 33 * rays), (True, 3, 0, (1 << 33) + 5)
    for (masked, every, attempt, seen), candidates in product(places, (1, 3)):
        expected = batches("cpu", masked, every, candidates).batch_at(attempt, seen)
        with patch.object(op, "cuda_backend", lambda *given: kernels):
            found = batches(device, masked, every, candidates).batch_at(attempt, seen)
        assert len(found.tensors()) == (7 if every else 5)
        for one, other in zip(found.tensors(), expected.tensors(), strict=True):
            assert torch.equal(one.cpu(), other)
    with patch.object(op, "cuda_backend", lambda *given: kernels):
        assert batches(device, True, 0, 3).batch_at(0, 0, 0).num_rays == 0


def check_rays(kernels, device, generator, rays):
    views = 3
    turned = torch.linalg.qr(torch.randn(views, 3, 3, generator=generator))[0]
    c2w = torch.cat([turned, torch.randn(views, 3, 1, generator=generator)], dim=-1)
    focal, center = 50.0 + 10.0 * torch.rand(views, 2, generator=generator), torch.tensor([[40.0, 30.0]] * views)
    lens = torch.tensor([0.1, -0.03, 0.01, -0.002, 0.003, -0.004]) * torch.rand(views, 6, generator=generator)
    size, near = torch.full((views,), 80), torch.rand(views, generator=generator)
    for model in LENSES:
        cameras = Cameras(c2w, focal, center, lens, model, size, size)
        double = cameras.map(lambda each: each.double() if each.is_floating_point() else each)
        for shape in ((rays,), (3, 5), (1,), (0,)):
            view, x, y = (torch.randint(limit, shape, generator=generator) for limit in (views, 80, 60))
            pixels = PixelIndex(view, x, y)
            expected = rays_through_pixels(double, pixels, near, 2 * near, None, 2)
            given = (each.to(device) for each in (cameras, pixels, near, 2 * near))
            found = kernels.rays_through_pixels(*given, None, 2)
            for one, other in zip(found.tensors(), expected.tensors(), strict=True):
                torch.testing.assert_close(one.cpu().double(), other.double(), rtol=2e-6, atol=1e-6)
    for wants in (cameras.c2w, cameras.lens):
        given = pixels, near, 2 * near
        assert kernels.rays_through_pixels(cameras, *given) is not None
        assert kernels.rays_through_pixels(double, *given) is None
        wants.requires_grad_()
        assert kernels.rays_through_pixels(cameras, *given) is None
        wants.requires_grad_(False)

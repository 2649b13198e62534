"""The triton kernels that make batches and rays against their references."""

from types import SimpleNamespace

import torch

from nerf_lightning.data.ray_batches import PixelDomain, gather_batch
from nerf_lightning.nerf.geometry.cameras import rays_through_pixels
from nerf_lightning.nerf.kernels.rays.cuda import LENSES
from nerf_lightning.nerf.types.rays import PixelIndex
from nerf_lightning.nerf.types.scene import Cameras, PixelStore


def check_pixels(kernels, device, generator, rays):
    """Bit for bit, the last pixel and no pixel included."""
    width, height = torch.tensor([[7, 300, 1, 40], [5, 2, 9, 30]])
    sizes = width * height
    total = int(sizes.sum())
    rgba = torch.randint(256, (total, 4), generator=generator).to(torch.uint8)
    offset = sizes.cumsum(0) - sizes
    for mask in (None, torch.randint(2, (total,), generator=generator).to(torch.uint8)):
        scene = SimpleNamespace(pixels=PixelStore(rgba, offset, width, height, True, mask))
        for views, fraction, count in (([0, 1, 2, 3], 1.0, None), ([3], 0.5, None), ([2, 0], 0.5, 1), ([0], 1.0, 0)):
            domain = PixelDomain(scene, views, fraction)
            number = torch.arange(len(domain)) if count is None else torch.full((count,), len(domain) - 1)
            given = number, domain.ends, domain.width, domain.views, domain.left, domain.top
            expected = domain.locate(number)
            found = kernels.locate(*(each.to(device) for each in given))
            shown = gather_batch(scene, expected)
            arrays = offset, width, rgba
            read = kernels.gather(
                *found, *(each.to(device) for each in arrays), None if mask is None else mask.to(device)
            )
            for one, other in zip((*found, *read), (*expected.tensors(), shown.rgba, shown.weight), strict=True):
                assert torch.equal(one.cpu(), other)


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
            found = kernels.rays_through_pixels(*given, 2)
            for one, other in zip(found.tensors(), expected.tensors(), strict=True):
                torch.testing.assert_close(one.cpu().double(), other.double(), rtol=2e-6, atol=1e-6)
    for wants in (cameras.c2w, cameras.lens):
        assert kernels.takes(cameras)
        assert not kernels.takes(double)
        wants.requires_grad_()
        assert not kernels.takes(cameras)
        wants.requires_grad_(False)

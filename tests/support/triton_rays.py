"""The triton kernels that make rays against their references."""

import torch

from nerf_lightning.nerf.geometry.cameras import rays_through_pixels
from nerf_lightning.nerf.kernels.rays.cuda import LENSES
from nerf_lightning.nerf.types.rays import PixelIndex
from nerf_lightning.nerf.types.scene import Cameras


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

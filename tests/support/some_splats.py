"""Splats of all sizes and shapes, and a camera in their midst."""

import torch

from nerf_lightning.extensions.splats.gaussians import Gaussians, Pinhole


def camera(width=33, height=21, focal=30.0):
    return Pinhole(torch.eye(3), torch.zeros(3), (focal, focal), (width / 2, height / 2), width, height, 0.1)


def some(count=40, degree=3, dtype=torch.float32):
    """Splats of all sizes and shapes, before and beside the camera, some behind it."""
    generator = torch.Generator().manual_seed(5)

    def normal(*shape):
        return torch.randn(*shape, generator=generator, dtype=torch.float64)

    means = normal(count, 3) * torch.tensor([1.0, 0.8, 1.5]) + torch.tensor([0.0, 0.0, 3.0])
    rest = (
        -2.5 + 0.8 * normal(count, 3),
        normal(count, 4),
        2 * normal(count),
        0.5 * normal(count, 3),
        0.5 * normal(count, (degree + 1) ** 2 - 1, 3),
    )
    return Gaussians(means, *rest).map(lambda each: each.to(dtype))

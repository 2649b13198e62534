"""Scenes and models small enough to be trained in a test."""

from dataclasses import replace

import torch

from nerf_lightning.nerf.encoders.frequency import FrequencyEncoder
from nerf_lightning.nerf.fields.nerf_mlp import NerfMLP
from nerf_lightning.nerf.geometry.cameras import all_pixels, pinhole_cameras, rays_through_pixels
from nerf_lightning.nerf.geometry.poses import look_at
from nerf_lightning.nerf.models.dense_level import DenseLevel
from nerf_lightning.nerf.models.radiance_model import RadianceModel
from nerf_lightning.nerf.samplers.importance import ImportanceSampler
from nerf_lightning.nerf.samplers.stratified import StratifiedSampler
from nerf_lightning.nerf.types.rays import RayBundle
from nerf_lightning.nerf.types.scene import PixelStore, Scene

BALL_RADIUS = 0.8
LENSES = [
    ("radial_tangential", (-0.5, 0.4, 0.0, 0.0, 0.004, -0.003)),
    ("radial_tangential", (0.4, 0.1, 0.0, 0.0, 0.0, 0.0)),
    ("fisheye", (0.1, -0.02, 0.0, 0.0, 0.0, 0.0)),
]


def ball_scene(
    num_views: int = 6, size: int = 12, background: str = "white", lens=(0.0,) * 6, lens_model="pinhole"
) -> Scene:
    """A ball whose color is its normal, seen from a circle; half the views train, the rest validate and test."""
    angle = torch.linspace(0, 2 * torch.pi, num_views + 1)[:-1]
    eyes = 4.0 * torch.stack([angle.cos(), angle.sin(), torch.full_like(angle, 0.4)], dim=-1)
    c2w = look_at(eyes, torch.zeros_like(eyes), torch.tensor([0.0, 0.0, 1.0]))
    cameras = pinhole_cameras(c2w, 1.6 * size, size, size)
    cameras = replace(cameras, lens=torch.tensor([lens] * num_views), lens_model=lens_model)
    near, far = torch.full((num_views,), 2.0), torch.full((num_views,), 6.5)
    pictures = []
    for view in range(num_views):
        rays = rays_through_pixels(cameras, all_pixels(cameras, view), near, far)
        along = -(rays.origins * rays.directions).sum(-1)
        closest = rays.origins + along[..., None] * rays.directions
        half = (BALL_RADIUS**2 - closest.square().sum(-1)).clamp(min=0).sqrt()
        normal = (closest - half[..., None] * rays.directions) / BALL_RADIUS
        hit = (half > 0).float()[..., None]
        pictures.append(torch.cat([(0.5 + 0.5 * normal).clamp(0, 1) * hit, hit], dim=-1))
    rgba = (torch.stack(pictures) * 255).round().to(torch.uint8).reshape(-1, 4)
    views = tuple(range(num_views))
    half = max(1, num_views // 2)
    sizes = torch.full((num_views,), size)
    return Scene(
        name="ball",
        cameras=cameras,
        pixels=PixelStore(rgba, torch.arange(num_views) * size * size, sizes, sizes, has_transparency=True),
        near=near,
        far=far,
        aabb=torch.tensor([[-1.0] * 3, [1.0] * 3]),
        splits={"train": views[:half], "val": views[half:], "test": views[half:]},
        view_names=tuple(f"ball_{view}" for view in views),
        background=background,
        to_user=torch.eye(4, dtype=torch.float64),
        protocol={},
        truth=None,
    )


def tiny_field(**changes) -> NerfMLP:
    """An MLP of three layers of 16."""
    settings = {"depth": 3, "width": 16, "skip": 2} | changes
    return NerfMLP(FrequencyEncoder(4), FrequencyEncoder(2), **settings)


def tiny_model(**changes) -> RadianceModel:
    """Coarse and fine with 8 and 8 more samples."""
    torch.manual_seed(1)
    return RadianceModel(
        {
            "coarse": DenseLevel(StratifiedSampler(8), tiny_field(**changes)),
            "fine": DenseLevel(ImportanceSampler(8), tiny_field(**changes)),
        }
    )


def some_rays(count: int, generator: torch.Generator | None = None) -> RayBundle:
    """Rays from a sphere of radius 4 toward the middle."""
    eyes = torch.nn.functional.normalize(torch.randn(count, 3, generator=generator), dim=-1) * 4
    aim = 0.3 * torch.randn(count, 3, generator=generator)
    directions = torch.nn.functional.normalize(aim - eyes, dim=-1)
    return RayBundle(
        origins=eyes,
        directions=directions,
        near=torch.full((count,), 2.0),
        far=torch.full((count,), 6.0),
        view_directions=directions,
    )

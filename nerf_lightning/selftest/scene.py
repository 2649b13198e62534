"""The scene of the self-test: a ball colored by its normals, traced on the fly."""

import torch

from nerf_lightning.nerf.geometry.cameras import all_pixels, pinhole_cameras, rays_through_pixels
from nerf_lightning.nerf.geometry.poses import look_at
from nerf_lightning.nerf.types.scene import PixelStore, Scene

RADIUS = 0.8
NUM_VIEWS, SIZE = 10, 20
FOCAL = 1.6 * SIZE
TRAIN, HELD_OUT = tuple(range(8)), (8, 9)


def ball_scene() -> Scene:
    """Return ten small views from a circle, with alpha; eight are for training, two are held out."""
    angle = 2.4 * torch.arange(NUM_VIEWS)  # the golden angle: all parts of the views are spread over the circle
    eyes = 4.0 * torch.stack([angle.cos(), angle.sin(), 0.4 + 0.0 * angle], dim=-1)
    cameras = pinhole_cameras(look_at(eyes, torch.zeros_like(eyes), torch.tensor([0.0, 0.0, 1.0])), FOCAL, SIZE, SIZE)
    near, far = torch.full((NUM_VIEWS,), 2.0), torch.full((NUM_VIEWS,), 6.5)
    pictures = []
    for view in range(NUM_VIEWS):
        rays = rays_through_pixels(cameras, all_pixels(cameras, view), near, far)
        along = -(rays.origins * rays.directions).sum(-1)
        closest = rays.origins + along[..., None] * rays.directions
        half = (RADIUS**2 - closest.square().sum(-1)).clamp(min=0).sqrt()
        normal = (closest - half[..., None] * rays.directions) / RADIUS
        hit = (half > 0).float()[..., None]
        pictures.append(torch.cat([(0.5 + 0.5 * normal).clamp(0, 1) * hit, hit], dim=-1))
    rgba = (torch.stack(pictures) * 255).round().to(torch.uint8).reshape(-1, 4)
    sizes = torch.full((NUM_VIEWS,), SIZE)
    return Scene(
        name="ball",
        cameras=cameras,
        pixels=PixelStore(rgba, torch.arange(NUM_VIEWS) * SIZE**2, sizes, sizes, has_transparency=True),
        near=near,
        far=far,
        aabb=torch.tensor([[-1.0] * 3, [1.0] * 3]),
        splits={"train": TRAIN, "val": HELD_OUT, "test": HELD_OUT},
        view_names=tuple(f"ball_{view}" for view in range(NUM_VIEWS)),
        background="random",
        to_user=torch.eye(4, dtype=torch.float64),
        protocol={},
        truth=None,
    )

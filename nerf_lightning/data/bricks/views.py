"""The cameras of the bricks: spread over the upper hemisphere for training, an orbit for the test."""

import math

import torch
from jaxtyping import Float
from torch import Tensor

from nerf_lightning.geometry.cameras import focal_from_fov, pinhole_cameras
from nerf_lightning.geometry.poses import look_at
from nerf_lightning.types.scene import Cameras

DISTANCE = 4.0311
"""From each camera to the origin, as in the Blender scenes."""
FIELD_OF_VIEW = 0.6911112070083618
"""Horizontal, in radians, as in the Blender scenes."""
LOWEST, HIGHEST = 0.05, 0.97
"""Sine of the elevation: above the horizon, short of the pole, where a picture has no upright."""
PLASTIC = 1.32471795724474602596
"""Root of x^3 = x + 1; its powers spread points evenly over a square, however many are taken."""


def bricks_cameras(train: int, val: int, test: int, resolution: int) -> Cameras:
    """Return square views that look at the origin: train first, then val, then test.

    Train and val are successive points of one additive recurrence, so val lies in the gaps of train.
    """
    index = torch.arange(train + val, dtype=torch.float64)
    sphere = _on_sphere((0.5 + index / PLASTIC) % 1, LOWEST + (HIGHEST - LOWEST) * ((0.5 + index / PLASTIC**2) % 1))
    eyes = DISTANCE * torch.cat([sphere, _orbit(test)])
    up = torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64)
    c2w = look_at(eyes, torch.zeros_like(eyes), up).float()
    return pinhole_cameras(c2w, focal_from_fov(resolution, FIELD_OF_VIEW), resolution, resolution)


def _orbit(num_views: int) -> Float[Tensor, "views 3"]:
    """Once around, rising and sinking twice, between 14 and 46 degrees of elevation."""
    turn = (torch.arange(num_views, dtype=torch.float64) + 0.4) / max(num_views, 1)
    elevation = math.radians(30) + math.radians(16) * torch.sin(4 * math.pi * turn)
    return _on_sphere(turn, elevation.sin())


def _on_sphere(turn: Float[Tensor, "views"], height: Float[Tensor, "views"]) -> Float[Tensor, "views 3"]:
    radius = (1 - height**2).sqrt()
    angle = 2 * math.pi * turn
    return torch.stack([radius * angle.cos(), radius * angle.sin(), height], dim=-1)

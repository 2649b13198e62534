"""Models whose surface is known: solids of constant density, given by their signed distance."""

from collections.abc import Callable
from dataclasses import replace

import torch
from support.scenes import ball_scene

from nerf_lightning.nerf.fields.base import Field
from nerf_lightning.nerf.models.dense_level import DenseLevel
from nerf_lightning.nerf.models.radiance_model import RadianceModel
from nerf_lightning.nerf.models.ray_generator import RayGenerator
from nerf_lightning.nerf.models.render_image import render_picture
from nerf_lightning.nerf.samplers.stratified import StratifiedSampler
from nerf_lightning.nerf.types.renderings import FieldOutput

INSIDE = 400.0
"""Density well inside."""
SOFT = 0.01
"""Width of the surface, scene units."""

Distance = Callable[[torch.Tensor], torch.Tensor]


def red_and_green(positions: torch.Tensor) -> torch.Tensor:
    """Red where x > 0, else green."""
    red = (positions[..., :1] > 0).float()
    return torch.cat([red, 1 - red, torch.zeros_like(red)], dim=-1)


class SolidField(Field):
    """Dense where a signed distance is negative; the same color from all sides."""

    def __init__(self, distance: Distance, color: Callable = red_and_green, inside: float = INSIDE):
        super().__init__()
        self.distance, self.color, self.inside = distance, color, inside
        self.place_of_the_model = torch.nn.Parameter(torch.zeros(1))

    def density(self, points):
        return self.inside * torch.sigmoid(-self.distance(points.positions) / SOFT), None

    def forward(self, points, features=None):
        return FieldOutput(self.density(points)[0], self.color(points.positions))

    def reset_parameters(self):
        pass


def solid(distance: Distance, samples: int = 192, **settings) -> RadianceModel:
    """A model of one level."""
    return RadianceModel({"fine": DenseLevel(StratifiedSampler(samples), SolidField(distance, **settings))}).eval()


def ball(radius: float = 0.8, center=(0.0, 0.0, 0.0)) -> Distance:
    """The signed distance of a ball."""
    return lambda positions: (positions - torch.tensor(center)).norm(dim=-1) - radius


def photographed_ball(size: int = 24, **lens):
    """A soft ball and what eight cameras see of it, all of which train: gradients of its pictures are exact."""
    model = solid(lambda positions: 0.1 * ball()(positions), 64, color=lambda positions: 0.5 + 0.4 * positions.sin())
    scene = ball_scene(num_views=8, size=size, background="black", **lens)
    rays_of = RayGenerator(scene.cameras, scene.near, scene.far)
    pictures = torch.stack([render_picture(model, rays_of, view, "black", 1 << 20).rgb for view in range(8)])
    rgba = torch.cat([pictures, torch.ones(8, size, size, 1)], dim=-1).clamp(0, 1)
    pixels = replace(scene.pixels, rgba=(255 * rgba).round().to(torch.uint8).view(-1, 4), has_transparency=False)
    return replace(scene, pixels=pixels, splits={"train": tuple(range(8))}), model

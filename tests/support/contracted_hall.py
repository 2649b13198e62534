"""A ball amid fog that grows dense outside of the scene's box: what a scene without bounds is."""

from dataclasses import replace

import torch
from support.known_fields import ball
from support.shiny_ball import RADIUS, all_around, shiny_model

DENSE = 5.0
"""So far out the fog has half its density, of 100 inside of the ball; at 3 it stops most of the light."""


def hall_scene(size: int = 32):
    """Cameras outside of the box, of half a side 1, and in the fog, looking at the ball."""
    scene = all_around(size)
    c2w = scene.cameras.c2w.clone()
    c2w[:, :, 3] *= 0.5
    views = torch.ones(len(c2w))
    cameras = replace(scene.cameras, c2w=c2w)
    return replace(scene, cameras=cameras, space="contracted", near=0.05 * views, far=6.0 * views, background="black")


def hall_model():
    def soft(positions):
        return torch.minimum(0.2 * ball(RADIUS)(positions), 0.02 * (DENSE - positions.norm(dim=-1)))

    return shiny_model(soft)

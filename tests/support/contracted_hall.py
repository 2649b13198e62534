"""A ball in a hall that is larger than the scene's box: what a scene without bounds is."""

from dataclasses import replace

import torch
from support.baked_ball import RADIUS, all_around, record_of, shiny_model
from support.known_fields import ball

WALL = 3.0


def hall_scene(size: int = 32):
    """Cameras between the box, of half a side 1, and the wall, looking at the ball."""
    scene = all_around(size)
    c2w = scene.cameras.c2w.clone()
    c2w[:, :, 3] *= 0.5
    views = torch.ones(len(c2w))
    cameras = replace(scene.cameras, c2w=c2w)
    return replace(scene, cameras=cameras, space="contracted", near=0.05 * views, far=6.0 * views, background="black")


def hall_model():
    def soft(positions):
        return 0.2 * torch.minimum(ball(RADIUS)(positions), WALL - positions.norm(dim=-1))

    return shiny_model(soft)


def hall_record():
    return record_of(hall_scene())

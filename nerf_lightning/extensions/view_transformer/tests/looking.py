"""A model of many scenes small enough for tests, and its inputs."""

from dataclasses import replace

import torch
from support.scenes import ball_scene

from nerf_lightning.extensions.view_transformer.model import ViewTransformer
from nerf_lightning.nerf.geometry.cameras import all_pixels, rays_through_pixels
from nerf_lightning.nerf.geometry.photographs import photographs_of
from nerf_lightning.nerf.samplers.stratified import StratifiedSampler

SETTINGS = {"width": 16, "blocks": 2, "heads": 2, "num_sources": 3, "image_features": 8, "image_scale": 2}


def looking_model(scene=None, views=range(6), **changes) -> ViewTransformer:
    """A model of seeded weights, looking at views of a scene."""
    torch.manual_seed(1)
    model = ViewTransformer(StratifiedSampler(6), **(SETTINGS | {"image_width": 8, "image_blocks": 1} | changes))
    model.set_source_images(photographs_of(ball_scene() if scene is None else scene, list(views)))
    return model


def rays_of_views(scene, views, every=7):
    """Some rays of views, view by view, each of which knows its view."""
    parts = []
    for view in views:
        pixels = all_pixels(scene.cameras, view).map(lambda picture: picture.flatten()[::every])
        rays = rays_through_pixels(scene.cameras, pixels, scene.near, scene.far)
        parts.append(replace(rays, photograph=pixels.view))
    names = ("origins", "directions", "near", "far", "view_directions", "photograph", "pixel_side")
    return replace(parts[0], **{name: torch.cat([getattr(part, name) for part in parts]) for name in names})

"""Cameras that are wrong by a known amount, and how wrong they are."""

import math
from dataclasses import replace

import numpy as np
import torch
from support.alignment import pose_errors

from nerf_lightning.nerf.geometry.poses import rotation_from_vector


def with_noise(scene, degrees, share, views=None, seed=0):
    """The scene with each camera (or these) turned by so many degrees, and shifted by a share of its distance."""
    c2w, draw = scene.cameras.c2w.clone(), torch.Generator().manual_seed(seed)
    turn, shift = (torch.nn.functional.normalize(torch.randn(len(c2w), 3, generator=draw), dim=1) for _ in range(2))
    for view in range(len(c2w)) if views is None else views:
        distance = c2w[view, :, 3].norm()
        c2w[view, :, :3] = c2w[view, :, :3] @ rotation_from_vector(math.radians(degrees) * turn[view])
        c2w[view, :, 3] += share * distance * shift[view]
    return replace(scene, cameras=replace(scene.cameras, c2w=c2w))


def mean_errors(found, true, views):
    """Mean errors of aligned training cameras: of their centers, in true units, and in degrees."""
    found, true = (poses[list(views)].detach().double().numpy() for poses in (found, true))
    return [float(np.mean(errors)) for errors in pose_errors(found, true)]

"""How much of space is modelled: a box, what lies in front of a near plane, or everything; and which model suits it."""

from dataclasses import replace
from typing import Literal

import torch
from torch.nn import functional

from nerf_lightning.data.captures.capture import Capture
from nerf_lightning.messages.errors import InputError
from nerf_lightning.nerf.geometry.cameras import coarse_pixels, rays_through_pixels
from nerf_lightning.nerf.geometry.frames import FORWARD_FACING, least_agreement
from nerf_lightning.nerf.types.scene import Cameras, Scene, Space

# The same of all pixels' rays, one of which would never reach infinity in normalised device coordinates at 0.
LEAST_AHEAD = 0.1
IN_A_BOX, PHOTOGRAPHS = "fast", "fast_proposal"
"""The models of model=auto."""


def choose_space(
    asked: Space | Literal["auto"], cameras: Cameras, capture: Capture, has_transparency: bool
) -> tuple[Space, str]:
    """Return the space, and why.

    Raises:
        InputError: NDC was asked for and cannot work.
    """
    cosine, ahead = least_agreement(cameras.c2w), least_ahead(cameras) > LEAST_AHEAD
    if asked == "ndc" and not ahead:
        raise InputError(
            f"scene.space=ndc needs cameras that all look the same way, but some pixels of {capture.source} look "
            "sideways or back. Use scene.space=contracted, or auto."
        )
    if asked != "auto":
        return asked, "as asked"
    if has_transparency:
        return "bounded", "since the pictures have transparent pixels: nothing lies behind the content"
    if ahead and cosine > FORWARD_FACING and capture.bounds is not None:
        return "ndc", "since all cameras look the same way and the capture gives depths"
    if ahead and cosine > FORWARD_FACING and len(capture.points):
        return "ndc", "since all cameras look the same way and sparse points give depths"
    return "contracted", "since the photographs show whatever lies behind the content"


def least_ahead(cameras: Cameras) -> float:
    """Return the least cosine between a pixel's ray and the cameras' mean direction, over a coarse grid of pixels."""
    cameras = replace(cameras, c2w=cameras.c2w.float())
    zeros = torch.zeros(cameras.c2w.shape[0])
    rays = rays_through_pixels(cameras, coarse_pixels(cameras), zeros, zeros)
    return float((rays.directions @ -functional.normalize(cameras.c2w[:, :, 2].mean(dim=0), dim=0)).min())


def model_for(scene: Scene) -> tuple[str, str]:
    """Return the model that suits a scene, as model=auto chooses it, and why."""
    if scene.space == "bounded":
        return IN_A_BOX, "the scene stands in a box"
    return PHOTOGRAPHS, "the photographs show whatever lies behind the content"

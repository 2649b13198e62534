"""The directions from which cameras look at the middle of what they see."""

from dataclasses import replace

import torch
from jaxtyping import Float
from torch import Tensor

from nerf_lightning.nerf.geometry.world_frame import middle_of_cameras
from nerf_lightning.nerf.types.scene import Scene, SceneRecord


def middle_of(scene: SceneRecord) -> Float[Tensor, "3"]:
    """Return the middle that the views are around: that of the box, or where the cameras' axes meet."""
    if scene.space == "bounded":
        return scene.aabb.mean(dim=0)
    if scene.space == "ndc" and isinstance(scene, Scene) and len(scene.points):
        return scene.points.median(dim=0).values
    if scene.space == "ndc":
        return torch.tensor([0.0, 0.0, -2.0])
    return middle_of_cameras(replace(scene.cameras, c2w=scene.cameras.c2w.double())).float()


def directions_seen(scene: SceneRecord) -> tuple[Float[Tensor, "views"], Float[Tensor, "views"]]:
    """Return azimuth (from x toward y) and elevation in degrees of each camera, as seen from the middle."""
    x, y, z = (scene.cameras.c2w[:, :, 3] - middle_of(scene)).unbind(dim=-1)
    return torch.atan2(y, x).rad2deg(), torch.atan2(z, (x.square() + y.square()).sqrt()).rad2deg()

"""How much of space is modelled: a box, what lies in front of a near plane, or everything."""

from jaxtyping import Float
from torch import Tensor
from torch.nn import functional

from nerf_lightning.data.capture import Capture
from nerf_lightning.errors import InputError
from nerf_lightning.types import Cameras, Space

# Cosine of the widest angle between a camera and the mean direction of forward-facing cameras (about 35 degrees).
FORWARD_FACING = 0.82


def choose_space(asked: str, cameras: Cameras, capture: Capture, has_transparency: bool) -> tuple[Space, str]:
    """Return the space, and why.

    Raises:
        InputError: NDC was asked for and cannot work.
    """
    cosine = least_agreement(cameras.c2w)
    if asked == "ndc":
        if cosine <= 0:
            raise InputError(
                f"scene.space=ndc needs cameras that all look the same way, but some of {capture.source} look back. "
                "Use scene.space=contracted, or auto."
            )
        return "ndc", "as asked"
    if asked == "bounded":
        return "bounded", "as asked"
    if asked == "contracted":
        return "contracted", "as asked"
    if has_transparency:
        return "bounded", "since the pictures have transparent pixels: nothing lies behind the content"
    if cosine > FORWARD_FACING and capture.bounds is not None:
        return "ndc", "since all cameras look the same way and the capture gives depths"
    if cosine > FORWARD_FACING and len(capture.points):
        return "ndc", "since all cameras look the same way and sparse points give depths"
    return "contracted", "since the photographs show whatever lies behind the content"


def least_agreement(c2w: Float[Tensor, "views 3 4"]) -> float:
    """Return the cosine between the mean direction of the cameras and the camera that is farthest from it.

    >>> import torch
    >>> least_agreement(torch.eye(4)[:3].repeat(2, 1, 1))
    1.0
    """
    back = c2w[:, :, 2]
    return float((back @ functional.normalize(back.mean(dim=0), dim=0)).min())

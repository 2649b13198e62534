"""The photographs of a scene, for a model that renders from them, and what follows from their positions."""

from collections.abc import Sequence

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from nerf_lightning.messages.errors import InputError
from nerf_lightning.nerf.geometry.world_frame import FORWARD_FACING, least_agreement, middle_of_cameras
from nerf_lightning.nerf.types.photographs import Photographs
from nerf_lightning.nerf.types.scene import Cameras, PixelStore, Scene


def photographs_of(scene: Scene, views: Sequence[int]) -> Photographs:
    """Return some photographs of a scene, each with its capture.

    Args:
        scene: one capture, or several that were joined.
        views: numbers of the photographs that may be used; usually the trained ones.

    Raises:
        InputError: the rays are in normalized device coordinates, where no photograph was taken.
    """
    if scene.cameras.ndc is not None:
        raise InputError(
            f"The scene {scene.name} was read in normalized device coordinates, but a model that looks at photographs "
            "sends its rays through the world: add scene.space=contracted."
        )
    numbers = torch.tensor(views, dtype=torch.int64)
    capture = torch.tensor(scene.capture_of or [0] * len(scene.view_names), dtype=torch.int64)[numbers]
    cameras, store = scene.cameras[numbers], scene.pixels
    pixels = PixelStore(
        store.rgba, store.offset[numbers], store.width[numbers], store.height[numbers], store.has_transparency
    )
    middle, around = _stands(cameras, capture, max(1, len(scene.captures)))
    return Photographs(cameras, pixels, numbers, capture, scene.background, middle, around)


def _stands(
    cameras: Cameras, capture: Int[Tensor, "views"], count: int
) -> tuple[Float[Tensor, "captures 3"], Bool[Tensor, "captures"]]:
    # What the cameras of each capture look at, and whether they surround it.
    middle, around = torch.zeros(count, 3), torch.zeros(count, dtype=torch.bool)
    for number in capture.unique().tolist():
        its_own = cameras[capture == number]
        middle[number] = middle_of_cameras(its_own)
        ahead = its_own.lens_model == "equirectangular" or least_agreement(its_own.c2w) > FORWARD_FACING
        around[number] = not ahead
    return middle, around

"""Frames for compositing as EXR, by OpenEXR: colours in linear light, and depth, as floats."""

from collections.abc import Mapping
from importlib import import_module
from pathlib import Path
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from nerf_lightning.files.atomic import whole_file
from nerf_lightning.messages.errors import InputError
from nerf_lightning.nerf.models.render_image import Picture
from nerf_lightning.nerf.rendering.linear_light import to_linear

NOTHING = 1e10
"""The depth of a pixel that stops less than half of the light, as Blender writes it."""
COMMENTS = "R, G, B: linear light. Z: distance from the camera in {unit}, 1e10 where nothing is."


def exr_channels(
    picture: Picture, depth: Float[Tensor, "height width"] | None, colors: bool, alpha: bool
) -> dict[str, Float[Tensor, "height width"]]:
    """Return what a frame holds, by the names that compositors know.

    Args:
        picture: the view; where alpha is wanted, rendered over black.
        depth: of what stops the light, for channel Z; None: without it.
        colors: whether to hold R, G and B.
        alpha: whether to hold A too; then colours are multiplied with it, as EXR has them.
    """
    channels: dict[str, Tensor] = {}
    if colors:
        opacity = picture.opacity[..., None]
        straight = picture.rgb / opacity.clamp(min=1e-4) if alpha else picture.rgb
        rgb = to_linear(straight.clamp(0, 1)) * (opacity if alpha else 1.0)
        channels |= zip("RGB", rgb.unbind(dim=-1), strict=True)
        if alpha:
            channels["A"] = picture.opacity.clamp(0, 1)
    if depth is not None:
        channels["Z"] = torch.where(picture.opacity > 0.5, depth, NOTHING)
    return channels


def save_exr(path: Path, channels: Mapping[str, Float[Tensor, "height width"]], unit: str) -> None:
    """Write one frame, whose depth is in `unit`, in 32-bit floats: whole or not at all. Missing folders are made.

    Raises:
        InputError: OpenEXR is not installed.
        OSError: the disk is full, or cannot be written.
    """
    openexr = require_openexr()
    header = {
        "compression": openexr.ZIP_COMPRESSION,
        "type": openexr.scanlineimage,
        "comments": COMMENTS.format(unit=unit),
    }
    content = {name: values.float().contiguous().numpy() for name, values in channels.items()}
    with whole_file(path) as part:
        try:
            openexr.File(header, content).write(str(part))
        except RuntimeError as error:  # what its library throws, a full disk among it
            raise OSError(str(error)) from error


def require_openexr() -> Any:
    """Return the module.

    Raises:
        InputError: it is not installed.
    """
    try:
        return import_module("OpenEXR")
    except ImportError as error:
        raise InputError(
            f"format=exr needs OpenEXR, which is not installed or does not load here ({error}). Install it with: "
            "pip install 'nerf-lightning[exr]'"
        ) from error

"""Frames for compositing as EXR, with OpenEXR: colors in linear light, and depth, as floats."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from nerf_lightning.files.atomic import whole_file
from nerf_lightning.messages.errors import require_extra
from nerf_lightning.nerf.models.render_image import Picture
from nerf_lightning.nerf.rendering.linear_light import to_linear

NOTHING = 1e10  # The depth of a pixel that stops less than half of the light, as in Blender.


def exr_channels(
    picture: Picture, depth: Float[Tensor, "height width"] | None, colors: bool, alpha: bool
) -> dict[str, Float[Tensor, "height width"]]:
    """Return a frame's channels by the names that compositors use: Z for `depth`, R, G, B for `colors`, A for `alpha`.

    With alpha, colors are premultiplied, as in EXR; the picture must then have been rendered over black.
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
    """Write one frame, whose depth is in `unit`, in 32-bit floats, whole or not at all. Missing folders are created."""
    openexr = require_openexr()
    comments = f"R, G, B: linear light. Z: distance from the camera in {unit}, 1e10 where nothing is."
    header = {"compression": openexr.ZIP_COMPRESSION, "type": openexr.scanlineimage, "comments": comments}
    content = {name: values.float().contiguous().numpy() for name, values in channels.items()}
    with whole_file(path) as part:
        try:
            openexr.File(header, content).write(str(part))
        except RuntimeError as error:  # what its library throws, including for a full disk
            raise OSError(str(error)) from error


def require_openexr() -> Any:
    """Return the module, or say how to install it."""
    return require_extra("OpenEXR", "exr", "format=exr")

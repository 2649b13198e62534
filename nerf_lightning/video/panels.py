"""The panels of a film: what is shown of a rendered view, and how panels form a picture.

Colors of depth and errors: `visualization/pictures.py`.
"""

from collections.abc import Iterable, Mapping, Sequence

import torch
from jaxtyping import Float, UInt8
from torch import Tensor
from torch.nn.functional import pad

from nerf_lightning.messages.errors import InputError
from nerf_lightning.nerf.models.render_image import Picture
from nerf_lightning.visualization.pictures import (
    PAPER,
    depth_picture,
    error_picture,
    faded,
    framed,
    letter_size,
    side_by_side,
    to_bytes,
    with_caption,
)

FILMS = {"rgb": "video", "depth": "depth", "opacity": "opacity", "normals": "normals", "levels": "levels"}
"""Outputs of every model, and the names of their films. Any other name is a channel of the model's field."""


def panel(
    output: str,
    picture: Picture,
    depth_range: tuple[float, float],
    unit: float,
    normals: Float[Tensor, "height width 3"] | None,
) -> UInt8[Tensor, "height width 3"]:
    """Return one output of a view (a key of `FILMS`, or a channel) as a picture; scales are inside it.

    `levels` is the absolute difference of the first level that makes pictures and the last; `normals` are the
    surface's, as colors: 0.5 + 0.5 n along the axes of the capture's own frame. `depth_range` is near and far of the
    depth's colors, in meters or the user's units, of which `unit` make one of the scene's units.
    """
    if output == "depth":
        return depth_picture(unit * picture.depth, *depth_range, picture.opacity, scale_inside=True)
    if output == "opacity":
        return to_bytes(picture.opacity[..., None].expand(-1, -1, 3))
    if output == "normals" and normals is not None:
        return to_bytes(faded(0.5 + 0.5 * normals, picture.opacity))
    if output == "levels" and picture.first_rgb is not None:
        return error_picture(picture.first_rgb, picture.rgb, scale_inside=True)
    return to_bytes(picture.rgb) if output in FILMS else channel_picture(output, picture)


def channel_picture(name: str, picture: Picture) -> UInt8[Tensor, "height width 3"]:
    """Return a channel as a picture: one number per pixel in gray, three as colors, more in the color of the largest.

    Numbers are shown as they are, from 0 to 1.
    """
    if name not in picture.channels:
        known = [*FILMS, *picture.channels]
        raise InputError(f"outputs: this model shows no {name}. Choose one or more of {', '.join(known)}.")
    values = picture.channels[name]
    if values.shape[-1] in (1, 3):
        return to_bytes(values.expand(*values.shape[:-1], 3))
    hues = torch.arange(values.shape[-1]) / values.shape[-1]
    colors = 0.5 + 0.5 * torch.cos(2 * torch.pi * (hues[:, None] + torch.tensor([0.0, 1 / 3, 2 / 3])))
    return to_bytes(faded(colors[values.argmax(dim=-1)], picture.opacity))


def film_pictures(
    panels: Sequence[Mapping[str, UInt8[Tensor, "_ _ 3"]]], labels: Sequence[str], mosaic: bool
) -> dict[str, UInt8[Tensor, "_ _ 3"]]:
    """Return a frame of each film by the film's name.

    Args:
        panels: for each model its panels by output.
        labels: names of the models; if there are several, their panels are side by side under their names.
        mosaic: one film, with a column for each output and a row for each model.
    """
    several = len(panels) > 1
    size = letter_size(next(iter(panels[0].values())).shape[0])

    def row(captioned: Iterable[tuple[UInt8[Tensor, "_ _ 3"], str]]) -> UInt8[Tensor, "_ _ 3"]:
        return side_by_side([with_caption(picture, text, size) for picture, text in captioned], gap=size)

    if mosaic:
        named = zip(panels, [f"{label} | " if several else "" for label in labels], strict=True)
        titles = {name: "color" if name == "rgb" else name for name in panels[0]}
        rows = [row((each[name], prefix + title) for name, title in titles.items()) for each, prefix in named]
        width = max(each.shape[1] for each in rows)
        below = [pad(each, (0, 0, 0, width - each.shape[1], 0, size), value=PAPER) for each in rows]
        return {"mosaic": framed(torch.cat(below)[:-size], size)}
    if not several:
        return {FILMS.get(name, name): picture for name, picture in panels[0].items()}
    beside = {name: row(zip((each[name] for each in panels), labels, strict=True)) for name in panels[0]}
    return {FILMS.get(name, name): framed(picture, size) for name, picture in beside.items()}

"""Pictures: floats to bytes, scalars to colors, panels side by side.

A picture is uint8 (height, width, 3) on the CPU, row 0 on top; colors before that are floats in [0, 1].
"""

import math
from collections.abc import Iterable, Iterator, Sequence
from functools import cache
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float, UInt8
from PIL import Image, ImageDraw, ImageFont
from torch import Tensor

from nerf_lightning.files.atomic import whole_file
from nerf_lightning.messages.escaping import for_terminal
from nerf_lightning.nerf.row_chunks import row_chunks

ENOUGH_PIXELS = 1 << 18  # Enough for the range of what is visible
ERROR_SCALE = 0.25  # Absolute error of the brightest color: always the same, so that runs can be compared.

LONGEST_PANEL = 1600
"""Approximate maximum length in pixels of the longer side of a panel of the validation picture: a row of four
photographs would be larger than any display."""

CAPTIONS = {"truth": "photograph", "true_depth": "true depth", "error": "color error"}
"""Of panels, where their names differ."""
PAPER = 255
DARK, LIGHT = 24, (225, 225, 225)
_INK = (64, 64, 64)
_BACKDROP = 0.93  # Gray where no ray hits: no color of the map is gray, so it reads as neither near nor far.


def to_bytes(rgb: Float[Tensor, "*h w c"]) -> UInt8[Tensor, "*h w c"]:
    """Return colors in [0, 1] as bytes on the CPU: clamped, then rounded to nearest; NaN becomes black.

    >>> to_bytes(torch.tensor([[-1.0, 0.5, 2.0]])).tolist()
    [[0, 128, 255]]
    """
    picture = torch.empty(rgb.shape, dtype=torch.uint8)
    for rows in row_chunks(len(rgb), max(1, rgb[:1].numel())):
        picture[rows] = (torch.nan_to_num(rgb[rows].detach().float()).clamp(0, 1) * 255).round().to(torch.uint8).cpu()
    return picture


def straight_colors(
    rgb: Float[Tensor, "height width 3"], opacity: Float[Tensor, "height width"]
) -> UInt8[Tensor, "height width 4"]:
    """Return straight colors and alpha of a picture rendered over black; where nothing is seen, all four are 0.

    >>> straight_colors(torch.tensor([[[0.25, 0.0, 0.5]]]), torch.tensor([[0.5]])).tolist()
    [[[128, 0, 255, 128]]]
    """
    alpha = opacity[..., None]
    shown = alpha > 0.5 / 255  # nonzero in bytes
    return to_bytes(torch.where(shown, torch.cat([rgb / alpha.clamp(min=0.5 / 255), alpha], dim=-1), 0.0))


def save_png(path: Path, picture: UInt8[Tensor, "height width *channels"]) -> None:
    """Write a gray, RGB or straight RGBA picture as PNG, whole or not at all. Missing folders are created."""
    with whole_file(path) as part:
        Image.fromarray(picture.numpy()).save(part, format="PNG")


def color_map(values: Float[Tensor, "height width"], low: float, high: float) -> Float[Tensor, "height width 3"]:
    """Return colors, dark at `low` and bright at `high`, perceptually uniform in between (matplotlib's magma).

    `low` may exceed `high`: `color_map(depth, far, near)` shows near as bright. Values outside the range take its end
    colors; NaN takes the color of `low`.
    """
    span = high - low if high != low else 1.0
    place = torch.nan_to_num((values.detach().float().cpu() - low) / span, nan=0.0).clamp(0, 1)
    return _colors()[(place * (len(_colors()) - 1)).round().long()]


def side_by_side(pictures: Sequence[UInt8[Tensor, "_ _ 3"]], gap: int = 4) -> UInt8[Tensor, "height width 3"]:
    """Return pictures in one row, with `gap` white pixels in between; shorter ones are aligned at the bottom."""
    height = max(picture.shape[0] for picture in pictures)
    width = sum(picture.shape[1] for picture in pictures) + gap * (len(pictures) - 1)
    row = torch.full((height, width, 3), PAPER, dtype=torch.uint8)
    left = 0
    for picture in pictures:
        row[height - picture.shape[0] :, left : left + picture.shape[1]] = picture
        left += picture.shape[1] + gap
    return row


def visible_range(depth: Float[Tensor, "height width"], opacity: Float[Tensor, "height width"]) -> tuple[float, float]:
    """Return near and far (scene units) of what is visible: opacity above one half.

    The outer 2 % at each end are left out, so that a few stray points do not dominate the scale. If nothing is visible,
    it is the range of the whole picture. For a large picture only some rows and columns are used.
    """
    every = max(1, math.isqrt(depth.numel() // ENOUGH_PIXELS))
    depth, opacity = (each[::every, ::every] for each in (depth, opacity))
    seen = depth[(opacity > 0.5) & depth.isfinite()].detach().double().cpu().numpy()
    if seen.size == 0:
        seen = torch.nan_to_num(depth.detach().double(), posinf=0.0).cpu().numpy()
    near, far = np.percentile(seen, [2, 98])
    return float(near), float(far)


def joint_range(pictures: Iterable[tuple[Float[Tensor, "*pixels"], Float[Tensor, "*pixels"]]]) -> tuple[float, float]:
    """Return near and far of what is visible in several pictures, given the depth and opacity of each."""
    depth, opacity = (torch.cat([each.flatten() for each in parts]) for parts in zip(*pictures, strict=True))
    return visible_range(depth[None], opacity[None])


def depth_picture(
    depth: Float[Tensor, "height width"],
    near: float,
    far: float,
    opacity: Float[Tensor, "height width"] | None = None,
    scale_inside: bool = False,
) -> UInt8[Tensor, "height wider 3"]:
    """Return depth in colors, near bright, with its scale on the right or in the upper right corner.

    If `opacity` is given, colors fade to pale gray where light passes through.
    """
    picture = torch.empty(*depth.shape, 3, dtype=torch.uint8)
    for rows in row_chunks(*depth.shape):
        colors = color_map(depth[rows], low=far, high=near)
        picture[rows] = to_bytes(colors if opacity is None else faded(colors, opacity[rows]))
    ends = f"{near:.3g}", f"{far:.3g}"
    if not scale_inside:  # Inside, letters cover a part of the picture.
        ends = f"near {ends[0]}", f"far {ends[1]}"
    return _with_scale(picture, *ends, scale_inside)


def faded(
    colors: Float[Tensor, "height width 3"], opacity: Float[Tensor, "height width"]
) -> Float[Tensor, "height width 3"]:
    """Return colors that fade to pale gray where light passes through."""
    shown = opacity.detach().float().cpu().clamp(0, 1)[..., None]
    return colors * shown + _BACKDROP * (1 - shown)


def error_picture(
    truth: Float[Tensor, "height width 3"], render: Float[Tensor, "height width 3"], scale_inside: bool = False
) -> UInt8[Tensor, "height wider 3"]:
    """Return the absolute error (mean of the channels) in colors, 0 to `ERROR_SCALE`, with its scale."""
    picture = torch.empty(truth.shape, dtype=torch.uint8)
    for rows in row_chunks(*truth.shape[:2]):
        error = (truth[rows].detach().float().cpu() - render[rows].detach().float().cpu()).abs().mean(dim=-1)
        picture[rows] = to_bytes(color_map(error, 0.0, ERROR_SCALE))
    return _with_scale(picture, f"{ERROR_SCALE:.3g}", "0", scale_inside)


def panels(
    truth: Float[Tensor, "height width 3"],
    render: Float[Tensor, "height width 3"],
    depth: Float[Tensor, "height width"],
    opacity: Float[Tensor, "height width"],
    depth_range: tuple[float, float] | None = None,
    true_depth: Float[Tensor, "height width"] | None = None,
) -> Iterator[tuple[str, UInt8[Tensor, "height wider 3"]]]:
    """Yield truth, render, depth, true depth if it is known, and error, with their names.

    They come one after another: a large one takes much memory. `depth_range` is near and far of the colors of both
    depths; None: what is visible here.
    """
    near, far = depth_range or visible_range(depth, opacity)
    yield "truth", to_bytes(truth)
    yield "render", to_bytes(render)
    yield "depth", depth_picture(depth, near, far, opacity)
    if true_depth is not None:
        yield "true_depth", depth_picture(true_depth, near, far, true_depth.isfinite().float())
    yield "error", error_picture(truth, render)


def mosaic(named: Iterable[tuple[str, UInt8[Tensor, "_ _ 3"]]]) -> UInt8[Tensor, "taller wider 3"]:
    """Return panels in a row, with a caption above each; large ones are shrunk (`at_most`)."""
    small = [(CAPTIONS.get(name, name), at_most(panel)) for name, panel in named]
    size = letter_size(small[0][1].shape[0])
    return framed(side_by_side([with_caption(panel, caption, size) for caption, panel in small], gap=size), size)


def framed(picture: UInt8[Tensor, "height width 3"], size: int) -> UInt8[Tensor, "taller wider 3"]:
    """Return the picture with a white border of half of `size`."""
    return torch.nn.functional.pad(picture, (0, 0, *(4 * [size // 2])), value=PAPER)


def at_most(
    picture: UInt8[Tensor, "height width 3"], longest: int = LONGEST_PANEL
) -> UInt8[Tensor, "small_height small_width 3"]:
    """Return the picture, shrunk to half, a third, ... by means over squares if a side is longer than `longest`."""
    by = -(-max(picture.shape[:2]) // longest)
    if by == 1:
        return picture
    return torch.from_numpy(np.array(Image.fromarray(picture.numpy()).reduce(by)))


@cache
def _colors() -> Float[Tensor, "256 3"]:
    # Only here: other pictures do not need matplotlib, which is slow to import.
    from matplotlib import colormaps

    return torch.tensor(colormaps["magma"](np.arange(256))[:, :3], dtype=torch.float32)


def letter_size(height: int) -> int:
    """Return a font size (pixels), legible next to a small picture and unobtrusive next to a large one."""
    return max(10, round(0.03 * height))


def with_caption(picture: UInt8[Tensor, "height width 3"], text: str, size: int) -> UInt8[Tensor, "taller wider 3"]:
    """Return the picture under a line of text with a font size of `size` pixels."""
    font, text = ImageFont.load_default(size), for_terminal(text)
    height, width, _ = picture.shape
    top = round(1.5 * size)
    page = Image.new("RGB", (max(width, round(font.getlength(text) + 0.5)), top + height), (PAPER,) * 3)
    page.paste(Image.fromarray(picture.numpy()), (0, top))
    ImageDraw.Draw(page).text((0, round(1.1 * size)), text, fill=_INK, font=font, anchor="ls")
    return torch.from_numpy(np.array(page))


def _with_scale(
    picture: UInt8[Tensor, "height width 3"], top: str, bottom: str, inside: bool
) -> UInt8[Tensor, "height wider 3"]:
    """Add a slim color bar, from bright at `top` down to dark, with both texts: on the right, or inside.

    Inside, it covers the upper right corner, since players' controls are below, and keeps the size; a picture too
    small for that has none.
    """
    size = letter_size(picture.shape[0])
    if not inside:
        return torch.cat([picture, _scale(picture.shape[0], size, top, bottom)], dim=1)
    margin = (0, 0, 0, 0, size // 3, size // 3)
    scale = torch.nn.functional.pad(_scale(5 * size // 2, size, top, bottom, DARK, LIGHT), margin, value=DARK)
    if scale.shape[0] <= picture.shape[0] // 2 and scale.shape[1] <= picture.shape[1] // 2:
        picture[: scale.shape[0], -scale.shape[1] :] = scale
    return picture


def _scale(
    height: int, size: int, top: str, bottom: str, paper: int = PAPER, ink: tuple[int, int, int] = _INK
) -> UInt8[Tensor, "height width 3"]:
    font = ImageFont.load_default(size)
    thick, space = max(4, size // 2), max(3, size // 3)
    longest = max(round(font.getlength(text) + 0.5) for text in (top, bottom))
    page = Image.new("RGB", (3 * space + thick + longest, height), (paper,) * 3)
    ramp = color_map(torch.linspace(1, 0, height)[:, None].expand(height, thick), 0.0, 1.0)
    page.paste(Image.fromarray(to_bytes(ramp).numpy()), (space, 0))
    draw, left = ImageDraw.Draw(page), 2 * space + thick
    # Round digits reach beyond their lines.
    draw.text((left, 1), top, fill=ink, font=font, anchor="lt")
    draw.text((left, height - 2), bottom, fill=ink, font=font, anchor="ls")
    return torch.from_numpy(np.array(page))

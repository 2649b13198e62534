"""What photographs look like: corners, described so that neighbouring photographs have them too, and a few numbers.

The corners are upright and of one scale: made for neighbours, of which a part may well fail, and not for structure from
motion.
"""

from dataclasses import dataclass

import torch
from jaxtyping import Float, Int
from torch import Tensor
from torch.nn import functional

from nerf_lightning.nerf.geometry.cameras import resized
from nerf_lightning.nerf.types.scene import Cameras, PixelStore

LONGER_SIDE = 288
"""Pixels of the longer side of the pictures that are looked at."""
MOST_CORNERS = 400
BORDER = 8
LEAST_CLEAR = 1e-6
DIRECTIONS = 8
# A descriptor looks at 4 x 4 places that lie so many pixels apart.
PLACES, SPACING = 4, 4.0
# A match must be this much better than the second best (of distances; Lowe, "Distinctive image features", 2004).
RATIO = 0.85
THUMBNAIL = 24
# Sharpness is judged at no more pixels than this along the longer side; finer detail is noise on many cameras.
SHARP_SIDE = 768


@dataclass(frozen=True)
class Corners:
    """What was found in one picture, the clearest first."""

    at: Float[Tensor, "corners 2"]
    """x and y in pixels of the shrunk picture; pixel centres at +0.5."""
    descriptor: Float[Tensor, "corners dims"]
    """Unit length."""
    rgb: Float[Tensor, "corners 3"]
    """Mean colour around the corner, in [0, 1]."""


def shrunk_cameras(cameras: Cameras) -> Cameras:
    """Return the cameras of the pictures that corners are looked for in."""
    scale = LONGER_SIDE / torch.maximum(cameras.width, cameras.height)
    width, height = ((scale * side).round().long().clamp(min=1) for side in (cameras.width, cameras.height))
    return resized(cameras, width, height)


def small_picture(pixels: PixelStore, view: int, width: int, height: int) -> Float[Tensor, "3 height width"]:
    """Return a view's colours (0 to 1) at another size; what is transparent or masked is middle grey."""
    rgba = pixels.view(view).float().permute(2, 0, 1) / 255
    cover = rgba[3]
    kept = pixels.kept(view)
    if kept is not None:
        cover = cover * kept
    rgb = 0.5 + (rgba[:3] - 0.5) * cover
    return functional.interpolate(rgb[None], (height, width), mode="bilinear", antialias=True)[0]


def brightness(picture: Float[Tensor, "3 *places"]) -> Float[Tensor, "*places"]:
    """Return the luma of colours (Rec. 601)."""
    return (picture.movedim(0, -1) @ picture.new_tensor([0.299, 0.587, 0.114])).contiguous()


def find_corners(picture: Float[Tensor, "3 height width"], most: int = MOST_CORNERS) -> Corners:
    """Return the places of one picture that are clear in both directions (Shi and Tomasi, 1994)."""
    grey = brightness(picture)
    gx, gy = _gradient(_blurred(grey[None], 0.8))
    xx, yy, xy = _blurred(torch.cat([gx * gx, gy * gy, gx * gy]), 1.5)
    clear = 0.5 * (xx + yy) - (0.25 * (xx - yy).square() + xy.square()).sqrt()
    peak = clear == functional.max_pool2d(clear[None], 5, stride=1, padding=2)[0]
    inside = torch.zeros_like(peak)
    inside[BORDER:-BORDER, BORDER:-BORDER] = True
    value, index = torch.where(peak & inside, clear, 0.0).flatten().topk(min(most, clear.numel()))
    index = index[value > LEAST_CLEAR]
    x, y = index % grey.shape[1], index // grey.shape[1]
    # The top of a parabola through the peak and its neighbours lies between the pixels.
    shift = torch.stack([_top(*(clear[y, x + k] for k in (-1, 0, 1))), _top(*(clear[y + k, x] for k in (-1, 0, 1)))])
    at = torch.stack([x, y], dim=-1) + 0.5 + shift.T
    return Corners(at, _described(gx[0], gy[0], at), _blurred(picture, 2.0)[:, y, x].T)


def _top(before: Float[Tensor, "corners"], here: Float[Tensor, "corners"], after: Float[Tensor, "corners"]) -> Tensor:
    bend = (2 * here - before - after).clamp(min=1e-12)
    return (0.5 * (after - before) / bend).clamp(-0.5, 0.5)


def match(first: Corners, second: Corners) -> Int[Tensor, "matches 2"]:
    """Return pairs of corners that are each other's nearest, and clearly nearer than the next."""
    if min(len(first.at), len(second.at)) < 2:
        return torch.zeros(0, 2, dtype=torch.long)
    similar = first.descriptor @ second.descriptor.T
    best, there = similar.topk(2, dim=1)
    back = similar.argmax(dim=0)
    distance = (1.0 - best).clamp(min=0)
    numbers = torch.arange(len(there))
    good = (back[there[:, 0]] == numbers) & (distance[:, 0] < RATIO**2 * distance[:, 1])
    return torch.stack([numbers, there[:, 0]], dim=-1)[good]


def _described(
    gx: Float[Tensor, "height width"], gy: Float[Tensor, "height width"], at: Float[Tensor, "corners 2"]
) -> Float[Tensor, "corners dims"]:
    # Slopes in eight directions, blurred, at 4 x 4 places around the corner (as in DAISY and SIFT).
    angle = torch.arange(DIRECTIONS) * (2 * torch.pi / DIRECTIONS)
    slopes = (angle.cos()[:, None, None] * gx + angle.sin()[:, None, None] * gy).clamp(min=0)
    slopes = _blurred(slopes, 0.5 * SPACING)
    step = (torch.arange(PLACES) - 0.5 * (PLACES - 1)) * SPACING
    around = torch.cartesian_prod(step, step)
    size = at.new_tensor([gx.shape[1], gx.shape[0]])
    places = 2.0 * (at[:, None] + around) / size - 1.0
    seen = functional.grid_sample(slopes[None], places[None], align_corners=False)[0]
    flat = functional.normalize(seen.permute(1, 2, 0).flatten(1), dim=-1)
    return functional.normalize(flat.clamp(max=0.25), dim=-1)


def _gradient(
    picture: Float[Tensor, "1 height width"],
) -> tuple[Float[Tensor, "1 height width"], Float[Tensor, "1 height width"]]:
    padded = functional.pad(picture[None], (1, 1, 1, 1), mode="replicate")[0]
    return 0.5 * (padded[:, 1:-1, 2:] - padded[:, 1:-1, :-2]), 0.5 * (padded[:, 2:, 1:-1] - padded[:, :-2, 1:-1])


def _blurred(pictures: Float[Tensor, "maps height width"], sigma: float) -> Float[Tensor, "maps height width"]:
    radius = int(3 * sigma + 0.5)
    kernel = torch.exp(-0.5 * (torch.arange(-radius, radius + 1) / sigma).square())
    weights = (kernel / kernel.sum()).tolist()
    padded = functional.pad(pictures[:, None], (radius,) * 4, mode="replicate")[:, 0]
    return _weighted(_weighted(padded, weights, 2), weights, 1)


def _weighted(padded: Float[Tensor, "maps rows columns"], weights: list[float], dim: int) -> Tensor:
    # Shifted pictures added up: on a CPU 20 times as fast as a convolution of one channel.
    size = padded.shape[dim] - len(weights) + 1
    total = padded.narrow(dim, 0, size) * weights[0]
    for place, weight in enumerate(weights[1:], 1):
        total.add_(padded.narrow(dim, place, size), alpha=weight)
    return total


@dataclass(frozen=True)
class Looks:
    """One row per view of the scene."""

    thumbnail: Float[Tensor, "views side side"]
    """Brightness, on middle grey where transparent or masked."""
    sharpness: Float[Tensor, "views"]
    """Power of the Laplacian as a share of the gradient's: how fine the detail is, however much of it there is."""
    kept: Float[Tensor, "views"]
    """Share of the pixels that the mask keeps."""
    covered: Float[Tensor, "views"]
    """Mean alpha."""
    border: Float[Tensor, "views 3"]
    """Median colour of the picture's edge."""
    border_even: Float[Tensor, "views"]
    """Share of the edge's pixels that have this colour, to two levels."""
    premultiplied: Float[Tensor, "views"]
    """Share of the half-transparent pixels whose colour is not brighter than their alpha; 1 with less than 20 such."""


def look_at_view(pixels: PixelStore, view: int, picture: Float[Tensor, "3 height width"]) -> tuple[Tensor, ...]:
    """Return one view's row, in the order of the fields; `picture` is the shrunk view."""
    rgba = pixels.view(view)
    kept = pixels.kept(view)
    edge = torch.cat([rgba[0], rgba[-1], rgba[:, 0], rgba[:, -1]])[:, :3].float()
    median = edge.median(dim=0).values
    even = ((edge - median).abs().amax(dim=-1) <= 2).float().mean()
    alpha = rgba[..., 3]
    return (
        functional.interpolate(brightness(picture)[None, None], (THUMBNAIL, THUMBNAIL), mode="area")[0, 0],
        sharpness_of(pixels, view),
        torch.tensor(1.0) if kept is None else kept.float().mean(),
        alpha.float().mean() / 255,
        median / 255,
        even,
        _premultiplied(rgba) if pixels.has_transparency else torch.tensor(1.0),
    )


def sharpness_of(pixels: PixelStore, view: int) -> Float[Tensor, ""]:
    """Return the power of the Laplacian over that of the gradient, where the photograph shows something."""
    rgba = pixels.view(view)
    step = max(1, -(-max(rgba.shape[:2]) // SHARP_SIDE))
    channels = rgba[..., [1, 3]].float().permute(2, 0, 1) / 255
    small = functional.avg_pool2d(channels, step) if step > 1 else channels
    grey, solid = small[0], small[1] > 0.99
    up, down, left, right = grey[:-2, 1:-1], grey[2:, 1:-1], grey[1:-1, :-2], grey[1:-1, 2:]
    laplacian = up + down + left + right - 4 * grey[1:-1, 1:-1]
    gradient = (right - left).square() + (down - up).square()
    # The outline against what is transparent is as sharp in a blurred photograph.
    inside = -functional.max_pool2d(-solid[None].float(), 5, stride=1, padding=2)[0, 1:-1, 1:-1]
    return (laplacian.square() * inside).sum() / (gradient * inside).sum().clamp(min=1e-9)


def _premultiplied(rgba: Tensor) -> Float[Tensor, ""]:
    alpha = rgba[..., 3]
    half = rgba[(alpha > 8) & (alpha < 160)]
    if len(half) < 20:
        return torch.tensor(1.0)
    return (half[:, :3].amax(dim=-1) <= half[:, 3].to(torch.int16) + 1).float().mean()

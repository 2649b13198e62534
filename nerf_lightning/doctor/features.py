"""Features of photographs: corners, with descriptors that match between neighbors, and a few numbers.

The corners are upright and of one scale: suited to neighbors, some of which may fail, and not to structure from motion.
"""

from dataclasses import dataclass

import torch
from jaxtyping import Float, Int, UInt8
from torch import Tensor
from torch.nn import functional

from nerf_lightning.nerf.geometry.cameras import resized
from nerf_lightning.nerf.types.scene import Cameras, PixelStore

LONGER_SIDE = 288  # Longer side in pixels of the examined pictures
MOST_CORNERS = 400
BORDER = 8
LEAST_CLEAR = 1e-6
DIRECTIONS = 8
# A descriptor samples 4 x 4 places at this spacing in pixels.
PLACES, SPACING = 4, 4.0
# A match must be this much better than the second best (of distances; Lowe, "Distinctive image features", 2004).
RATIO = 0.85
THUMBNAIL = 24
# Fine detail is measured at no more than this many pixels along the longer side, however photographs were shrunk; finer
# detail is noise on many cameras.
SHARP_SIDE = 480
# Standard deviations (pixels) of the blurs for fine and for coarse detail; pixels of the outline that are ignored;
# slope (per pixel, of 1) from which on there is texture, and the minimum number of textured pixels.
FINE, COARSE, OUTLINE = 0.7, 2.0, 3
LEAST_SLOPE, LEAST_TEXTURE = 0.002, 150


@dataclass(frozen=True)
class Corners:
    """The corners of one picture, the clearest first."""

    xy: Float[Tensor, "corners 2"]
    """In pixels of the shrunk picture; pixel centers at +0.5."""
    descriptor: Float[Tensor, "corners dims"]
    """Unit length."""
    rgb: Float[Tensor, "corners 3"]
    """Mean color around the corner, in [0, 1]."""


def shrunk_cameras(cameras: Cameras, longer_side: int = LONGER_SIDE) -> Cameras:
    """Return the cameras of the pictures in which corners are detected, which need not be smaller."""
    scale = longer_side / torch.maximum(cameras.width, cameras.height)
    width, height = ((scale * side).round().long().clamp(min=1) for side in (cameras.width, cameras.height))
    return resized(cameras, width, height)


def small_picture(pixels: PixelStore, view: int, width: int, height: int) -> Float[Tensor, "3 height width"]:
    """Return a view's colors (0 to 1) at another size; transparent or masked pixels are middle gray."""
    rgba = pixels.view(view).float().permute(2, 0, 1) / 255
    cover = rgba[3]
    kept = pixels.view_mask(view)
    if kept is not None:
        cover = cover * kept
    rgb = 0.5 + (rgba[:3] - 0.5) * cover
    return functional.interpolate(rgb[None], (height, width), mode="bilinear", antialias=True)[0]


def brightness(picture: Float[Tensor, "3 *places"]) -> Float[Tensor, "*places"]:
    """Return the luma of colors (Rec. 601)."""
    return (picture.movedim(0, -1) @ picture.new_tensor([0.299, 0.587, 0.114])).contiguous()


def find_corners(picture: Float[Tensor, "3 height width"], most: int = MOST_CORNERS) -> Corners:
    """Return the corners of one picture, which are distinct in both directions (Shi and Tomasi, 1994)."""
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
    # Subpixel position: the vertex of a parabola through the peak and its neighbors.
    shift = torch.stack([_top(*(clear[y, x + k] for k in (-1, 0, 1))), _top(*(clear[y + k, x] for k in (-1, 0, 1)))])
    positions = torch.stack([x, y], dim=-1) + 0.5 + shift.T
    return Corners(positions, _described(gx[0], gy[0], positions), _blurred(picture, 2.0)[:, y, x].T)


def _top(before: Float[Tensor, "corners"], here: Float[Tensor, "corners"], after: Float[Tensor, "corners"]) -> Tensor:
    bend = (2 * here - before - after).clamp(min=1e-12)
    return (0.5 * (after - before) / bend).clamp(-0.5, 0.5)


def match(first: Corners, second: Corners) -> Int[Tensor, "matches 2"]:
    """Return pairs of mutually nearest corners that are clearly nearer than the next."""
    if min(len(first.xy), len(second.xy)) < 2:
        return torch.zeros(0, 2, dtype=torch.long)
    similar = first.descriptor @ second.descriptor.T
    best, there = similar.topk(2, dim=1)
    back = similar.argmax(dim=0)
    distance = (1.0 - best).clamp(min=0)
    numbers = torch.arange(len(there))
    good = (back[there[:, 0]] == numbers) & (distance[:, 0] < RATIO**2 * distance[:, 1])
    return torch.stack([numbers, there[:, 0]], dim=-1)[good]


def _described(
    gx: Float[Tensor, "height width"], gy: Float[Tensor, "height width"], xy: Float[Tensor, "corners 2"]
) -> Float[Tensor, "corners dims"]:
    # Slopes in eight directions, blurred, at 4 x 4 places around the corner (as in DAISY and SIFT).
    angle = torch.arange(DIRECTIONS) * (2 * torch.pi / DIRECTIONS)
    slopes = (angle.cos()[:, None, None] * gx + angle.sin()[:, None, None] * gy).clamp(min=0)
    slopes = _blurred(slopes, 0.5 * SPACING)
    step = (torch.arange(PLACES) - 0.5 * (PLACES - 1)) * SPACING
    around = torch.cartesian_prod(step, step)
    size = xy.new_tensor([gx.shape[1], gx.shape[0]])
    places = 2.0 * (xy[:, None] + around) / size - 1.0
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
    # Sums of shifted pictures: on a CPU 20 times as fast as a convolution of one channel.
    size = padded.shape[dim] - len(weights) + 1
    total = padded.narrow(dim, 0, size) * weights[0]
    for place, weight in enumerate(weights[1:], 1):
        total.add_(padded.narrow(dim, place, size), alpha=weight)
    return total


@dataclass(frozen=True)
class Looks:
    """One row per view of the scene."""

    thumbnail: Float[Tensor, "views side side"]
    """Brightness; transparent or masked pixels are middle gray."""
    fineness: Float[Tensor, "views directions"]
    """Fineness of the detail, whatever its amount: see `fineness_of`."""
    unmasked: Float[Tensor, "views"]
    """Share of the pixels that the mask keeps."""
    covered: Float[Tensor, "views"]
    """Mean alpha."""
    border: Float[Tensor, "views 3"]
    """Median color of the picture's edge."""
    border_even: Float[Tensor, "views"]
    """Share of the edge's pixels that have this color, to two levels."""
    faint: Float[Tensor, "views 2"]
    """Number of nearly transparent pixels brighter than half of their alpha: up to alpha, and beyond."""


def look_at_view(pixels: PixelStore, view: int, picture: Float[Tensor, "3 height width"]) -> tuple[Tensor, ...]:
    """Return one view's row, in the order of the fields; `picture` is the shrunk view."""
    rgba = pixels.view(view)
    kept = pixels.view_mask(view)
    edge = torch.cat([rgba[0], rgba[-1], rgba[:, 0], rgba[:, -1]])[:, :3].float()
    median = edge.median(dim=0).values
    even = ((edge - median).abs().amax(dim=-1) <= 2).float().mean()
    alpha = rgba[..., 3]
    return (
        functional.interpolate(brightness(picture)[None, None], (THUMBNAIL, THUMBNAIL), mode="area")[0, 0],
        fineness_of(pixels, view),
        torch.tensor(1.0) if kept is None else kept.float().mean(),
        alpha.float().mean() / 255,
        median / 255,
        even,
        _faint(rgba) if pixels.has_transparency else torch.zeros(2),
    )


def fineness_of(pixels: PixelStore, view: int) -> Float[Tensor, "directions"]:
    """Return how fine the detail of a photograph is along each of eight directions of a half circle.

    It is the log of the power of the second derivative over that of the slopes of a blurred picture, in the textured
    half of what is neither transparent nor masked. Camera motion reduces it along one direction only. NaN: there is too
    little texture.
    """
    rgba, kept = pixels.view(view), pixels.view_mask(view)
    solid = rgba[..., 3] > 252 if kept is None else (rgba[..., 3] > 252) & kept
    both = torch.stack([rgba[..., 1] / 255, solid.float()])
    share = SHARP_SIDE / max(rgba.shape[:2])
    if share < 1.0:
        size = [max(1, round(share * side)) for side in rgba.shape[:2]]
        both = functional.interpolate(both[None], size, mode="bilinear", antialias=True)[0]
    grey, whole = both[:, None]
    # The outline of transparent areas is sharp even in a blurred photograph.
    rim = functional.max_pool2d(
        functional.pad((whole < 0.999).float(), (OUTLINE,) * 4, value=1.0), 2 * OUTLINE + 1, stride=1
    )
    slopes = torch.cat(_gradient(_blurred(grey, COARSE)))
    power = slopes.square().sum(dim=0)
    inside = rim[0] == 0
    textured = inside & (power > LEAST_SLOPE**2)
    if int(textured.sum()) < LEAST_TEXTURE:
        return torch.full((DIRECTIONS,), torch.nan)
    textured &= power >= power[inside].median()
    fine = _blurred(grey, FINE)
    padded = functional.pad(fine, (1, 1, 1, 1), mode="replicate")
    across = padded[:, 1:-1, 2:] + padded[:, 1:-1, :-2] - 2 * fine
    down = padded[:, 2:, 1:-1] + padded[:, :-2, 1:-1] - 2 * fine
    bends = torch.cat([across, 2 * _gradient(_gradient(fine)[0])[1], down])
    angle = torch.arange(DIRECTIONS) * (torch.pi / DIRECTIONS)
    c, s = angle.cos(), angle.sin()
    first = _power_along(torch.stack([c, s], dim=1), slopes[:, textured])
    return (_power_along(torch.stack([c * c, c * s, s * s], dim=1), bends[:, textured]) / first).log()


def _power_along(
    ways: Float[Tensor, "directions parts"], parts: Float[Tensor, "parts pixels"]
) -> Float[Tensor, "directions"]:
    return (ways @ (parts @ parts.T) * ways).sum(dim=1).clamp(min=1e-12)


def _faint(rgba: UInt8[Tensor, "height width 4"]) -> Float[Tensor, "2"]:
    alpha, brightest = rgba[..., 3].int(), rgba[..., :3].amax(dim=-1).int()
    faint = (alpha > 8) & (alpha < 64) & (2 * brightest > alpha)
    return torch.stack([(faint & (brightest <= alpha + 1)).sum(), (faint & (brightest > alpha + 1)).sum()]).float()

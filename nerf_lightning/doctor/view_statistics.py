"""What each photograph looks like, in a few numbers."""

from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn import functional

from nerf_lightning.doctor.features import brightness
from nerf_lightning.nerf.types.scene import PixelStore

THUMBNAIL = 24
# Sharpness is judged at no more pixels than this along the longer side; finer detail is noise on many cameras.
LONGER_SIDE = 768


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


def stacked(rows: list[tuple[Tensor, ...]]) -> Looks:
    """Return the rows as one."""
    return Looks(*(torch.stack(column) for column in zip(*rows, strict=True)))


def sharpness_of(pixels: PixelStore, view: int) -> Float[Tensor, ""]:
    """Return the power of the Laplacian over that of the gradient, where the photograph shows something."""
    rgba = pixels.view(view)
    step = max(1, -(-max(rgba.shape[:2]) // LONGER_SIDE))
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

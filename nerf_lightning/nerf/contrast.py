"""More rays where photographs show detail: of a few candidate pixels, one becomes a ray.

Most of the error lies along edges, which few evenly drawn pixels show. A candidate is chosen in proportion to its local
contrast, and its weight in the loss makes up for that: the expected gradient is that of evenly drawn pixels (resampled
importance sampling, Talbot et al. 2005, "Importance Resampling for Global Illumination", Eq. 6). All numbers are whole,
so every device chooses the same pixels.

How many candidates: `candidates` in conf/data/rays.yaml and in conf/model/.
`kernels/pixels/cpu.py` computes the same contrast.
"""

import torch
from jaxtyping import Float, UInt8
from torch import Tensor

from nerf_lightning.nerf.kernels.backends import with_kernel
from nerf_lightning.nerf.randomness import WORD, fold, mix
from nerf_lightning.nerf.types.rays import PixelIndex
from nerf_lightning.nerf.types.scene import PixelStore

FLAT, HIGHEST, SHIFT = 6, 255, 10
"""Shares of pixels without contrast, and of the highest; one more for every 2^10 of differences between colors."""


def shares(store: PixelStore) -> UInt8[Tensor, "pixels"]:
    """Return in proportion to what each pixel is chosen: by its differences from four neighbors; 0 if it is masked.

    Differences are of colors times alpha, and of alpha, in the channel where they are largest.
    """
    out = torch.zeros(len(store.rgba), dtype=torch.uint8, device=store.rgba.device)
    for view in range(len(store.width)):
        picture, mask = store.view(view), store.view_mask(view)
        share = contrast(picture)
        start = int(store.offset[view])
        out[start : start + share.numel()] = (share if mask is None else share * mask).flatten()
    return out


@with_kernel("pixels.cpu")
def contrast(rgba: UInt8[Tensor, "height width 4"]) -> UInt8[Tensor, "height width"]:
    """Return the shares of a picture's pixels, none of which is masked."""
    color = rgba.to(torch.int32)
    color = torch.cat([color[..., :3] * color[..., 3:], 255 * color[..., 3:]], dim=-1)
    change = torch.zeros_like(color)
    down, across = (color[1:] - color[:-1]).abs(), (color[:, 1:] - color[:, :-1]).abs()
    for part, step in ((change[1:], down), (change[:-1], down), (change[:, 1:], across), (change[:, :-1], across)):
        part += step
    return ((change.amax(dim=-1) >> SHIFT) + FLAT).clamp(max=HIGHEST).to(torch.uint8)


def choose(
    store: PixelStore, share_map: UInt8[Tensor, "pixels"], candidates: PixelIndex, places: range, key: int
) -> tuple[PixelIndex, Float[Tensor, "rays"]]:
    """Return one of each ray's candidates, and the rays' weights.

    Args:
        store: the photographs.
        share_map: their `shares`.
        candidates: pixels, equally many for each place, those of a place one after another.
        places: of the rays, in the run's order of rays.
        key: of the order.
    """
    each = len(candidates.view) // max(len(places), 1)
    of_all = share_map[store.index_of(candidates.view, candidates.x, candidates.y)].long().view(-1, each)
    first = torch.arange(len(places), device=of_all.device) * each
    chosen, share, total = first, torch.zeros_like(first), torch.zeros_like(first)
    chooser = fold(key, "contrast")
    for number, own in enumerate(of_all.unbind(dim=1)):
        word = mix(((first + number + places.start * each) & WORD) ^ chooser)
        total = total + own
        taken = (word >> 8) * total < (own << 24)
        chosen, share = torch.where(taken, first + number, chosen), torch.where(taken, own, share)
    return candidates[chosen], total.to(torch.float32) / (each * share).clamp(min=1).to(torch.float32)

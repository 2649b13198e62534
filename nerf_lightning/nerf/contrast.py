"""More rays where photographs show detail: of a few candidate pixels, one becomes a ray.

Most of the error lies along edges, which few evenly drawn pixels show. A candidate is chosen in proportion to its local
contrast, and its weight in the loss makes up for that: the expected gradient is that of evenly drawn pixels (resampled
importance sampling, Talbot et al. 2005, "Importance Resampling for Global Illumination", Eq. 6). All numbers are whole,
so every device chooses the same pixels.
"""

import torch
from jaxtyping import Float, Int
from torch import Tensor

from nerf_lightning.nerf.randomness import WORD, fold, mix
from nerf_lightning.nerf.types.rays import PixelIndex
from nerf_lightning.nerf.types.scene import PixelStore

FLAT = 6_500
"""The share of a pixel without contrast; a black pixel between four white ones has 260,100 more."""
NEIGHBORS = ((1, 0), (-1, 0), (0, 1), (0, -1))


def shares(store: PixelStore, pixels: PixelIndex) -> Int[Tensor, "*n"]:
    """Return in proportion to what pixels are chosen; 0 for masked ones."""
    width, height = store.width[pixels.view], store.height[pixels.view]

    def color(x: Tensor, y: Tensor) -> Int[Tensor, "*n 4"]:
        rgba = store.rgba[store.index_of(pixels.view, x, y)].to(torch.int32)
        return torch.cat([rgba[..., :3] * rgba[..., 3:], 255 * rgba[..., 3:]], dim=-1)

    here = color(pixels.x, pixels.y)
    around = (
        color((pixels.x + dx).clamp(min=0).minimum(width - 1), (pixels.y + dy).clamp(min=0).minimum(height - 1))
        for dx, dy in NEIGHBORS
    )
    contrast = torch.stack([(each - here).abs() for each in around]).sum(dim=0).amax(dim=-1)
    share = contrast.long() + FLAT
    return share if store.mask is None else share * store.mask[store.index_of(pixels.view, pixels.x, pixels.y)]


def choose(
    store: PixelStore, candidates: PixelIndex, places: range, key: int
) -> tuple[PixelIndex, Float[Tensor, "rays"]]:
    """Return one of each ray's candidates, and the rays' weights.

    Args:
        store: the photographs.
        candidates: pixels, equally many for each place, those of a place one after another.
        places: of the rays, in the run's order of rays.
        key: of the order.
    """
    each = len(candidates.view) // max(len(places), 1)
    first = torch.arange(len(places), device=candidates.view.device) * each
    chosen, share, total = first, torch.zeros_like(first), torch.zeros_like(first)
    all_shares = shares(store, candidates)
    for number in range(each):
        word = mix(((first + number + places.start * each) & WORD) ^ fold(key, "contrast"))
        own = all_shares[first + number]
        total = total + own
        taken = (word >> 8) * total < (own << 24)
        chosen, share = torch.where(taken, first + number, chosen), torch.where(taken, own, share)
    return candidates[chosen], total.to(torch.float32) / (each * share).clamp(min=1).to(torch.float32)

"""What tells a photograph's pixels from others: a hash of each."""

import hashlib

import torch
from jaxtyping import Int
from torch import Tensor

from nerf_lightning.data.pixels.mapped_store import CHECKED_WHOLE
from nerf_lightning.data.pixels.placement import num_bytes
from nerf_lightning.data.pixels.store import in_threads
from nerf_lightning.nerf.types.scene import PixelStore

THINNED = 1 << 28
"""Bytes that are hashed of pixels that are more than memory may hold (`CHECKED_WHOLE`): they come from the disk."""
NOTICEABLE = 1 << 31


def photograph_hashes(pixels: PixelStore) -> Int[Tensor, "views"]:
    """Return a hash (BLAKE2b, 64 bits) of each view's pixels and mask, as they are trained on.

    Of more than 4 GiB every k-th row counts, 256 MiB in all: a photograph that was exposed, sharpened or cropped anew
    is found, and one that was retouched in a few rows may not be.
    """
    total = num_bytes(pixels)
    step = 1 if total <= CHECKED_WHOLE else -(-total // THINNED)

    def digest(view: int) -> int:
        kept = pixels.kept(view)
        found = hashlib.blake2b(pixels.view(view)[::step].contiguous().numpy().data, digest_size=8)
        if kept is not None:
            found.update(kept[::step].contiguous().numpy().data)
        return int.from_bytes(found.digest(), "little", signed=True)

    shown = total > NOTICEABLE
    return torch.tensor(in_threads(digest, len(pixels.offset), "Comparing photographs", shown), dtype=torch.int64)

"""Batches of pixels in one kernel, where there is one; the reference is `data.ray_batches.RayBatches.at`."""

from typing import NamedTuple

import torch
from jaxtyping import Int
from torch import Tensor

from nerf_lightning.nerf.kernels.backends import cuda_backend
from nerf_lightning.nerf.types.rays import Batch, KnownDepths
from nerf_lightning.nerf.types.scene import PixelStore


class Order(NamedTuple):
    """Places in a row of things that follow each other anew in each epoch."""

    places: range
    size: int
    """Of an epoch, whose order is `randomness.permute` with the key `fold(*parts, epoch)`."""
    key: int
    """fold(*parts)."""


class Domain(NamedTuple):
    """The pixels that are numbered (`data.ray_batches.PixelDomain`)."""

    ends: Int[Tensor, "views"]
    """The number that follows each view's last pixel."""
    columns: Int[Tensor, "views"]
    """Pixels in a row of each view that are numbered."""
    views: Int[Tensor, "views"]
    """Which view each is."""
    left: Int[Tensor, "views"]
    """Column of its first numbered pixel."""
    top: Int[Tensor, "views"]
    """Row of it."""


NOWHERE = Order(range(0), 1, 0)


def has_kernel(device: torch.device) -> bool:
    """Return whether there is a kernel on a device."""
    return cuda_backend("pixels.cuda", device) is not None


def ordered_batch(
    rays: Order, domain: Domain, store: PixelStore, known: KnownDepths | None = None, of_known: Order = NOWHERE
) -> Batch:
    """Return the pixels at some places of the order of a domain, then those at some places of all of known distance.

    Where `has_kernel` says so.

    Args:
        rays: places in the domain.
        domain: what is numbered.
        store: all pixels.
        known: those whose distance is known; None: no distances are asked for.
        of_known: places among them.
    """
    kernels = cuda_backend("pixels.cuda", domain.ends.device)
    assert kernels is not None, "has_kernel is asked first"
    return kernels.batch(rays, domain, store, known, of_known)

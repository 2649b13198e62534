"""Batches of pixels in one kernel, if there is one; the reference is in `data.ray_batches.RayBatches.batch_at`."""

from collections.abc import Hashable
from typing import NamedTuple

import torch
from jaxtyping import Int, UInt8
from torch import Tensor

from nerf_lightning.nerf.kernels.backends import backend_for
from nerf_lightning.nerf.randomness import fold
from nerf_lightning.nerf.types.rays import Batch, KnownDepths, LazyBatch, PixelIndex
from nerf_lightning.nerf.types.scene import PixelStore


class Order(NamedTuple):
    """A range of places in a sequence that is reshuffled in each epoch."""

    places: range
    size: int
    """Size of an epoch, whose order is `randomness.permute` with the key `fold(*parts, epoch)`."""
    key: int
    """fold(*parts)."""
    candidates: int = 1
    """Numbers of the sequence for each place, of which contrast chooses one (`nerf.contrast.choose`)."""


class Domain(NamedTuple):
    """The pixels that are numbered (`data.ray_batches.PixelDomain`)."""

    ends: Int[Tensor, "views"]
    """The number that follows each view's last pixel."""
    columns: Int[Tensor, "views"]
    """Numbered pixels per row of each view."""
    views: Int[Tensor, "views"]
    """The view of each."""
    left: Int[Tensor, "views"]
    """Column of each view's first numbered pixel."""
    top: Int[Tensor, "views"]
    """Row of that pixel."""


NOWHERE = Order(range(0), 1, 0)


def has_kernel(device: torch.device) -> bool:
    """Return whether there is a kernel for a device."""
    return backend_for("pixels", device) is not None


def ordered_batch(
    rays: Order,
    domain: Domain,
    store: PixelStore,
    shares: UInt8[Tensor, "pixels"] | None = None,
    depths: KnownDepths | None = None,
    of_known: Order = NOWHERE,
    kind: Hashable = None,
) -> LazyBatch:
    """Return pixels at some places in the order of a domain, then some of those of known distance.

    Requires `has_kernel`.

    Args:
        rays: places in the domain.
        domain: the numbered pixels.
        store: all pixels.
        shares: by which one of the candidates is chosen (`nerf.contrast.shares`); needed if there are several.
        depths: pixels whose distance is known; None: no distances are needed.
        of_known: places among them.
        kind: the same for batches that differ in places and keys alone.
    """
    kernels = backend_for("pixels", domain.ends.device)
    assert kernels is not None, "has_kernel is asked first"
    count = len(rays.places) + len(of_known.places)
    chooser = fold(rays.key, "contrast")
    numbers = len(rays.places), rays.places.start, rays.key, chooser, of_known.places.start, of_known.key
    sizes = rays.size, of_known.size, rays.candidates
    device = domain.ends.device

    def gather(on_device: Int[Tensor, "6"]) -> Batch:
        batch = empty_batch(count, device, depths is not None)
        kernels.fill(batch, *sizes, domain, store, shares, depths, on_device)
        return batch

    return LazyBatch(count, numbers, kind, gather, device)


def empty_batch(count: int, device: torch.device, has_depths: bool) -> Batch:
    """Return a batch whose arrays hold anything."""
    view, x, y = torch.empty(3, count, dtype=torch.int64, device=device)
    rgba, weight = torch.empty(count, 4, device=device), torch.empty(count, device=device)
    distance, certainty = (torch.empty_like(weight) if has_depths else None for _ in range(2))
    return Batch(PixelIndex(view, x, y), rgba, weight, distance, certainty)

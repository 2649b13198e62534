"""Where pixels are during training: in memory, in a mapped file, or on the device if they fit."""

from dataclasses import replace
from typing import Literal

import torch
from jaxtyping import Shaped
from rich.progress import BarColumn, DownloadColumn, TimeRemainingColumn
from torch import Tensor

from nerf_lightning.compute.machine import free_memory
from nerf_lightning.messages.console import progress_bar
from nerf_lightning.nerf.types.scene import PixelStore, Scene

GIGABYTE = 1e9
PIXELS_SHARE_OF_FREE_MEMORY = 0.5
"""How much of a GPU's free memory pixels may take: the rest is for tables, activations and evaluation."""
CHUNK_BYTES = 1 << 26


def num_bytes(pixels: PixelStore) -> int:
    """Return the number of bytes of the pixels and their masks."""
    return pixels.rgba.nbytes + (0 if pixels.mask is None else pixels.mask.nbytes)


def budget_bytes(budget: int | float | Literal["auto"], device: torch.device) -> int:
    """Return how much device memory the pixels may take: `budget` gigabytes, or half of what is free."""
    if budget != "auto":
        return int(budget * GIGABYTE)
    return int(PIXELS_SHARE_OF_FREE_MEMORY * free_memory(device)) if device.type == "cuda" else 0


def on_device(scene: Scene, device: torch.device) -> Scene:
    """Return the scene with pixels, cameras, near and far on the device; a mapped file is read once, in parts."""
    pixels = scene.pixels
    columns = ("{task.description}", BarColumn(), DownloadColumn(), TimeRemainingColumn())
    with progress_bar(*columns, visible=num_bytes(pixels) > 16 * CHUNK_BYTES) as bar:
        task = bar.add_task(f"pixels to {device}", total=num_bytes(pixels))

        def copied(flat: Shaped[Tensor, "..."]) -> Shaped[Tensor, "..."]:
            out = torch.empty_like(flat, device=device)
            size = max(1, CHUNK_BYTES * len(flat) // flat.nbytes)
            for target, source in zip(out.split(size), flat.split(size), strict=True):
                target.copy_(source)
                bar.advance(task, source.nbytes)
            return out

        store = PixelStore(
            rgba=copied(pixels.rgba),
            offset=pixels.offset.to(device),
            width=pixels.width.to(device),
            height=pixels.height.to(device),
            has_transparency=pixels.has_transparency,
            mask=None if pixels.mask is None else copied(pixels.mask),
        )
    near, far = scene.near.to(device), scene.far.to(device)
    return replace(scene, cameras=scene.cameras.to(device), pixels=store, near=near, far=far)


def sent(tensor: Shaped[Tensor, "..."], device: torch.device) -> Shaped[Tensor, "..."]:
    """Return the tensor on the device; to a GPU via pinned memory, so that the host need not wait."""
    if device.type == "cuda":
        return tensor.pin_memory().to(device, non_blocking=True)
    return tensor.to(device)

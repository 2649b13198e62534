"""Fill the pixel store from picture files: one array for all of them, decoded straight into place."""

import os
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import torch
from rich.progress import BarColumn, MofNCompleteColumn, TimeRemainingColumn

from nerf_lightning.data.images import area_downscale, read_rgba
from nerf_lightning.data.progress import progress_bar
from nerf_lightning.types import PixelStore

# Decoding runs outside Python's lock. Each thread holds one picture: this bounds the memory beside the store.
MAX_THREADS = 4
NOTICEABLE = 50


def empty_store(sizes: Sequence[tuple[int, int]]) -> PixelStore:
    """Return a store with room for pictures of these sizes (width, height), its pixels not yet written."""
    width, height = torch.tensor(sizes, dtype=torch.int64).reshape(-1, 2).unbind(dim=1)
    area = width * height
    return PixelStore(
        rgba=torch.empty((int(area.sum()), 4), dtype=torch.uint8),
        offset=area.cumsum(dim=0) - area,
        width=width,
        height=height,
    )


def read_pixels(paths: Sequence[Path], sizes: Sequence[tuple[int, int]], downscale: int, label: str) -> PixelStore:
    """Return the pictures, each shrunk by `downscale`.

    Args:
        paths: the files, in the order of the views.
        sizes: (width, height) of each file, multiples of `downscale`.
        downscale: whole factor of the area filter; 1 keeps the pixels as they are.
        label: what is read, for the progress bar.

    Raises:
        InputError: a file cannot be decoded.
    """
    store = empty_store([(width // downscale, height // downscale) for width, height in sizes])

    def decode(index: int) -> None:
        store.view(index).numpy()[...] = area_downscale(read_rgba(paths[index]), downscale)

    columns = ("{task.description}", BarColumn(), MofNCompleteColumn(), TimeRemainingColumn())
    threads = min(MAX_THREADS, os.cpu_count() or 1)
    with progress_bar(*columns, shown=len(paths) > NOTICEABLE) as bar, ThreadPoolExecutor(threads) as pool:
        for _ in bar.track(pool.map(decode, range(len(paths))), total=len(paths), description=label):
            pass
    return store

"""Fill the pixel store from picture files: one array for all of them, decoded straight into place."""

from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import TypeVar

import torch
from jaxtyping import Int
from rich.markup import escape
from rich.progress import BarColumn, MofNCompleteColumn, TimeRemainingColumn
from torch import Tensor

from nerf_lightning.compute.cores import num_cores
from nerf_lightning.compute.machine import free_memory
from nerf_lightning.messages.console import progress_bar
from nerf_lightning.messages.errors import InputError
from nerf_lightning.messages.escaping import for_terminal
from nerf_lightning.nerf.types.scene import PixelStore

# Decoding releases the GIL. Each thread holds one picture: this bounds the memory besides the store.
MAX_THREADS = 4
NOTICEABLE = 50

Result = TypeVar("Result")


def layout(
    sizes: Sequence[tuple[int, int]],
) -> tuple[Int[Tensor, "views"], Int[Tensor, "views"], Int[Tensor, "views"]]:
    """Return offset, width and height of concatenated pictures; sizes are (width, height)."""
    width, height = torch.tensor(sizes, dtype=torch.int64).reshape(-1, 2).unbind(dim=1)
    area = width * height
    return area.cumsum(dim=0) - area, width, height


def empty_store(sizes: Sequence[tuple[int, int]]) -> PixelStore:
    """Return an uninitialized store for opaque pictures of these sizes (width, height)."""
    num_pixels = sum(width * height for width, height in sizes)
    free = free_memory()
    if 4 * num_pixels > free:
        raise InputError(
            f"{len(sizes)} pictures of {num_pixels / 1e6:,.0f} megapixels in all need {4 * num_pixels / 1e9:.1f} GB of "
            f"memory, and {free / 1e9:.1f} GB are free. Shrink them with scene.downscale, or read fewer."
        )
    return PixelStore(torch.empty((num_pixels, 4), dtype=torch.uint8), *layout(sizes), has_transparency=False)


def in_threads(work: Callable[[int], Result], count: int, label: str, visible: bool) -> list[Result]:
    """Return [work(0), ..., work(count - 1)], computed by a few threads, with a progress bar if `visible`."""
    columns = ("{task.description}", BarColumn(), MofNCompleteColumn(), TimeRemainingColumn())
    threads = min(MAX_THREADS, num_cores())
    with progress_bar(*columns, visible=visible) as bar, ThreadPoolExecutor(threads) as pool:
        return list(bar.track(pool.map(work, range(count)), total=count, description=escape(for_terminal(label))))


class UndecodableError(InputError):
    """Photographs that cannot be decoded, or masks that do not fit them: what is wrong with each, by index."""

    def __init__(self, faults: dict[int, str]):
        super().__init__(next(iter(faults.values())))
        self.faults = faults


def each_or_faults(work: Callable[[int], Result], count: int, label: str, visible: bool) -> list[Result]:
    """Return what `in_threads` does, and report all failures, not only the first."""
    faults: dict[int, str] = {}

    def tried(index: int) -> Result | None:
        try:
            return work(index)
        except InputError as error:
            faults[index] = str(error)
            return None

    results = in_threads(tried, count, label, visible)
    if faults:
        raise UndecodableError(dict(sorted(faults.items())))
    return [result for result in results if result is not None]

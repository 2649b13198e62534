"""What this machine has: memory, with work refused that would not fit, its peak so far, and seconds."""

import sys
import time
from bisect import bisect_right
from collections.abc import Callable
from typing import Any

import psutil
import torch

from nerf_lightning.errors import InputError

# Of the memory that is free, so much may be taken.
SHARE_OF_FREE = 0.8


def free_memory(device: torch.device | None = None) -> int:
    """Return how many bytes are free: of a GPU's memory where the device is one, else of the machine's."""
    if device is not None and device.type == "cuda":
        return int(torch.cuda.mem_get_info(device)[0])
    return int(psutil.virtual_memory().available)


def require_memory(what: str, size: int, needed: Callable[[int], float], named: Callable[[int], str]) -> None:
    """Refuse work that takes more memory than can be had; nothing is allocated to find out.

    Args:
        what: is asked for: the setting, and what it makes.
        size: the whole number that decides how much that takes.
        needed: returns the bytes that a size takes; no larger size takes less.
        named: returns the setting of a size as the user would write it.

    Raises:
        InputError: it says what is needed, what can be had, and what would fit.
    """
    bytes_needed, free = needed(size), SHARE_OF_FREE * free_memory()
    if bytes_needed <= free:
        return
    fitting = bisect_right(range(1, size), free, key=needed)
    cure = f"{named(fitting)} would fit." if fitting else "Not even the smallest would fit: make room."
    raise InputError(
        f"{what}, which takes {bytes_needed / 1e9:.1f} GB, and {free / 1e9:.1f} GB of memory can be had. {cure}"
    )


def peak_memory() -> float:
    """Return the most memory this process has held so far, in gigabytes; on a GPU the GPU's."""
    if torch.cuda.is_available():
        return torch.cuda.max_memory_allocated() / 1e9
    if sys.platform == "win32":
        return float(psutil.Process().memory_info().peak_wset) / 1e9
    import resource

    # Kilobytes on Linux, bytes on macOS.
    unit = 1 if sys.platform == "darwin" else 1024
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * unit / 1e9


def seconds_of(work: Callable[[], Any]) -> float:
    """Do the work, wait until the GPU has done its part, and return how long that took."""
    start = time.perf_counter()
    work()
    if torch.cuda.is_available():
        torch.cuda.synchronize()
    return time.perf_counter() - start

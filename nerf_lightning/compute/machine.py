"""Measure this machine: memory, refusing work that would not fit, its peak so far, and time."""

import re
import sys
import time
from bisect import bisect_right
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import psutil
import torch

from nerf_lightning.messages.errors import InputError

# The share of free memory that may be taken.
SHARE_OF_FREE = 0.8
# On Linux: where control groups are mounted, and which of them this process is in.
CONTROL_GROUPS, OWN_GROUPS = Path("/sys/fs/cgroup"), Path("/proc/self/cgroup")
# A group's limit and usage (bytes), in versions 2 and 1.
LIMIT_FILES = {2: ("memory.max", "memory.current"), 1: ("memory.limit_in_bytes", "memory.usage_in_bytes")}
# Files that the system caches while there is room: a group's own, and in version 1 those of the groups within it.
CACHED_FILES = {2: ("inactive_file", "active_file"), 1: ("total_inactive_file", "total_active_file")}


def free_memory(device: torch.device | None = None) -> int:
    """Return how many bytes are free: of the GPU's memory if the device is one, else of the machine's.

    In a container or a cluster job, the limits of its control groups apply.
    """
    if device is not None and device.type == "cuda":
        return int(torch.cuda.mem_get_info(device)[0])
    left = (_left_to_group(folder, version) for folder, version in _control_groups())
    return max(0, min([int(psutil.virtual_memory().available), *(bytes_ for bytes_ in left if bytes_ is not None)]))


def _control_groups() -> Iterator[tuple[Path, int]]:
    """Yield the groups whose limits apply to this process, each with its version: its own and all that enclose them.

    A container may see the path that its group has on the host, while its own files are at the top: missing files mean
    no limit, and the top is always among the enclosing groups.
    """
    try:
        lines = OWN_GROUPS.read_text(encoding="utf-8", errors="replace").splitlines()
    except OSError:
        return
    for line in lines:
        _, _, rest = line.partition(":")
        controllers, _, path = rest.partition(":")
        if controllers and "memory" not in controllers.split(","):
            continue
        top = CONTROL_GROUPS / "memory" if controllers else CONTROL_GROUPS
        own = top / path.lstrip("/")
        for folder in (own, *own.parents):
            if folder.is_relative_to(top):
                yield folder, 1 if controllers else 2


def _left_to_group(folder: Path, version: int) -> int | None:
    """Return how many bytes a group may still take, counting cached files as free; None if it has no limit."""
    try:
        limit, used = (int((folder / name).read_text()) for name in LIMIT_FILES[version])
        counts = dict(re.findall(r"^(\w+) (\d+)$", (folder / "memory.stat").read_text(), re.MULTILINE))
        return limit - used + sum(int(counts.get(name, 0)) for name in CACHED_FILES[version])
    except (OSError, ValueError):  # absent, or "max"
        return None


def require_memory(what: str, size: int, needed: Callable[[int], float], named: Callable[[int], str]) -> None:
    """Refuse work that takes more memory than is available, without allocating any.

    Args:
        what: the request, in words that begin a sentence: the setting, and what it makes.
        size: the whole number that determines how much memory that takes.
        needed: returns the bytes that a size takes; must not decrease with the size.
        named: returns the setting of a size as the user would write it.

    Raises:
        InputError: says what is needed, what is available, and what would fit.
    """
    bytes_needed, free = needed(size), SHARE_OF_FREE * free_memory()
    if bytes_needed <= free:
        return
    fitting = bisect_right(range(1, size), free, key=needed)
    cure = f"{named(fitting)} would fit." if fitting else "Even the smallest would not fit: free some memory."
    raise InputError(
        f"{what}, which takes {bytes_needed / 1e9:.1f} GB, but only {free / 1e9:.1f} GB of memory are available. {cure}"
    )


def peak_memory() -> float:
    """Return this process's peak memory so far, in gigabytes; with a GPU, the GPU's."""
    if torch.cuda.is_available():
        return torch.cuda.max_memory_allocated() / 1e9
    if sys.platform == "win32":
        return float(psutil.Process().memory_info().peak_wset) / 1e9
    import resource

    # Kilobytes on Linux, bytes on macOS.
    unit = 1 if sys.platform == "darwin" else 1024
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * unit / 1e9


def seconds_of(work: Callable[[], Any]) -> float:
    """Do the work, wait for the GPU to finish, and return the seconds that took."""
    start = time.perf_counter()
    work()
    if torch.cuda.is_available():
        torch.cuda.synchronize()
    return time.perf_counter() - start


@contextmanager
def torch_threads(count: int) -> Iterator[None]:
    """Let torch use `count` threads within the context."""
    former = torch.get_num_threads()
    torch.set_num_threads(count)
    try:
        yield
    finally:
        torch.set_num_threads(former)

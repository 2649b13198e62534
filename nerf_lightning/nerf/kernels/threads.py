"""Work shared among our own threads, each of which computes alone.

The kernels are single-threaded and release the GIL, as torch's own operations do. So whole tiles of a training step run
in parallel or, outside of tiles, the rows of one kernel. Results do not depend on which thread takes what: parts and
their order are fixed.
"""

import functools
import itertools
import os
import threading
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor, wait
from contextlib import contextmanager
from typing import Any, TypeVar

import torch

Part = TypeVar("Part")
Result = TypeVar("Result")

FEWEST_ROWS = 512
"""A part of fewer rows costs more to dispatch than to compute."""
PARTS_PER_THREAD = 4
"""More parts than threads, since some take longer than others."""


class _Local(threading.local):
    threads: int | None = None


_local = _Local()


def num_threads() -> int:
    """Return the number of threads that share work: as many as torch has, or had before `torch_on_one_thread`."""
    return torch.get_num_threads() if _local.threads is None else _local.threads


@contextmanager
def torch_on_one_thread(shares_out: bool = True) -> Iterator[None]:
    """Within the context, torch's own operations use one thread, and work shared here as many as before.

    Between our kernels torch has little to do, and its threads wait for one another in each operation: when another
    program takes one of the cores for a moment, all of them wait, which made steps four times as slow.

    Args:
        shares_out: whether `in_parallel` still uses several threads.
    """
    former, threads = _local.threads, torch.get_num_threads()
    _local.threads = num_threads() if shares_out else 1
    if threads > 1:
        torch.set_num_threads(1)
    try:
        yield
    finally:
        _local.threads = former
        if threads > 1:
            torch.set_num_threads(threads)


def in_parallel(work: Callable[[Part], Result], parts: Sequence[Part]) -> list[Result]:
    """Do the work on each part, on `num_threads()` threads, and return the results in order.

    The calling thread takes parts, too, so that small work is done before another thread wakes up. Within a part, torch
    and `in_parallel` use one thread. Of the caller's settings, only those of gradients apply in each thread. If the
    work raises, take no further parts and reraise.
    """
    threads = min(num_threads(), len(parts))
    if threads < 2:
        return [work(part) for part in parts]
    numbers, results, failed = itertools.count(), [None] * len(parts), []  # type: ignore[var-annotated]
    # Settings of the calling thread, which the pool's threads do not inherit.
    inference, gradients = torch.is_inference_mode_enabled(), torch.is_grad_enabled()

    def take_parts() -> None:
        with torch.inference_mode(inference), torch.set_grad_enabled(gradients):
            while (number := next(numbers)) < len(parts) and not failed:
                try:
                    results[number] = work(parts[number])  # type: ignore[call-overload]
                except BaseException:
                    failed.append(number)
                    raise

    others = [_pool(num_threads() - 1).submit(take_parts) for _ in range(threads - 1)]
    try:
        with torch_on_one_thread(shares_out=False):
            take_parts()
    finally:
        wait(others)
    for other in others:
        other.result()
    return results  # type: ignore[return-value]


def threads_on(device: torch.device) -> int:
    """Return how many parts of the work on a device run in parallel: on the CPU, as many as torch has threads."""
    return num_threads() if device.type == "cpu" else 1


def over_rows(kernel: Callable[..., Any], rows: int, *arrays: Any) -> None:
    """Call kernel(first, last, *arrays) for parts that together make up all rows."""
    in_parallel(lambda part: kernel(*part, *arrays), parts_of(rows, num_threads()))


def parts_of(rows: int, threads: int, fewest: int = FEWEST_ROWS) -> list[tuple[int, int]]:
    """Return the parts into which rows are split, of at least `fewest` rows; for one thread, a single part.

    >>> parts_of(4096, 1), parts_of(1200, 8)
    ([(0, 4096)], [(0, 600), (600, 1200)])
    """
    count = 1 if threads == 1 else max(1, min(PARTS_PER_THREAD * threads, rows // fewest))
    return [(rows * part // count, rows * (part + 1) // count) for part in range(count)]


@functools.cache
def _pool(threads: int) -> ThreadPoolExecutor:
    pool, all_there = ThreadPoolExecutor(threads, "tiles", initializer=_compute_alone), threading.Barrier(threads)
    former = torch.get_num_threads()
    list(pool.map(lambda _: all_there.wait(), range(threads)))
    torch.set_num_threads(former)  # of the calling thread, and the default of new ones: the pool's threads changed it
    return pool


def _compute_alone() -> None:
    torch.get_num_threads()  # else the thread's first query would reset it to the default
    torch.set_num_threads(1)


if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=_pool.cache_clear)  # a fork has none of its parent's threads

"""Prepare the process: threads, memory allocator, and warnings that do not concern the user."""

import ctypes
import logging
import sys
import warnings
from typing import Any

import torch

from nerf_lightning.cores import num_cores

ALL_THREADS = min(torch.get_num_threads(), num_cores())
M_MMAP_THRESHOLD = -3
M_TRIM_THRESHOLD = -1


def prepare_machine(num_threads: int | None) -> None:
    """Set threads and the allocator, once per process; None: one thread per core."""
    torch.set_num_threads(num_threads or ALL_THREADS)
    _keep_float32()
    _keep_large_blocks()
    _quiet_libraries()


def _keep_float32() -> None:
    # A product of float32 numbers is float32 everywhere, but where a field lowers its own (products.py). cuDNN would
    # lower convolutions, SSIM's among them, unless it is told not to.
    torch.set_float32_matmul_precision("highest")
    torch.backends.cudnn.allow_tf32 = False


def _keep_large_blocks() -> None:
    # glibc gives blocks of 32 MB and more back to the system at each free; fetching them anew costs more than the
    # arithmetic done in them (measured: 1.5 times the whole step).
    if sys.platform != "linux":
        return
    try:
        mallopt = ctypes.CDLL("libc.so.6").mallopt
    except (OSError, AttributeError):
        return
    mallopt(M_MMAP_THRESHOLD, 1 << 30)
    mallopt(M_TRIM_THRESHOLD, 2**31 - 1)


def _quiet_libraries() -> None:
    # Advice about data loader workers and the like, which does not apply: our loader is not a DataLoader.
    logging.getLogger("lightning.pytorch").setLevel(logging.WARNING)
    ignored: list[dict[str, Any]] = [
        {"message": ".*does not have many workers.*"},
        {"message": ".*LeafSpec.*", "category": FutureWarning},
        {"message": ".*isinstance.treespec, LeafSpec.*"},
        {"message": ".*ckpt_path.*mid-epoch.*"},
        {"message": ".*checkpoint that ended before the epoch ended.*"},
    ]
    for rule in ignored:
        warnings.filterwarnings("ignore", **rule)

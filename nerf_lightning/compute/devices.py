"""Choose the device, with the reason, and prepare the process for it."""

import ctypes
import logging
import os
import sys
import warnings
from typing import Any, Literal

import torch
from torch import distributed

from nerf_lightning.compute import xla_device
from nerf_lightning.compute.cores import num_cores
from nerf_lightning.messages.errors import InputError

log = logging.getLogger(__name__)

Accelerator = Literal["auto", "cpu", "gpu", "mps", "tpu"]
DeviceType = Literal["cpu", "cuda", "mps", "xla"]
LIGHTNING_NAMES: dict[DeviceType, str] = {"cpu": "cpu", "cuda": "gpu", "mps": "mps", "xla": "tpu"}
LEAST_GPU_MEMORY = 1_000_000_000
"""Bytes of GPU memory that must be free: tiles shrink to fit, but libraries and tables need some room."""


def choose_device(accelerator: Accelerator) -> tuple[DeviceType, str]:
    """Return the type of device and the reason; auto chooses a CUDA GPU if there is one, else the CPU.

    Raises:
        InputError: torch does not see the requested device.
    """
    if accelerator == "cpu":
        return "cpu", "as asked"
    if accelerator == "mps":
        if not torch.backends.mps.is_available():
            raise InputError(
                "trainer=mps: torch sees no Apple GPU here. It needs a Mac with Apple silicon and macOS 14 or later; "
                "use trainer=cpu or trainer=auto."
            )
        log.warning("trainer=mps has never been tested: compare its first losses with those of trainer=cpu.")
        return "mps", "as asked, untested"
    if accelerator == "tpu":
        return "xla", f"{xla_device.require_device()}, as asked"
    with warnings.catch_warnings(record=True) as told:
        warnings.simplefilter("always")
        found = torch.cuda.is_available()
    if found:
        return "cuda", f"{torch.cuda.get_device_name()}, {'as asked' if accelerator == 'gpu' else 'found'}"
    # torch warns about a driver that is too old, and says how old.
    reason = " ".join(str(told[-1].message).split())[:200].removeprefix("CUDA initialization: ") if told else ""
    if accelerator == "gpu":
        raise InputError(
            f"trainer=gpu: torch sees no CUDA device here. {reason}{' ' if reason else ''}Use trainer=cpu or "
            "trainer=auto, or install a CUDA build of torch that suits the driver, which nvidia-smi shows."
        )
    if reason:
        log.warning("Using the CPU, because torch cannot use the GPU here: %s", reason)
    return "cpu", "no GPU found"


def working_device(chosen: tuple[DeviceType, str], accelerator: Accelerator) -> tuple[DeviceType, str]:
    """Try the chosen GPU, and return it with the reason; if it was not requested, the CPU can replace it.

    Raises:
        InputError: the GPU cannot be used, and was requested, or other processes of the run have theirs.
    """
    trouble = _trouble_of_gpu() if chosen[0] == "cuda" else None
    if trouble is None:
        return chosen
    if accelerator == "gpu" or distributed.is_initialized():
        raise InputError(
            f"torch sees a GPU here but cannot use it: {trouble}. nvidia-smi shows what is using it, and the driver. "
            "Choose another one with CUDA_VISIBLE_DEVICES, or use trainer=cpu."
        )
    log.warning(
        "PyTorch sees a GPU, but it cannot be used: %s. The CPU is used instead; trainer=gpu insists on the GPU.",
        trouble,
    )
    return "cpu", "the GPU cannot be used"


def _trouble_of_gpu() -> str | None:
    try:
        free, total = torch.cuda.mem_get_info()
        if free < LEAST_GPU_MEMORY:
            return f"{free / 1e9:.1f} GB of its {total / 1e9:.1f} GB of memory are free, and at least 1 GB is needed"
        square = torch.ones(8, 8, device="cuda")
        right = bool((square @ square == 8.0).all())
    except RuntimeError as error:  # no memory, no kernels for this GPU, an incompatible driver
        return " ".join(str(error).split())[:200]
    return None if right else "it computes 8 times 1 wrongly"


ALL_THREADS = min(torch.get_num_threads(), num_cores())
M_MMAP_THRESHOLD = -3
M_TRIM_THRESHOLD = -1


def use_threads(number: int) -> None:
    """Use as many threads as a run has used before, if there are that many cores."""
    cores = os.cpu_count() or 1
    if number <= cores:
        torch.set_num_threads(number)
    else:
        log.warning(
            "The run used %d threads, but this machine has %d cores: it continues with %d, and results may differ in "
            "the last bits.",
            number,
            cores,
            torch.get_num_threads(),
        )


def prepare_machine(num_threads: int | None) -> None:
    """Configure threads and the allocator, once per process; None: one thread per core."""
    torch.set_num_threads(num_threads or ALL_THREADS)
    _keep_float32()
    _keep_large_blocks()
    _quiet_libraries()


def _keep_float32() -> None:
    # float32 products stay in float32, except where a field lowers its own (matmul_precision.py). By default cuDNN
    # would lower convolutions, including SSIM's.
    torch.set_float32_matmul_precision("highest")
    torch.backends.cudnn.allow_tf32 = False


def _keep_large_blocks() -> None:
    # glibc returns blocks of 32 MB and more to the system at each free; allocating them again costs more than the
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
    logging.getLogger("lightning.pytorch.profilers").setLevel(logging.INFO)  # their tables
    ignored: list[dict[str, Any]] = [
        {"message": ".*does not have many workers.*"},
        {"message": ".*LeafSpec.*", "category": FutureWarning},
        {"message": ".*isinstance.treespec, LeafSpec.*"},
        {"message": ".*ckpt_path.*mid-epoch.*"},
        {"message": ".*callbacks used to create the checkpoint.*"},  # a budget that the run no longer has
        {"message": "Total length of `list` across ranks is zero"},  # no validation views
        {"message": ".*checkpoint that ended before the epoch ended.*"},
    ]
    for rule in ignored:
        warnings.filterwarnings("ignore", **rule)

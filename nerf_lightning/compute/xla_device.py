"""XLA devices (TPUs): whether there is one, and its cores."""

import importlib.util
from typing import Literal

from lightning.pytorch.accelerators import XLAAccelerator

from nerf_lightning.messages.errors import InputError

ACCELERATOR: type[XLAAccelerator] = XLAAccelerator
"""Lightning's accelerator, which counts TPU chips; tests replace it with one that uses XLA's CPU device."""


def require_device() -> str:
    """Return which kind of device XLA uses here.

    Raises:
        InputError: torch_xla is not installed, or finds no TPU.
    """
    if importlib.util.find_spec("torch_xla") is None:
        raise InputError(
            "trainer=tpu needs torch_xla, which is not installed here. It runs on a TPU's host (Linux, x86-64), and "
            "its newest release, 2.9, needs torch 2.9: `make xla` installs both into an environment of their "
            "own, where .venv-xla/bin/nerf is the command. Elsewhere use trainer=auto."
        )
    if not ACCELERATOR.is_available():
        raise InputError("trainer=tpu: torch_xla finds no TPU on this machine. Use trainer=auto, or a TPU's host.")
    import torch_xla
    from torch_xla import runtime

    return f"{runtime.device_type()}, torch_xla {torch_xla.__version__}"


def use_cores(wanted: int | Literal["auto"]) -> int:
    """Prepare this process for the cores, and return their number; call before anything is put on them.

    Raises:
        InputError: the machine has another number of cores.
    """
    from torch_xla import backends, runtime

    # Else a TPU would multiply float32 numbers in bfloat16, even outside fields (matmul_precision.py).
    backends.set_mat_mul_precision("highest")
    if wanted == 1:
        runtime.global_runtime_device_count()  # autograd must see the device before its first backward
        return 1
    runtime.use_spmd()
    found = runtime.global_runtime_device_count()
    if wanted not in ("auto", found):
        raise InputError(
            f"trainer.devices={wanted}: XLA finds {found} cores on this machine. Give trainer.devices=auto for all of "
            "them, or 1."
        )
    return found

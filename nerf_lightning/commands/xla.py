"""XLA devices (TPUs) under Lightning: one process, whatever the number of cores, and the parts that differ there.

The cores share one program: rays are spread over them, weights are copied to each, and the compiler adds up the
gradients (single program, multiple data). So nothing else has to know how many there are.
"""

import importlib.util
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import torch
from lightning.pytorch.plugins import XLACheckpointIO, XLAPrecision
from lightning.pytorch.strategies import SingleDeviceXLAStrategy
from torch import Tensor

from nerf_lightning.callbacks.checkpoint_io import AtomicCheckpointIO
from nerf_lightning.errors import InputError


def require_xla() -> None:
    """Refuse machines without torch_xla.

    Raises:
        InputError: it is not installed.
    """
    if importlib.util.find_spec("torch_xla") is None:
        raise InputError(
            "trainer=tpu needs torch_xla, which is not installed here. Its newest release, 2.9, goes with torch 2.9 "
            "on Linux and Python 3.11 to 3.13, in an environment of its own: on a TPU's host, `make .venv-xla/.ready` "
            "makes one, and .venv-xla/bin/nerf is the command there. Elsewhere use trainer=auto."
        )


def use_cores(wanted: int) -> None:
    """Prepare this process for so many cores; it must come before anything is put on them.

    Raises:
        InputError: the machine has another number.
    """
    from torch_xla import runtime

    if wanted > 1:
        runtime.use_spmd()
    found = runtime.global_runtime_device_count()
    if wanted not in (1, found):
        raise InputError(f"trainer.devices={wanted}: this machine has {found} cores. Give trainer.devices={found}, or 1.")


class XLAStrategy(SingleDeviceXLAStrategy):
    """Spread the rays of each batch over the cores."""

    def __init__(self, precision: str, devices: int):
        plugin = XLAMixedPrecision() if precision == "bf16-mixed" else XLAPrecision("32-true")
        super().__init__(0, checkpoint_io=AtomicXLACheckpointIO(), precision_plugin=plugin)
        self.devices = devices

    def batch_to_device(self, batch: Any, device: torch.device | None = None, dataloader_idx: int = 0) -> Any:
        """Put a batch onto the cores, each a share of the rays."""
        batch = super().batch_to_device(batch, device, dataloader_idx)
        return batch if self.devices == 1 else batch.map(self._spread)

    def _spread(self, tensor: Tensor) -> Tensor:
        import numpy as np
        from torch_xla.distributed import spmd

        mesh = spmd.Mesh(np.arange(self.devices), (self.devices,), ("rays",))
        spmd.mark_sharding(tensor, mesh, ("rays", *(None,) * (tensor.ndim - 1)))
        return tensor


class XLAMixedPrecision(XLAPrecision):
    """float32 weights, bfloat16 products. Lightning's own bf16-true would round Adam's updates away."""

    @contextmanager
    def forward_context(self) -> Iterator[None]:
        """Multiply in bfloat16."""
        with super().forward_context(), torch.autocast("xla", torch.bfloat16):
            yield


class AtomicXLACheckpointIO(XLACheckpointIO):
    """Bring everything to the CPU, then write as elsewhere."""

    def save_checkpoint(self, checkpoint: dict[str, Any], path: Any, storage_options: Any = None) -> None:
        """Write the checkpoint, or leave the former one as it was."""
        import torch_xla.core.xla_model as xm

        AtomicCheckpointIO().save_checkpoint(xm._maybe_convert_to_cpu(checkpoint, convert=True), path)

"""XLA devices (TPUs) under Lightning: one process for any number of cores, and the parts that differ there.

The cores run one program: rays are sharded, weights are replicated, and the compiler sums the gradients (SPMD, single
program, multiple data). So nothing else depends on the number of cores.
"""

from typing import Any

import torch
from lightning.pytorch.plugins import XLACheckpointIO, XLAPrecision
from lightning.pytorch.strategies import SingleDeviceXLAStrategy
from torch import Tensor

from nerf_lightning.compute import xla_device
from nerf_lightning.messages.errors import InputError
from nerf_lightning.nerf.models.base import Model
from nerf_lightning.training.launch.checkpoint_io import AtomicCheckpointIO


def refuse(compiles: bool, launched_by: str) -> None:
    """Refuse settings that do not apply to XLA.

    Raises:
        InputError: there are such settings.
    """
    if compiles:
        raise InputError("trainer.compile=true is for other devices: XLA compiles every step by itself. Leave it out.")
    if launched_by != "nerf":
        raise InputError(
            f"trainer.launched_by={launched_by} with a TPU: one process drives all cores of a host. Start nerf itself."
        )


def require_static_shapes(model: Model) -> None:
    """Refuse models that XLA would recompile at each step.

    Raises:
        InputError: the model's shapes depend on the data.
    """
    if not model.has_static_shapes:
        raise InputError(
            "This model leaves empty space out, so the shapes of each step depend on the data, and XLA would compile "
            "every step anew. Use model=fast_dense, which masks empty space instead, model=fast_proposal or model=nerf."
        )


def trainer_arguments(cores: int) -> dict[str, Any]:
    """Return the arguments of Lightning's Trainer."""
    return {"accelerator": xla_device.ACCELERATOR(), "devices": 1, "strategy": ManyCores(cores)}


class ManyCores(SingleDeviceXLAStrategy):
    """Spread the rays of each batch over the cores."""

    def __init__(self, cores: int):
        super().__init__(0, checkpoint_io=AtomicXLACheckpointIO(), precision_plugin=XLAPrecision("32-true"))
        self.cores = cores

    def batch_to_device(self, batch: Any, device: torch.device | None = None, dataloader_idx: int = 0) -> Any:
        """Move a batch to the cores, each with a share of the rays."""
        batch = super().batch_to_device(batch, device, dataloader_idx)
        return batch if self.cores == 1 else batch.map(self._spread)

    def _spread(self, tensor: Tensor) -> Tensor:
        import numpy as np
        from torch_xla.distributed import spmd

        mesh = spmd.Mesh(np.arange(self.cores), (self.cores,), ("rays",))
        spmd.mark_sharding(tensor, mesh, ("rays", *(None,) * (tensor.ndim - 1)))
        return tensor


class AtomicXLACheckpointIO(AtomicCheckpointIO, XLACheckpointIO):
    """Write as elsewhere; Lightning requires the XLA class."""

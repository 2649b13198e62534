"""`nerf bench`: how much arithmetic a step is, and how fast this machine could do it."""

from collections.abc import Callable

import torch
from torch.utils.flop_counter import FlopCounterMode

from nerf_lightning.commands.trainer import TrainerSettings
from nerf_lightning.kernels.backends import without
from nerf_lightning.system import RadianceFieldSystem
from nerf_lightning.types.rays import Batch

_ROWS, _WIDTH, _REPEATS = 4096, 256, 20
MATRIX_FLOPS = 2 * _ROWS * _WIDTH**2 * _REPEATS


def multiplication(settings: TrainerSettings) -> Callable[[], None]:
    """Return work of `MATRIX_FLOPS`, in the precision of training."""
    dtype = torch.bfloat16 if settings.precision.startswith("bf16") else torch.float32
    left = torch.randn(_ROWS, _WIDTH, device=settings.device).to(dtype)
    right = torch.randn(_WIDTH, _WIDTH, device=settings.device).to(dtype)
    out = torch.empty_like(left)

    def multiply() -> None:
        for _ in range(_REPEATS):
            torch.mm(left, right, out=out)

    return multiply


def flops_per_ray(system: RadianceFieldSystem, batch: Batch) -> float:
    """Count the operations that training takes per ray, forward and backward, in matrix products."""
    # Where rays differ in their samples, many make the mean.
    few = 8 if system.model.points_per_ray(training=True) > 64 else min(1024, batch.rays.near.numel())
    rays = batch[:few]
    with FlopCounterMode(display=False) as counter, without("mlp_tiles"):  # it counts one thread's
        system.accumulate_gradients(rays, lambda loss: loss.backward())
    return counter.get_total_flops() / few

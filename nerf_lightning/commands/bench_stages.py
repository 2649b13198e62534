"""`nerf bench`: where the time of a step of a packed model goes, and how long a run takes to a given PSNR."""

import time
from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor

from nerf_lightning.data.ray_batches import FixedRays, RayBatches
from nerf_lightning.kernels.march import march
from nerf_lightning.models.packed_level import PackedLevel
from nerf_lightning.samplers.occupancy import positions_of
from nerf_lightning.system import RadianceFieldSystem
from nerf_lightning.types import Batch

LOOK_EVERY = 25
VALIDATION_RAYS = 8192


def stage_seconds(system: RadianceFieldSystem, batch: Batch, optimizer: torch.optim.Optimizer) -> dict[str, float]:
    """Return the seconds of marching, screening, the rest both ways, and the update of a packed model; else nothing."""
    level = list(system.model.levels.values())[-1]
    if not isinstance(level, PackedLevel):
        return {}
    rays, sampler = batch.rays, level.sampler
    found: list[Tensor] = []
    optimizer.zero_grad()
    whole = _timed(lambda: system.accumulate_gradients(batch, lambda loss: loss.backward()))
    update = _timed(optimizer.step)

    def walk() -> None:
        samples, _ = march(rays, sampler.start(rays, None), sampler.lattice, sampler.grid)
        found.append(positions_of(rays, samples))

    with torch.no_grad():
        walking, screening = _timed(walk), _timed(lambda: level.field.screen(found[0]))
    rest = whole - walking - screening
    return {"march": walking, "screen": screening, "field, loss and gradients": rest, "optimizer": update}


def seconds_to_psnr(
    take_step: Callable[[], None], system: RadianceFieldSystem, batches: RayBatches, target: float, most_steps: int
) -> tuple[float, int] | None:
    """Train until the validation rays reach a PSNR; return training seconds and steps, or None where they never do."""
    rays = FixedRays(batches.scene, "val", VALIDATION_RAYS, VALIDATION_RAYS)
    used = 0.0
    for step in range(1, most_steps + 1):
        used += _timed(take_step)
        if step % LOOK_EVERY == 0 and _psnr(system, rays) >= target:
            return used, step
    return None


@torch.no_grad()
def _psnr(system: RadianceFieldSystem, rays: FixedRays) -> float:
    for number, batch in enumerate(rays):
        system.validation_step(batch.to(system.device), number)
    error = torch.cat(system.squared_errors).mean()
    system.squared_errors.clear()
    return float(-10 * torch.log10(error))


def _timed(work: Callable[[], Any]) -> float:
    start = time.perf_counter()
    work()
    if torch.cuda.is_available():
        torch.cuda.synchronize()
    return time.perf_counter() - start

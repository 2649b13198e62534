"""`nerf bench`: where the time of a step of a packed model goes, and how long a run takes to a given PSNR."""

from collections.abc import Callable

import torch
from torch import Tensor

from nerf_lightning.commands.timing import seconds_of
from nerf_lightning.data.ray_batches import FixedRays, RayBatches
from nerf_lightning.kernels.march import march
from nerf_lightning.models.packed_level import PackedLevel
from nerf_lightning.rendering.packed import positions_of
from nerf_lightning.system import RadianceFieldSystem
from nerf_lightning.types.rays import Batch

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
    whole = seconds_of(lambda: system.accumulate_gradients(batch, lambda loss: loss.backward()))
    update = seconds_of(optimizer.step)

    def walk() -> None:
        samples, _ = march(rays, sampler.start(rays, None), sampler.lattice, sampler.grid)
        found.append(positions_of(rays, samples))

    with torch.no_grad():
        walking, screening = seconds_of(walk), seconds_of(lambda: level.field.screen(found[0]))
    rest = whole - walking - screening
    return {"march": walking, "screen": screening, "field, loss and gradients": rest, "optimizer": update}


def seconds_to_psnr(
    take_step: Callable[[], None], system: RadianceFieldSystem, batches: RayBatches, target: float, most_steps: int
) -> tuple[float, int] | None:
    """Train until the validation rays reach a PSNR; return training seconds and steps, or None where they never do."""
    rays = FixedRays(batches.scene, "val", VALIDATION_RAYS, VALIDATION_RAYS)
    used = 0.0
    for step in range(1, most_steps + 1):
        used += seconds_of(take_step)
        if step % LOOK_EVERY == 0 and _psnr(system, rays) >= target:
            return used, step
    return None


@torch.no_grad()
def _psnr(system: RadianceFieldSystem, rays: FixedRays) -> float:
    for number, batch in enumerate(rays):
        system.validation_step(batch.to(system.device), number)
    return system.val_errors.summary()["val/psnr"]

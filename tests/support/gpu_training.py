"""Training any model yaml step by step on any device, with a handful of rays."""

from dataclasses import dataclass, field

import torch
from omegaconf import OmegaConf
from support.configs import composed
from support.scenes import ball_scene

from nerf_lightning.compute.settings import PRODUCTS
from nerf_lightning.config.instantiate import build
from nerf_lightning.data.pixels.placement import on_device
from nerf_lightning.data.ray_batches import RayBatches
from nerf_lightning.nerf.matmul_precision import set_precision
from nerf_lightning.nerf.types.progress import Progress
from nerf_lightning.training.build_step import build_step
from nerf_lightning.training.launch.trainer import TrainerSettings
from nerf_lightning.training.step import TrainStep

RAYS = 48
QUICK = {
    "num_samples": 16,
    "log2_table_size": 10,
    # Of grids, which are updated after 3 and after 6 steps, then half of them.
    "resolution": 16,
    "num_steps": 32,
    "update_every": 3,
    "warmup_steps": 4,
}


@dataclass
class StepByStep:
    """A run without Lightning."""

    training: TrainStep
    optimizer: torch.optim.Optimizer
    loader: RayBatches
    losses: list[torch.Tensor] = field(default_factory=list)

    def step(self) -> None:
        """Make a batch and take a step."""
        batch = next(iter(self.loader))
        self.losses.append(self.training(batch.to(self.training.device), self.optimizer).losses.sum())

    def all_losses(self) -> torch.Tensor:
        """Return the losses so far, on the host."""
        return torch.stack(self.losses).cpu().double()


def step_by_step(
    model: str, device: torch.device, precision: str = "32-true", tile_points: int | None = None, *changes: str
):
    """Prepare a model of conf/model on a device, its pixels there too."""
    config = composed("train", f"model={model}", f"data.batch_rays={RAYS}", "data.sample_budget=null", *changes)
    settings = TrainerSettings(accelerator="cpu", precision="32-true", tile_points=tile_points)
    looks = model.startswith("view_transformer")  # at up to ten photographs for each view
    scene, progress = ball_scene(24) if looks else ball_scene(10, 20, background="random"), Progress()
    training = build_step(config, settings, scene, progress)
    training.objective.to(device)
    training.num_steps = 1000
    set_precision(training.objective.model, PRODUCTS[precision])
    here = scene if device.type == "cpu" else on_device(scene, device)
    return StepByStep(training, training.new_optimizer(), RayBatches(here, progress, 0, config.data.batch_rays))


def default_callbacks(*changes: str):
    """Return the callbacks that `nerf train` has."""
    return list(build(composed("train", *changes).callbacks).values())


def small(model, **settings):
    """Return the changes that make a model quick: `QUICK`, and other settings, by the last word of their keys."""
    chosen = QUICK | settings

    def within(place, settings):
        for name, value in settings.items():
            if isinstance(value, dict):
                yield from within(f"{place}.{name}", value)
            elif name in chosen:
                yield f"{place}.{name}={chosen[name]}"

    config = OmegaConf.to_container(composed("train", f"model={model}"), resolve=False)
    changes = (change for part in ("model", "field", "encoder") for change in within(part, config[part]))
    return ["data.batch_rays=8", *changes]

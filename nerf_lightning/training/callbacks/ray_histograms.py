"""Histograms for TensorBoard: where along the rays each level sees something, and from how many samples."""

from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor
from torch.utils.tensorboard import SummaryWriter

from nerf_lightning.messages.errors import require_positive
from nerf_lightning.nerf.models.tiles import weighted_renderings
from nerf_lightning.nerf.randomness import fold
from nerf_lightning.nerf.rendering.ray_statistics import effective_samples, weight_along
from nerf_lightning.nerf.types.rays import PixelIndex
from nerf_lightning.training.callbacks.watcher import Watcher, tensorboard_writers
from nerf_lightning.training.loggers import ALONG_RAYS, PER_RAY
from nerf_lightning.training.step import TrainStep

PARTS = 50


class RayHistograms(Watcher):
    """Render some of the step's rays again, as in training, and log for each level what is along them.

    A coarse level that has learned nothing spreads its weight evenly. Weight that piles up at 0 or 1 is at the near or
    far bound, which then cuts off the scene.

    Args:
        every_steps: steps between two histograms.
        num_rays: number of a step's rays that are used.
    """

    def __init__(self, every_steps: int = 250, num_rays: int = 256):
        super().__init__(every_steps)
        require_positive(num_rays=num_rays)
        self.num_rays = num_rays

    def watch(self, trainer: Any, system: Any, outputs: Any) -> None:
        """Write two histograms and a curve for each level."""
        writers = tensorboard_writers(trainer.loggers)
        if not writers:
            return
        step, contracted_spacing = trainer.global_step, trainer.datamodule.scene.space == "contracted"
        seen = look_along(system.train_step, outputs["step"].pixels[: self.num_rays], step, contracted_spacing)
        for name, (along, samples) in seen.items():
            lit = samples[samples > 0]  # many rays meet nothing
            for writer in writers:
                write_shares(writer, f"{ALONG_RAYS}_{name}", along, step)
                if lit.numel():
                    writer.add_histogram(f"{PER_RAY}_{name}", lit, step)
                    writer.add_scalar(f"rays/effective_samples_{name}", lit.mean(), step)


@torch.no_grad()
def look_along(
    train_step: TrainStep, pixels: PixelIndex, step: int, contracted_spacing: bool
) -> dict[str, tuple[Float[Tensor, "parts"], Float[Tensor, "rays"]]]:
    """Return for each level the mean weight in equal parts of the ray, and each ray's effective samples."""
    objective, tile_points = train_step.objective, train_step.tiles.picture_points
    model, rays = objective.model, objective.rays(pixels)
    names, num_rays = model.level_names, rays.near.numel()
    key = fold(train_step.seed, step, "histograms")
    seen: dict[str, list[tuple[Tensor, Tensor]]] = {name: [] for name in names}
    model.eval()
    for part, renderings in weighted_renderings(model, rays, objective.background, key, tile_points):
        for name, rendering in zip(names, renderings, strict=True):
            along = weight_along(rendering, part, PARTS, contracted_spacing) * part.near.numel() / num_rays
            seen[name].append((along.cpu(), effective_samples(rendering, part).cpu()))
    model.train()
    return {
        name: (torch.stack([along for along, _ in parts]).sum(0), torch.cat([samples for _, samples in parts]))
        for name, parts in seen.items()
    }


def write_shares(writer: SummaryWriter, tag: str, shares: Float[Tensor, "parts"], step: int) -> None:
    """Write a histogram over [0, 1] with the given bars."""
    shares = shares.double()
    middles = (torch.arange(len(shares), dtype=torch.double) + 0.5) / len(shares)
    writer.add_histogram_raw(
        tag,
        min=0.0,
        max=1.0,
        num=float(shares.sum()),
        sum=float((shares * middles).sum()),
        sum_squares=float((shares * middles.square()).sum()),
        bucket_limits=((torch.arange(len(shares)) + 1) / len(shares)).tolist(),
        bucket_counts=shares.tolist(),
        global_step=step,
    )

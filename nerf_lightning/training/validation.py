"""Validation: the squared error of fixed rays, as evaluation shows them, over all processes of a run.

Which rays: `data/datamodule.py`; how many: `conf/data/rays.yaml`; how often: `val_every_steps` in
conf/trainer/auto.yaml.
"""

import math

import torch
from jaxtyping import Float
from torch import Tensor

from nerf_lightning.compute import ranks
from nerf_lightning.nerf.models.tiles import pixels_in_tile, tiles
from nerf_lightning.nerf.objective import Objective
from nerf_lightning.nerf.psnr import LEAST_MSE, psnr
from nerf_lightning.nerf.types.rays import Batch


class RayErrors:
    """Collect squared errors of rays, batch by batch, and summarize them over all processes of a run."""

    def __init__(self) -> None:
        self.parts: list[Tensor] = []

    def of(self, objective: Objective, batch: Batch, tile_points: int | None) -> Float[Tensor, ""]:
        """Record a batch's rays, and return their mean squared error; masked rays do not count.

        Args:
            objective: renders them.
            batch: fixed rays.
            tile_points: maximum number of points that go through a field at once; None: all.
        """
        rgb, target = torch.empty_like(batch.rgba[:, :3]), torch.empty_like(batch.rgba[:, :3])
        pixels = batch.num_rays if tile_points is None else pixels_in_tile(objective.model, tile_points)
        for tile in tiles(batch.num_rays, pixels):
            renderings, shown = objective.neutral(batch[tile])
            rgb[tile], target[tile] = renderings[-1].rgb, shown.rgb
        self.add(rgb, target, batch.weight)
        error = (rgb - target).square().mean(dim=-1)
        return (error * batch.weight).sum() / batch.weight.sum().clamp(min=1.0)

    def add(self, rgb: Float[Tensor, "rays 3"], target: Float[Tensor, "rays 3"], weight: Float[Tensor, "rays"]) -> None:
        """Record some rays; those of weight 0 do not count."""
        self.parts.append(torch.stack([(rgb - target).square().mean(dim=-1), weight]))

    def summary(self) -> dict[str, float]:
        """Return the PSNR of all rays and its standard error (delta method), and reset."""
        # Masked on the host: on XLA, data-dependent sizes stall the device.
        error, weight = torch.cat(self.parts, dim=-1).cpu()
        self.parts.clear()
        error = error[weight > 0].double()
        moments = torch.stack([torch.ones_like(error).sum(), error.sum(), error.square().sum()])
        count, first, second = ranks.total(moments)
        mean = first / count
        standard_error = ((second / count - mean.square()).clamp(min=0) / (count - 1).clamp(min=1)).sqrt()
        return {
            "val/psnr": float(psnr(mean)),
            "val/psnr_standard_error": float(10.0 / math.log(10.0) * standard_error / mean.clamp(min=LEAST_MSE)),
        }

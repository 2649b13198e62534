"""The error of a fixed subset of rays, while training: PSNR and how sure it is."""

import math

import torch
from jaxtyping import Float
from torch import Tensor

from nerf_lightning import ranks
from nerf_lightning.evaluation.metrics import LEAST_MSE, psnr


class RayErrors:
    """Collect squared errors of rays, batch by batch, and summarise them over all processes of a run."""

    def __init__(self) -> None:
        self.parts: list[Tensor] = []

    def add(self, rgb: Float[Tensor, "rays 3"], target: Float[Tensor, "rays 3"], weight: Float[Tensor, "rays"]) -> None:
        """Take note of some rays; those of weight 0 do not count."""
        self.parts.append(torch.stack([(rgb - target).square().mean(dim=-1), weight]))

    def summary(self) -> dict[str, float]:
        """Return the PSNR of all rays and its standard error (delta method), and begin anew."""
        # Masked on the host: on XLA a size that depends on data stops the device.
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

"""The peak signal-to-noise ratio, by which renders are judged; the same everywhere in the program."""

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from nerf_lightning.nerf.row_chunks import row_chunks

LEAST_MSE = 1e-10
"""Smaller errors are clamped to this, a PSNR of 100 dB."""


def psnr(mse: Float[Tensor, "*images"]) -> Float[Tensor, "*images"]:
    """Return the peak signal-to-noise ratio in dB, -10 log10(mse), for colors in [0, 1]; at most 100.

    Equal pictures (a view of only background) would have an infinite one, which no mean or file could hold.

    >>> round(float(psnr(torch.tensor(0.01))), 3)
    20.0
    """
    return -10.0 * torch.log10(mse.clamp(min=LEAST_MSE))


def picture_psnr(
    render: Float[Tensor, "height width 3"],
    truth: Float[Tensor, "height width 3"],
    mask: Bool[Tensor, "height width"] | None = None,
) -> float:
    """Return the PSNR (dB) of a picture over the pixels of a mask (at least one; None: all)."""
    total, count = 0.0, 0
    for rows in row_chunks(*render.shape[:2]):
        error = (render[rows] - truth[rows]).square()
        error = error if mask is None else error[mask[rows]]
        total, count = total + float(error.sum(dtype=torch.float64)), count + error.numel()
    return float(psnr(torch.tensor(total, dtype=torch.float64) / count))  # NaN if the mask is empty

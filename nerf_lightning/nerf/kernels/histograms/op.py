"""Samples along rays by kernels; None where there is none for what is given."""

import torch
from jaxtyping import Float
from torch import Tensor

from nerf_lightning.nerf.kernels.backends import backend_for


def sample(
    edges: Float[Tensor, "*rays edges"],
    weights: Float[Tensor, "*rays bins"],
    u: Float[Tensor, "*rays count"],
    floor: float = 1e-5,
    contracted: bool = False,
) -> Float[Tensor, "*rays count"] | None:
    """Do what `rendering.histograms.sample_histogram` does, without gradients, for float32 rays in a row."""
    plain = u.dim() == 2 and edges.dtype == torch.float32 and edges.shape[-1] == weights.shape[-1] + 1
    plain = plain and not (edges.requires_grad or weights.requires_grad)
    kernels = backend_for("histograms", u.device) if plain else None
    return None if kernels is None else kernels.sample(edges, weights, u, floor, contracted)


def stratified(
    shares: Float[Tensor, "edges"],
    jitter: Float[Tensor, "*rays inner"] | None,
    low: Float[Tensor, "*rays"],
    high: Float[Tensor, "*rays"],
    contracted: bool,
) -> Float[Tensor, "*rays edges"] | None:
    """Do what `samplers.stratified.stratified_edges` does, without gradients, for float32 rays in a row."""
    plain = low.dim() == 1 and low.dtype == torch.float32 and not (low.requires_grad or high.requires_grad)
    kernels = backend_for("histograms", low.device) if plain else None
    return None if kernels is None else kernels.stratified(shares, jitter, low, high, contracted)

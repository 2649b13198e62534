"""Experts in place of a feed-forward layer, two of which are used for each point (GNT-MOVE, ICCV 2023).

All are computed, and the gate multiplies their outputs: shapes are fixed, and only torch is needed. Letters: E experts,
g the gates of a point, of which two are not 0.
"""

import math
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor, nn
from torch.nn import functional

from nerf_lightning.extensions.view_transformer.attention import FeedForward
from nerf_lightning.nerf.matmul_precision import Linear, disable_autocast
from nerf_lightning.nerf.types.rays import RayBundle
from nerf_lightning.nerf.types.tensor_struct import TensorStruct

CHOSEN = 2
GATE_DIM = 2
FIRST_TEMPERATURE, LEAST_TEMPERATURE = 0.5, 0.01
NEIGHBORS = 4
"""Number of neighboring rays to which a ray's gates should be similar."""


@dataclass(frozen=True)
class Gates(TensorStruct):
    """Weights of the experts at points."""

    chosen: Float[Tensor, "*points experts"]
    """Sum to 1; two are not 0."""
    shares: Float[Tensor, "*points experts"]
    """Before the choice: a softmax."""
    load: Float[Tensor, "*points experts"]
    """Probability of each expert to be among the two, over the noise; without noise, whether it is."""


class Gate(nn.Module):
    """Cosines between a projection of the state and a vector for each expert, over a learned temperature.

    Args:
        width: of the states.
        experts: their number, at least 3.
    """

    def __init__(self, width: int, experts: int):
        super().__init__()
        self.project = nn.Linear(width, GATE_DIM, bias=False)
        self.vectors = nn.Parameter(torch.empty(experts, GATE_DIM))
        self.log_temperature = nn.Parameter(torch.empty(()))
        self.reset_parameters()

    def reset_parameters(self) -> None:
        """Reinitialize the vectors and reset the temperature; torch resets the projection itself."""
        nn.init.normal_(self.vectors)
        nn.init.constant_(self.log_temperature, math.log(FIRST_TEMPERATURE))

    @disable_autocast
    def forward(self, states: Float[Tensor, "*points width"], noise: Float[Tensor, "*points experts"] | None) -> Gates:
        """Return the gates.

        Args:
            states: normalized.
            noise: standard normal numbers, scaled to a standard deviation of 1 / E. None: no noise.
        """
        cosines = (
            functional.normalize(self.project(states.float()), dim=-1) @ functional.normalize(self.vectors, dim=-1).mT
        )
        clean = cosines / self.log_temperature.exp().clamp(min=LEAST_TEMPERATURE)
        deviation = 1.0 / len(self.vectors)
        noisy = clean if noise is None else clean + deviation * noise
        shares = noisy.softmax(dim=-1)
        best = noisy.topk(CHOSEN + 1, dim=-1)
        asked = torch.zeros_like(shares).scatter(-1, best.indices[..., :CHOSEN], 1.0)
        kept = shares * asked
        load = asked
        if noise is not None:
            # The second largest of the others' noisy scores, which an expert's own must exceed (arXiv 1701.06538).
            second, third = best.values[..., 1:2], best.values[..., 2:3]
            to_exceed = torch.where(asked > 0, third, second)
            load = torch.special.ndtr((clean - to_exceed) / deviation)
        return Gates(kept / kept.sum(dim=-1, keepdim=True), shares, load)


class Experts(nn.Module):
    """The mean of a feed-forward layer that is always used and of the two experts that the gate chooses.

    Args:
        width: of the states.
        experts: their number, at least 3.
    """

    def __init__(self, width: int, experts: int):
        super().__init__()
        self.permanent, self.gate = FeedForward(width), Gate(width, experts)
        self.wide, self.out = Linear(width, 4 * width * experts), Linear(4 * width * experts, width, bias=False)
        self.out_bias = nn.Parameter(torch.empty(experts, width))
        self.experts = experts
        self.reset_parameters()

    def reset_parameters(self) -> None:
        """Set the biases to 0, and scale the second layer like each expert's own."""
        nn.init.zeros_(self.out_bias)
        nn.init.uniform_(self.out.weight, -(bound := (self.out.in_features // self.experts) ** -0.5), bound)

    def forward(
        self, states: Float[Tensor, "*points width"], noise: Float[Tensor, "*points experts"] | None
    ) -> tuple[Float[Tensor, "*points width"], Gates]:
        """Return the states after permanent and chosen experts, and the gates."""
        normed = self.permanent.norm(states)
        gates = self.gate(normed, noise)
        wide = functional.relu(self.wide(normed)).unflatten(-1, (self.experts, -1))
        of_chosen = self.out((wide * gates.chosen[..., None]).flatten(-2)) + self._biases(gates.chosen)
        return states + 0.5 * (self.permanent.change(normed) + of_chosen), gates

    @disable_autocast
    def _biases(self, chosen: Tensor) -> Tensor:
        return chosen @ self.out_bias


def imbalance(gates: Gates) -> Float[Tensor, ""]:
    """Return the squared coefficients of variation, over the experts, of their summed gates and of their load."""
    return _variation(gates.chosen) + _variation(gates.load)


def _variation(of_points: Float[Tensor, "*points experts"]) -> Float[Tensor, ""]:
    total = of_points.flatten(0, -2).mean(dim=0)
    return total.var(correction=0) / total.mean().square().clamp(min=1e-10)


def roughness(gates: Gates, rays: RayBundle, target: Tensor) -> Float[Tensor, "rays"]:
    """Return the divergence of each ray's gates from those of the nearest rays of its target, sample by sample.

    The Kullback-Leibler divergences KL(neighbor | ray), weighted by the softmax of the negative distances of their
    directions, in units of the mean distance to the nearest. Samples with the same index are nearest to each other.
    """
    with torch.no_grad():
        apart = torch.cdist(rays.directions, rays.directions)
        apart = apart.masked_fill(target[:, None] != target, torch.inf).fill_diagonal_(torch.inf)
        nearest = apart.topk(min(NEIGHBORS, len(apart)), dim=1, largest=False)
        known = nearest.values.isfinite()
        unit = torch.where(known[:, 0], nearest.values[:, 0], 0.0).sum() / known[:, 0].sum().clamp(min=1)
        scores = torch.where(known, -nearest.values / unit.clamp(min=1e-12), -1e9)
        weights = scores.softmax(dim=1) * known
    shares = gates.shares.clamp(min=1e-8)
    own, theirs = shares[:, None], shares[nearest.indices]
    divergence = (theirs * (theirs.log() - own.log())).sum(dim=-1).mean(dim=-1)
    return (weights * divergence).sum(dim=1)

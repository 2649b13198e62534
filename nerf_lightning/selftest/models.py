"""The models of the self-test: one of each kind, small, with what trains them."""

from collections.abc import Callable, Iterable
from dataclasses import dataclass
from typing import Any

import torch
from torch.optim import Optimizer

from nerf_lightning.nerf.encoders.frequency import FrequencyEncoder
from nerf_lightning.nerf.encoders.hash_grid import HashGridEncoder
from nerf_lightning.nerf.encoders.spherical_harmonics import SphericalHarmonicsEncoder
from nerf_lightning.nerf.fields.hash_field import HashField
from nerf_lightning.nerf.fields.nerf_mlp import NerfMLP
from nerf_lightning.nerf.losses.base import Loss
from nerf_lightning.nerf.losses.mse import MeanSquaredError
from nerf_lightning.nerf.losses.proposal import ProposalLoss
from nerf_lightning.nerf.models.dense_level import DenseLevel
from nerf_lightning.nerf.models.masked_level import MaskedLevel
from nerf_lightning.nerf.models.packed_level import PackedLevel
from nerf_lightning.nerf.models.proposal_level import ProposalLevel
from nerf_lightning.nerf.models.radiance_model import RadianceModel
from nerf_lightning.nerf.optimizers.table_adam import TableAdam
from nerf_lightning.nerf.samplers.importance import ImportanceSampler
from nerf_lightning.nerf.samplers.occupancy import OccupancySampler
from nerf_lightning.nerf.samplers.proposal import ProposalSampler
from nerf_lightning.nerf.samplers.stratified import StratifiedSampler
from nerf_lightning.nerf.types.rays import RayBundle

CAPACITY = 1 << 15


class StaticSampler(OccupancySampler):
    """An occupancy grid that packs samples into a fixed capacity on every device, as it does on GPUs."""

    def capacity_for(self, rays: RayBundle) -> int | None:
        """Return the capacity."""
        return self.capacity


@dataclass(frozen=True)
class Method:
    """A kind of model, and what trains it."""

    model: Callable[[], RadianceModel]
    loss: Callable[[], Loss]
    optimizer: Callable[[Iterable[Any]], Optimizer]
    layers: int
    """Products of matrices that follow one another in a forward pass: rounding adds up over them."""
    same_as: str | None = None
    """The method that computes the same in another way, whose reference is taken."""


def mlp_field() -> NerfMLP:
    """Return an MLP of three layers of 32."""
    encoders = FrequencyEncoder(5), FrequencyEncoder(2)
    return NerfMLP(*encoders, depth=3, width=32, skip=2, density_activation="softplus")


def hash_field(levels: int, features: int, width: int) -> HashField:
    """Return a field behind a small hash grid, whose finer half is hashed."""
    encoder = HashGridEncoder(levels, features, log2_table_size=11, min_resolution=4, max_resolution=48)
    return HashField(encoder, SphericalHarmonicsEncoder(2), width=width, density_bias=0.0)


def coarse_and_fine() -> RadianceModel:
    """Return the original method: two MLPs, stratified and importance samples."""
    coarse, fine = DenseLevel(StratifiedSampler(16), mlp_field()), DenseLevel(ImportanceSampler(16), mlp_field())
    return RadianceModel({"coarse": coarse, "fine": fine})


def behind_a_grid(level: type[PackedLevel] | type[MaskedLevel], sampler: type[OccupancySampler]) -> RadianceModel:
    """Return a hash grid behind an occupancy grid that is updated every 8 steps."""
    settings: dict[str, Any] = {"resolution": 16, "num_steps": 48, "update_every": 8, "warmup_steps": 16}
    # Opaque matter is cut off where nothing can be seen of it any more, so that cutting changes no comparison.
    return RadianceModel(
        {"fine": level(sampler(**settings, opaque_below=1e-6, capacity=CAPACITY), hash_field(4, 4, 32))}
    )


def with_proposals() -> RadianceModel:
    """Return two hash grids, the first of which proposes where to look."""
    proposal = ProposalLevel(StratifiedSampler(32), hash_field(3, 2, 16))
    return RadianceModel({"proposal": proposal, "fine": DenseLevel(ProposalSampler(16), hash_field(4, 4, 32))})


def _adam(groups: Iterable[Any]) -> Optimizer:
    return torch.optim.Adam(groups, lr=5e-3, eps=1e-7, fused=True)


def _table_adam(groups: Iterable[Any]) -> Optimizer:
    return TableAdam(groups, lr=2e-2)


METHODS = {
    "coarse and fine MLP": Method(coarse_and_fine, MeanSquaredError, _adam, 6),
    "packed hash grid": Method(lambda: behind_a_grid(PackedLevel, OccupancySampler), MeanSquaredError, _table_adam, 5),
    "packed hash grid, fixed capacity": Method(
        lambda: behind_a_grid(PackedLevel, StaticSampler), MeanSquaredError, _table_adam, 5, "packed hash grid"
    ),
    "masked hash grid": Method(lambda: behind_a_grid(MaskedLevel, OccupancySampler), MeanSquaredError, _table_adam, 5),
    "proposal hash grids": Method(with_proposals, ProposalLoss, _table_adam, 5),
}

"""Radiance fields as a library that needs torch, and neither Lightning nor Hydra.

The names are loaded when they are asked for; `__init__.pyi` has their types.
"""

import importlib
from typing import Any

_OFFERED = {
    "all_pixels": "nerf_lightning.nerf.geometry.cameras",
    "batch_random": "nerf_lightning.nerf.randomness",
    "Cameras": "nerf_lightning.nerf.types.scene",
    "composite": "nerf_lightning.nerf.rendering.quadrature",
    "composite_ragged": "nerf_lightning.nerf.rendering.ragged",
    "contract": "nerf_lightning.nerf.geometry.contraction",
    "DenseLevel": "nerf_lightning.nerf.models.dense_level",
    "FieldOutput": "nerf_lightning.nerf.types.renderings",
    "fold": "nerf_lightning.nerf.randomness",
    "FrequencyEncoder": "nerf_lightning.nerf.encoders.frequency",
    "HashGridEncoder": "nerf_lightning.nerf.encoders.hash_grid",
    "ImportanceSampler": "nerf_lightning.nerf.samplers.importance",
    "look_at": "nerf_lightning.nerf.geometry.poses",
    "MeanSquaredError": "nerf_lightning.nerf.losses.mse",
    "NerfMLP": "nerf_lightning.nerf.fields.nerf_mlp",
    "NGPField": "nerf_lightning.nerf.fields.ngp_field",
    "OccupancySampler": "nerf_lightning.nerf.samplers.occupancy",
    "Picture": "nerf_lightning.nerf.models.render_image",
    "pinhole_cameras": "nerf_lightning.nerf.geometry.cameras",
    "Points": "nerf_lightning.nerf.types.points",
    "ProposalLevel": "nerf_lightning.nerf.models.proposal_level",
    "ProposalLoss": "nerf_lightning.nerf.losses.proposal",
    "ProposalSampler": "nerf_lightning.nerf.samplers.proposal",
    "RadianceModel": "nerf_lightning.nerf.models.radiance_model",
    "RaggedLevel": "nerf_lightning.nerf.models.ragged_level",
    "RaggedSamples": "nerf_lightning.nerf.types.rays",
    "RayBundle": "nerf_lightning.nerf.types.rays",
    "RayGenerator": "nerf_lightning.nerf.models.ray_generator",
    "rays_through_pixels": "nerf_lightning.nerf.geometry.cameras",
    "RaySamples": "nerf_lightning.nerf.types.rays",
    "render_picture": "nerf_lightning.nerf.models.render_image",
    "render_rays": "nerf_lightning.nerf.models.render_image",
    "Rendering": "nerf_lightning.nerf.types.renderings",
    "Scene": "nerf_lightning.nerf.types.scene",
    "SphericalHarmonicsEncoder": "nerf_lightning.nerf.encoders.spherical_harmonics",
    "StratifiedSampler": "nerf_lightning.nerf.samplers.stratified",
    "weights_from_density": "nerf_lightning.nerf.rendering.quadrature",
}


def __getattr__(name: str) -> Any:
    """Load a part only now: some bring numba."""
    if name not in _OFFERED:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(importlib.import_module(_OFFERED[name]), name)


def __dir__() -> list[str]:
    return [*globals(), *_OFFERED]

"""Early termination: samples behind opaque ones (`sampler.opaque_below`) are neither counted nor given a color.

The number: `opaque_below` in conf/sampler/occupancy.yaml, or else OPAQUE_BELOW in `base.py`.
"""

import torch
from jaxtyping import Float
from torch import Tensor

from nerf_lightning.nerf.fields.base import Field
from nerf_lightning.nerf.kernels.ragged.op import first_of_each_ray, num_visible
from nerf_lightning.nerf.kernels.render.op import sample_density
from nerf_lightning.nerf.randomness import RayRandom
from nerf_lightning.nerf.rendering.quadrature import composite_ragged
from nerf_lightning.nerf.rendering.sample_points import ragged_points
from nerf_lightning.nerf.samplers.base import RaggedSampler
from nerf_lightning.nerf.types.rays import RaggedSamples, RayBundle
from nerf_lightning.nerf.types.renderings import FieldOutput, Rendering

# Samples of a ray in one chunk; more where few rays are left.
CHUNK_SAMPLES, MOST_CHUNK_SAMPLES = 6, 64
# In rendering, samples less opaque than this keep their density but lose their color.
LEAST_ALPHA = 1e-3


def visible_samples(
    sampler: RaggedSampler, field: Field, rays: RayBundle, random: RayRandom | None
) -> tuple[RaggedSamples, Float[Tensor, "capacity features"] | None]:
    """Return the samples of each ray up to where it is opaque, and the features that were computed to find out.

    Without gradients. `found` counts the returned samples and those that did not fit. If sizes may be read on the host,
    most hidden samples are never computed; otherwise (CUDA graphs) the density of all is.
    """
    samples, capacity = sampler(rays, random), sampler.capacity_for(rays)
    if sampler.opaque_below == 0:
        return samples, None
    with torch.no_grad():
        if capacity is None:
            counts, features = _until_opaque(sampler, field, rays, samples, random)
        else:
            density, features = _density(field, rays, samples, random)
            counts = num_visible(density, samples, sampler.opaque_below)
        return first_of_each_ray(samples, counts, features, capacity)


def render_until_opaque(
    sampler: RaggedSampler, field: Field, rays: RayBundle, background: Float[Tensor, "rays 3"] | None
) -> Rendering:
    """Render rays without gradients, chunk by chunk, until each is opaque or has left the scene."""
    marcher = sampler.marcher(rays)
    rgb, depth = torch.zeros_like(rays.origins), torch.zeros_like(rays.near)
    channels: dict[str, Tensor] = {}
    light = torch.ones_like(rays.near)  # what no sample has absorbed yet
    alive = torch.arange(rays.near.shape[0], device=rays.near.device)
    while alive.numel():
        left = rays[alive]
        samples, more = marcher.advance(alive, _samples_per_chunk(rays.near.shape[0], alive.numel()))
        part = composite_ragged(_visible_colors(field, left, samples), samples, left, None)
        before = light[alive]
        rgb[alive] += before[:, None] * part.foreground
        depth[alive] += before * (part.depth - (1.0 - part.opacity) * left.far)
        for name, channel in part.channels.items():
            total = channels.setdefault(name, channel.new_zeros(rays.near.shape[0], channel.shape[1]))
            total[alive] += before[:, None] * channel
        light[alive] = before * (1.0 - part.opacity)
        alive = alive[more & (light[alive] > sampler.opaque_below)]
    return Rendering.from_light(rays, background, rgb, light, depth, channels)


def _density(
    field: Field, rays: RayBundle, samples: RaggedSamples, random: RayRandom | None, first: int = 0
) -> tuple[Float[Tensor, "capacity"], Float[Tensor, "capacity features"] | None]:
    found = sample_density(rays, samples, field.parts(), field.matmul_precision) if rays.near.is_cuda else None
    if found is not None:
        return found
    density, features = field.density(ragged_points(rays, samples, random, field.sees_cones, first))
    return density.float(), features


def _until_opaque(
    sampler: RaggedSampler, field: Field, rays: RayBundle, samples: RaggedSamples, random: RayRandom | None
) -> tuple[Tensor, Tensor | None]:
    """Return how many samples of each ray are visible, and the features of all that were computed."""
    density, features = torch.zeros_like(samples.starts), None
    sample_index, counts, asked = samples.sample_index, samples.bounds.diff(), 0
    while rays_left := int((counts > asked).sum()):
        until = asked + _samples_per_chunk(counts.shape[0], rays_left)
        in_chunk = (counts.clamp(max=until) - asked).clamp(min=0)
        until_there = counts.clamp(max=until).index_select(0, samples.ray_index)
        number = ((sample_index >= asked) & (sample_index < until_there)).nonzero()[:, 0]
        part = samples.at(number, torch.cat([counts.new_zeros(1), in_chunk.cumsum(0)]))
        density[number], computed = _density(field, rays, part, random, first=asked)
        if computed is not None:
            features = computed.new_empty(*sample_index.shape, computed.shape[1]) if features is None else features
            features[number] = computed
        counts = num_visible(density, samples, sampler.opaque_below)
        asked = until
    return counts, features


def _visible_colors(field: Field, rays: RayBundle, samples: RaggedSamples) -> FieldOutput:
    # Most samples are almost transparent: their color, the most expensive part, is not computed.
    points = ragged_points(rays, samples, None, field.sees_cones)
    density, features = field.density(points)
    if features is None:
        return field(points)
    seen = (-torch.expm1(-density * samples.deltas) > LEAST_ALPHA).nonzero()[:, 0]
    output = field(points[seen], features[seen])

    def scatter(values: Tensor) -> Tensor:
        return values.new_zeros(density.shape[0], values.shape[1]).index_copy_(0, seen, values)

    rgb = density.new_zeros(density.shape[0], 3)
    rgb[seen] = output.rgb
    return FieldOutput(density, rgb, channels={name: scatter(values) for name, values in output.channels.items()})


def _samples_per_chunk(rays: int, rays_left: int) -> int:
    return min(MOST_CHUNK_SAMPLES, CHUNK_SAMPLES * rays // rays_left)

"""Volume rendering of ragged samples: the quadrature of `rendering.quadrature` in the ragged layout."""

from typing import Any

from jaxtyping import Float
from torch import Tensor

from nerf_lightning.nerf.kernels.ragged.op import integrate
from nerf_lightning.nerf.types.rays import RaggedSamples, RayBundle
from nerf_lightning.nerf.types.renderings import FieldOutput, RaggedRendering


def composite_ragged(
    output: FieldOutput,
    samples: RaggedSamples,
    rays: RayBundle,
    background: Float[Tensor, "rays 3"] | None,
) -> RaggedRendering:
    """Render one level. Light that escapes belongs to `background` and, in the depth, to far.

    Args:
        output: density and color at the samples' midpoints.
        samples: the intervals.
        rays: the rays, with far.
        background: color behind each ray; None leaves the rays open in front of black.
    """
    *sums, weights = integrate(output.density, output.rgb, samples)
    channels = {name: sum_over_rays(weights[:, None] * each, samples) for name, each in output.channels.items()}
    of_the_kind: dict[str, Any] = {"weights": weights, "samples": samples, "channels": channels}
    return RaggedRendering.from_sums(rays, background, *sums, **of_the_kind)


def sum_over_rays(values: Float[Tensor, "capacity n"], samples: RaggedSamples) -> Float[Tensor, "rays n"]:
    """Return the sum of each ray's values."""
    total = values.new_zeros(samples.bounds.shape[0] - 1, values.shape[1])
    return total.index_add(0, samples.ray_index, values)

"""Volume rendering of packed samples: the quadrature of `rendering.quadrature`, in the other layout."""

from jaxtyping import Float
from torch import Tensor

from nerf_lightning.kernels.packed import integrate
from nerf_lightning.types.rays import PackedSamples, RayBundle
from nerf_lightning.types.renderings import FieldOutput, PackedRendering


def composite_packed(
    output: FieldOutput,
    samples: PackedSamples,
    rays: RayBundle,
    background: Float[Tensor, "rays 3"] | None,
) -> PackedRendering:
    """Render one level. Light that escapes belongs to `background` and, in the depth, to far.

    Args:
        output: density and colour at the samples' midpoints.
        samples: the intervals.
        rays: where far stands.
        background: colour behind each ray; None leaves the rays open in front of black.
    """
    foreground, opacity, depth, weights = integrate(output.density, output.rgb, samples)
    escaped = 1.0 - opacity
    return PackedRendering(
        rgb=foreground if background is None else foreground + escaped[:, None] * background,
        foreground=foreground,
        opacity=opacity,
        depth=depth + escaped * rays.far,
        weights=weights,
        samples=samples,
    )

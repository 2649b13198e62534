"""A level in which every ray has the same number of samples, as in the original NeRF."""

import torch
from jaxtyping import Float
from torch import Tensor

from nerf_lightning.nerf.fields.base import Field
from nerf_lightning.nerf.kernels.render.op import DENSE, FieldParts, has_dense_kernel, render_dense_rays, render_samples
from nerf_lightning.nerf.models.level import Level
from nerf_lightning.nerf.randomness import RayRandom
from nerf_lightning.nerf.ranges import require_ranges
from nerf_lightning.nerf.rendering.near_gradients import soften_near_gradients
from nerf_lightning.nerf.rendering.quadrature import composite, rendering_of
from nerf_lightning.nerf.rendering.sample_points import points_along
from nerf_lightning.nerf.samplers.base import OPAQUE_BELOW, DenseSampler, Sampler
from nerf_lightning.nerf.types.rays import Points, RayBundle, RaySamples
from nerf_lightning.nerf.types.renderings import DenseRendering, FieldOutput
from nerf_lightning.nerf.types.scene import Scene


class DenseLevel(Level):
    """A level in which every ray has the same number of samples.

    Args:
        sampler: chooses where the field is evaluated.
        field: density and color.
        gradient_scaling_distance: distance from the camera (scene units) within which gradients are scaled down,
            against floaters (`soften_near_gradients`); 0: nowhere, as in normalized device coordinates, which have no
            such distance.
    """

    sampler: DenseSampler
    sampler_kind = DenseSampler
    takes_coupled_fields = True
    kernels = (DENSE, "mlp.cpu", "hash_grid.cpu", "histograms.cpu", "random.cpu", "pixels.cpu", "table_adam.cpu")

    def __init__(self, sampler: Sampler, field: Field, gradient_scaling_distance: float = 0.0):
        super().__init__(sampler, field)
        require_ranges(locals(), {"gradient_scaling_distance": (0, float("inf"))})
        self.gradient_scaling_distance = gradient_scaling_distance

    def points_per_ray(self, before: float, training: bool) -> float:
        """Return the sampler's number of samples."""
        return float(self.sampler.num_samples_after(int(before)))

    def fit_to(self, scene: Scene) -> None:
        """Record whether the scene's distances are real ones."""
        if scene.cameras.ndc is not None:
            self.gradient_scaling_distance = 0.0

    def compile_field(self) -> bool:
        """Compile the field for static shapes: dynamic ones may be specialized differently after a resume."""
        if self.field.compiles:
            self.field.compile(dynamic=False)
        return self.field.compiles

    def forward(
        self,
        rays: RayBundle,
        background: Float[Tensor, "*rays 3"] | None,
        history: list[DenseRendering],
        random: RayRandom | None,
    ) -> DenseRendering:
        """Sample, evaluate the field at the midpoints, and composite.

        A kernel does the last two in one, if possible; the code below is its reference. Only the kernel ends rays where
        they are opaque.
        """
        samples = self.sampler(rays, history, random)
        whole_from = 0.0 if random is None else self.gradient_scaling_distance
        rendering = self._by_kernels(rays, samples, background, whole_from)
        if rendering is not None:
            return rendering
        seen = self.field_output(points_along(rays, samples, random, self.field.sees_cones))
        if whole_from:
            seen = soften_near_gradients(seen, samples.midpoints, whole_from)
        return composite(seen, samples, rays, background)

    def _by_kernels(
        self, rays: RayBundle, samples: RaySamples, background: Float[Tensor, "rays 3"] | None, whole_from: float
    ) -> DenseRendering | None:
        """Return the samples rendered by kernels; None if none support the field, or all that is needed."""
        plain = rays.near.dim() != 1 or rays.near.dtype != torch.float32
        parts = None if plain else self._parts_on(rays.near.device)
        if parts is None:
            return None
        precision, closed = self.field.matmul_precision, background is None
        if rays.near.device.type == "cpu":
            weights, foreground = render_dense_rays(
                rays, samples.edges, parts, precision, closed, whole_from, OPAQUE_BELOW
            )
            return rendering_of(weights, foreground, samples, rays, background)
        integrated = render_samples(rays, samples, parts, precision, closed, whole_from)
        if integrated is None:
            return None
        *sums, weights = integrated
        return DenseRendering.from_sums(rays, background, *sums, weights=weights, samples=samples)

    def takes_whole_rays(self, device: torch.device, training: bool, learns_cameras: bool = False) -> bool:
        """Return whether there is a kernel for the field, which then has gradients of rays, too."""
        return device.type == "cpu" and self._parts_on(device) is not None

    def field_parts(self) -> FieldParts | None:
        """Return what whole-ray kernels compute with; None if `field_output` differs from the field's output.

        A level that changes `field_output` must change this accordingly.
        """
        return self.field.parts() if type(self).field_output is DenseLevel.field_output else None

    def _parts_on(self, device: torch.device) -> FieldParts | None:
        """Return the field's parts if there is a kernel for them."""
        # On other devices, reading them would wait for the device.
        parts = self.field_parts() if device.type in ("cpu", "cuda") else None
        if parts is None or device.type == "cuda":
            return parts
        return parts if has_dense_kernel(parts, self.field.matmul_precision, device) else None

    def field_output(self, points: Points) -> FieldOutput:
        """Return the field's output at the samples."""
        return self.field(points)

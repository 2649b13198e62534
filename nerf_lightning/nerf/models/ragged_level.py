"""A level with packed samples: it computes only where its sampler says that there may be something."""

from threading import Lock
from typing import Any

import torch
from jaxtyping import Float, Int
from torch import Tensor, nn

from nerf_lightning.messages.errors import ANOTHER, InputError
from nerf_lightning.nerf.fields.base import Field
from nerf_lightning.nerf.kernels.render.op import (
    LEARNING,
    RENDERING,
    FieldParts,
    has_kernel,
    render_samples,
    render_whole_rays,
    takes_samples,
)
from nerf_lightning.nerf.models.level import Level
from nerf_lightning.nerf.part import Part, StepContext
from nerf_lightning.nerf.randomness import RayRandom
from nerf_lightning.nerf.rendering.quadrature import composite_ragged
from nerf_lightning.nerf.rendering.sample_points import ragged_points
from nerf_lightning.nerf.samplers.base import RaggedSampler, Sampler
from nerf_lightning.nerf.samplers.early_termination import LEAST_ALPHA, render_until_opaque, visible_samples
from nerf_lightning.nerf.types.rays import RaggedSamples, RayBundle
from nerf_lightning.nerf.types.renderings import RaggedRendering, Rendering

MOST_SAMPLES = 1 << 22
"""Maximum number of samples rendered at once: their features take a gigabyte and a half."""
MOST_PER_RAY = 1 << 12
"""Maximum number of samples per ray that a count can have."""
# Threads may process tiles of one step in parallel.
COUNTING = Lock()


class RaggedLevel(Level):
    """Sample, drop what is behind opaque samples, evaluate the field, and composite.

    A kernel renders whole rays, if possible; the code below is its reference.
    """

    sampler: RaggedSampler
    sampler_kind = RaggedSampler
    has_static_shapes = False
    kernels = (
        *(LEARNING, RENDERING, "mlp.cpu", "hash_grid.cpu", "carving.cpu"),
        *("march.cpu", "random.cpu", "pixels.cpu", "table_adam.cpu"),
    )

    def __init__(self, sampler: Sampler, field: Field):
        super().__init__(sampler, field)
        self.counter = SampleCounter()

    def forward(
        self,
        rays: RayBundle,
        background: Float[Tensor, "rays 3"] | None,
        history: list[Rendering],
        random: RayRandom | None,
    ) -> Rendering:
        """Render rays; without random numbers and gradients, as at evaluation, in chunks of samples."""
        evaluates = random is None and not torch.is_grad_enabled()
        whole = self._whole_rays(rays, background, random, evaluates)
        if whole is not None:
            return whole
        if evaluates:
            seen = self._all_samples_of(rays, background) if rays.near.is_cuda else None
            return render_until_opaque(self.sampler, self.field, rays, background) if seen is None else seen
        samples, features = visible_samples(self.sampler, self.field, rays, random)
        self.counter.add(samples.found, rays.near.shape[0], samples.found - samples.bounds[-1])
        fused = self._fused(rays, samples, background, features) if rays.near.is_cuda else None
        if fused is not None:
            return fused
        output = self.field(ragged_points(rays, samples, random, self.field.sees_cones), features)
        return composite_ragged(output, samples, rays, background)

    def _all_samples_of(self, rays: RayBundle, background: Float[Tensor, "rays 3"] | None) -> Rendering | None:
        """Render rays with all their samples at once; None if there are too many, or no kernels.

        A GPU computes hidden samples faster than it launches kernels for one chunk after another.
        """
        if not takes_samples(rays, self.field.parts()):
            return None
        everyone = torch.arange(rays.near.shape[0], device=rays.near.device)
        samples, _ = self.sampler.marcher(rays).advance(everyone, self.sampler.max_intervals)
        return self._fused(rays, samples, background) if samples.starts.numel() <= MOST_SAMPLES else None

    def _fused(
        self,
        rays: RayBundle,
        samples: RaggedSamples,
        background: Float[Tensor, "rays 3"] | None,
        features: Float[Tensor, "capacity features"] | None = None,
    ) -> Rendering | None:
        """Render samples with the kernels for CUDA; None if these do not support all that is needed."""
        parts, precision = self.field.parts(), self.field.matmul_precision
        integrated = render_samples(rays, samples, parts, precision, features=features)
        if integrated is None:
            return None
        *sums, weights = integrated
        return RaggedRendering.from_sums(rays, background, *sums, weights=weights, samples=samples)

    def takes_whole_rays(self, device: torch.device, training: bool, learns_cameras: bool = False) -> bool:
        """Return whether a kernel processes whole rays: in training, only without weights and gradients of rays."""
        return self._parts_on(device, training, learns_cameras) is not None

    def _parts_on(self, device: torch.device, training: bool, learns_cameras: bool) -> FieldParts | None:
        """Return the field's parts if there is a kernel for them."""
        if device.type != "cpu" or (training and (self.returns_weights or learns_cameras)):
            return None  # on other devices, reading the parts would wait for the device
        parts = self.field.parts()
        return parts if has_kernel(parts, self.field.matmul_precision, device, gradients=training) else None

    def _whole_rays(
        self, rays: RayBundle, background: Float[Tensor, "rays 3"] | None, random: RayRandom | None, evaluates: bool
    ) -> Rendering | None:
        matmul_precision, sampler = self.field.matmul_precision, self.sampler
        trains = torch.is_grad_enabled()
        # Learned focal lengths and lenses change only directions.
        moved = any(each.requires_grad for each in (rays.origins, rays.directions, rays.view_directions))
        parts = self._parts_on(rays.near.device, trains, moved) if evaluates or trains else None
        if parts is None:
            return None
        march = sampler.marcher(rays).grid_march() if evaluates else sampler.grid_march(rays, random)
        if march is None:
            return None
        expected = None if evaluates else self.points_per_ray(1.0, training=True)
        found = render_whole_rays(rays, parts, march, matmul_precision, sampler.opaque_below, LEAST_ALPHA, expected)
        if not evaluates:
            self.counter.add(torch.tensor(found.samples), rays.near.shape[0], torch.tensor(0))
        return Rendering.from_light(rays, background, found.rgb, 1.0 - found.opacity, found.depth)

    def points_per_ray(self, before: float, training: bool) -> float:
        """Return the recent count in training; in rendering, all that are found on a GPU, and few (1) elsewhere."""
        counted = self.counter.per_ray
        if training:
            return max(1.0, float(self.sampler.samples_at_first) if counted is None else counted)
        if counted is None or self.counter.mean.device.type != "cuda":
            return 1.0
        return max(1.0, self.sampler.found_per_visible * counted)

    def on_step(self, context: StepContext) -> None:
        """Let the sampler learn when it is time, and average the samples per ray of the steps since."""
        if context.step % self.sampler.update_every and context.step != 1:
            return
        self.sampler.learn(self.field_density, context.step, context.key)
        self.counter.average()


class SampleCounter(Part):
    """Count samples on the device; `per_ray` is read on the host once after each average."""

    counts: Int[Tensor, "3"]
    """Samples and rays since the last average, and samples that exceeded the capacity, ever."""
    mean: Float[Tensor, ""]
    """Samples per ray before the last average; negative: unknown."""

    def __init__(self) -> None:
        super().__init__()
        self.register_buffer("counts", torch.zeros(3, dtype=torch.int64))
        self.register_buffer("mean", torch.tensor(-1.0))
        self._per_ray: float | None = None

    def add(self, samples: Int[Tensor, ""], rays: int, dropped: Int[Tensor, ""]) -> None:
        """Count rays and their samples, and samples that did not fit."""
        counted = torch.stack([samples, torch.full_like(samples, rays), dropped])
        with COUNTING:
            self.counts += counted

    def average(self) -> None:
        """Take the mean over the rays since the last average."""
        if int(self.counts[1]):
            self.mean.copy_(self.counts[0] / self.counts[1])
            self.counts[:2] = 0
            self._per_ray = None

    @property
    def per_ray(self) -> float | None:
        """The mean number of samples per ray; None if it is not known yet."""
        if self._per_ray is None:
            self._per_ray = float(self.mean)
        return self._per_ray if self._per_ray >= 0 else None

    def sample_counts(self) -> list[Tensor]:
        """Return samples and rays since the last average."""
        return [self.counts]

    def buffers_to_average(self) -> list[Tensor]:
        """Return the samples per ray; `per_ray` reads them again after this."""
        self._per_ray = None
        return [self.mean]

    def statistics(self) -> dict[str, float]:
        """Return samples per ray, and samples that did not fit."""
        return {"speed/samples_per_ray": float(self.mean), "train/dropped_samples": float(self.counts[2])}

    def reset_statistics(self) -> None:
        """Reset all counts."""
        self.counts.zero_()
        self.mean.fill_(-1.0)
        self._per_ray = None

    def reset_parameters(self) -> None:
        """Reset all counts."""
        self.reset_statistics()

    def validate_state(self) -> None:
        """Check the loaded state.

        Raises:
            InputError: negative counts, or an impossible mean.
        """
        if bool((self.counts < 0).any()) or not -1.0 <= float(self.mean) <= MOST_PER_RAY:
            raise InputError(f"The samples per ray in the model's state are not valid counts. {ANOTHER}")

    def _load_from_state_dict(self, *args: Any, **kwargs: Any) -> None:
        super()._load_from_state_dict(*args, **kwargs)
        self._per_ray = None


def average_counts(module: nn.Module) -> None:
    """Let every counter within a module take the mean over the rays since its last average."""
    for part in module.modules():
        if isinstance(part, SampleCounter):
            part.average()

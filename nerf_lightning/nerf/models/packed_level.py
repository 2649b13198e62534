"""A level whose samples are packed: only where its sampler says that there may be something is anything computed."""

from threading import Lock
from types import ModuleType
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from nerf_lightning.errors import ANOTHER, InputError
from nerf_lightning.nerf.fields.base import Field
from nerf_lightning.nerf.kernels.packed.integrate import num_visible
from nerf_lightning.nerf.kernels.render.parts import FieldParts
from nerf_lightning.nerf.kernels.render.whole_rays import whole_rays
from nerf_lightning.nerf.models.level import Level
from nerf_lightning.nerf.randomness import RayRandom
from nerf_lightning.nerf.rendering.packed import composite_packed, first_of_each_ray
from nerf_lightning.nerf.rendering.sample_points import packed_points
from nerf_lightning.nerf.samplers.base import PackedSampler, Sampler
from nerf_lightning.nerf.types.rays import PackedSamples, RayBundle
from nerf_lightning.nerf.types.renderings import FieldOutput, PackedRendering, Rendering

# So many samples per ray at most can have been counted.
MOST_SAMPLES = 1 << 12
# In rendering, samples less opaque than this keep their density and lose their colour.
LEAST_ALPHA = 1e-3
# Samples of a ray that are asked about in one round; more where few rays are left.
ROUND_SAMPLES, MOST_ROUND_SAMPLES = 6, 64
# Tiles of a step may be taken by threads beside each other.
COUNTING = Lock()


class PackedLevel(Level):
    """Sample, drop what lies behind opaque samples, ask the field, composite."""

    sampler: PackedSampler
    sampler_kind = PackedSampler
    has_static_shapes = False
    replays = True  # with arrays of a capacity, which no size is read for
    tally: Tensor
    measured: Tensor

    def __init__(self, sampler: Sampler, field: Field):
        super().__init__(sampler, field)
        # Samples and rays since the last update of the grid, and samples that exceeded the capacity, ever.
        self.register_buffer("tally", torch.zeros(3, dtype=torch.int64))
        # Samples per ray before the last update; negative: unknown.
        self.register_buffer("measured", torch.tensor(-1.0))
        self._samples_per_ray: float | None = None

    def points_per_ray(self, before: float, training: bool) -> float:
        """In training, as lately measured; in rendering 1, since few rays have more than a handful at a time."""
        if not training:
            return 1.0
        if self._samples_per_ray is None:
            self._samples_per_ray = float(self.measured)
        return max(1.0, self._samples_per_ray if self._samples_per_ray >= 0 else float(self.sampler.samples_at_first))

    def forget_measurements(self) -> None:
        """Forget how many samples rays have."""
        self.tally.zero_()
        self.measured.fill_(-1.0)
        self._samples_per_ray = None

    def update(self, step: int, key: int) -> None:
        """Let the sampler learn, where it is time, and take the mean of the samples per ray of the steps since."""
        if step % self.sampler.update_every and step != 1:
            return
        super().update(step, key)
        if int(self.tally[1]):
            self.measured.copy_(self.tally[0] / self.tally[1])
            self.tally[:2] = 0
            self._samples_per_ray = None

    def counts(self) -> list[Tensor]:
        """Return samples and rays since the sampler's last update."""
        return [self.tally]

    def measurements(self) -> list[Tensor]:
        """Return the samples per ray; `points_per_ray` reads them again after this."""
        self._samples_per_ray = None
        return [self.measured]

    def statistics(self) -> dict[str, float]:
        """Samples per ray, samples for which there was no room, and what the sampler has to say."""
        counted = {"speed/samples_per_ray": float(self.measured), "train/dropped_samples": float(self.tally[2])}
        return counted | self.sampler.statistics()

    def require_sound_state(self) -> None:
        """Look at what was loaded.

        Raises:
            InputError: counts that are none.
        """
        if bool((self.tally < 0).any()) or not -1.0 <= float(self.measured) <= MOST_SAMPLES:
            raise InputError(f"The samples per ray in the model's state are no counts. {ANOTHER}")

    def _load_from_state_dict(self, *args: Any, **kwargs: Any) -> None:
        super()._load_from_state_dict(*args, **kwargs)
        self._samples_per_ray = None

    def forward(
        self,
        rays: RayBundle,
        background: Float[Tensor, "rays 3"] | None,
        history: list[Rendering],
        random: RayRandom | None,
    ) -> Rendering:
        """Render rays; without random numbers round by round, until each ray is opaque or has left the scene."""
        if random is None and not torch.is_grad_enabled():
            return self._render(rays, background)
        whole = self._whole_rays(rays, background, random)
        if whole is not None:
            return whole
        samples, features = self.visible_samples(rays, random)
        capacity = self.sampler.capacity_for(rays)
        dropped = 0 if capacity is None else samples.found - samples.found.clamp(max=capacity)
        self._count(samples.found, rays, torch.zeros_like(samples.found) + dropped)
        output = self.field(packed_points(rays, samples, random, self.field.sees_cones), features)
        return composite_packed(output, samples, rays, background)

    def _count(self, samples: Tensor, rays: RayBundle, dropped: Tensor) -> None:
        counted = torch.stack([samples, torch.full_like(samples, rays.near.shape[0]), dropped])
        with COUNTING:
            self.tally += counted

    def _whole_rays(
        self, rays: RayBundle, background: Float[Tensor, "rays 3"] | None, random: RayRandom | None
    ) -> Rendering | None:
        """Render with gradients, in one kernel for whole rays, where there is one; it keeps no weights."""
        # Where cameras are learnt, rays have gradients, which that kernel does not know.
        if not torch.is_grad_enabled() or rays.origins.requires_grad:
            return None
        parts, found = self._learning_kernels()
        march = None if found is None else self.sampler.march(rays, random)
        if march is None or parts is None or found is None:
            return None
        kernels, dtype = found
        expected = self.points_per_ray(1.0, training=True)
        rgb, opacity, depth, asked = kernels.render(rays, parts, *march, self.sampler.opaque_below, dtype, expected)
        self._count(torch.tensor(asked), rays, torch.tensor(0))
        return _in_front_of(background, rays, rgb, 1.0 - opacity, depth)

    def _learning_kernels(self) -> tuple[FieldParts | None, tuple[ModuleType, torch.dtype] | None]:
        # They are the CPU's; on other devices the field's parts would be read on the host.
        device = self.tally.device
        parts = None if self.keeps_weights or device.type != "cpu" else self.field.parts()
        return parts, whole_rays(parts, self.field.products, device, gradients=True)

    def takes_whole_rays(self, rays: RayBundle) -> bool:
        """Tell whether training renders rays in one kernel, where cameras are not learnt."""
        return self._learning_kernels()[1] is not None and self.sampler.march(rays, None) is not None

    def visible_samples(
        self, rays: RayBundle, random: RayRandom | None
    ) -> tuple[PackedSamples, Float[Tensor, "capacity features"] | None]:
        """Return the samples of each ray up to where it is opaque, and the features that were computed to see that.

        Without gradients. Where sizes may not be read on the host, all samples are kept.
        """
        samples = self.sampler(rays, random)
        if self.sampler.capacity_for(rays) is not None or self.sampler.opaque_below == 0:
            return samples, None
        with torch.no_grad():
            counts, features = self._until_opaque(rays, samples, random)
            kept = first_of_each_ray(samples, counts)
            return samples.at(*kept), None if features is None else features.index_select(0, kept[0])

    def _until_opaque(
        self, rays: RayBundle, samples: PackedSamples, random: RayRandom | None
    ) -> tuple[Tensor, Tensor | None]:
        """Return how many samples of each ray are visible, and the features of all that were asked about.

        Rays are asked round by round, so that most of what lies behind opaque samples never is.
        """
        density, features = torch.zeros_like(samples.starts), None
        place, counts, asked = samples.place, samples.bounds.diff(), 0
        while rays_left := int((counts > asked).sum()):
            until = asked + _samples_in_round(counts.shape[0], rays_left)
            in_round = (counts.clamp(max=until) - asked).clamp(min=0)
            until_there = counts.clamp(max=until).index_select(0, samples.ray_index)
            number = ((place >= asked) & (place < until_there)).nonzero()[:, 0]
            part = samples.at(number, torch.cat([counts.new_zeros(1), in_round.cumsum(0)]))
            found, computed = self.field.density(packed_points(rays, part, random, self.field.sees_cones, first=asked))
            density[number] = found.float()
            if computed is not None:
                features = computed.new_empty(*place.shape, computed.shape[1]) if features is None else features
                features[number] = computed
            counts = num_visible(density, samples, self.sampler.opaque_below)
            asked = until
        return counts, features

    def _render(self, rays: RayBundle, background: Float[Tensor, "rays 3"] | None) -> Rendering:
        walk = self.sampler.walk(rays)
        march, parts = walk.march(), self.field.parts()
        found = whole_rays(parts, self.field.products, rays.near.device)
        if march is not None and found is not None:
            kernels, dtype = found
            rgb, opacity, depth = kernels.render(rays, parts, *march, LEAST_ALPHA, self.sampler.opaque_below, dtype)
            return _in_front_of(background, rays, rgb, 1.0 - opacity, depth)
        rgb, depth = torch.zeros_like(rays.origins), torch.zeros_like(rays.near)
        light = torch.ones_like(rays.near)  # what no sample has absorbed yet
        alive = torch.arange(rays.near.shape[0], device=rays.near.device)
        while alive.numel():
            left = rays[alive]
            samples, more = walk.take(alive, _samples_in_round(rays.near.shape[0], alive.numel()))
            part: PackedRendering = composite_packed(self._colors(left, samples), samples, left, None)
            before = light[alive]
            rgb[alive] += before[:, None] * part.foreground
            depth[alive] += before * (part.depth - (1.0 - part.opacity) * left.far)
            light[alive] = before * (1.0 - part.opacity)
            alive = alive[more & (light[alive] > self.sampler.opaque_below)]
        return _in_front_of(background, rays, rgb, light, depth)

    def _colors(self, rays: RayBundle, samples: PackedSamples) -> FieldOutput:
        # Most samples are all but transparent: their colour, which costs most, is not asked for.
        points = packed_points(rays, samples, None, self.field.sees_cones)
        density, features = self.field.density(points)
        if features is None:
            return self.field(points)
        rgb = density.new_zeros(density.shape[0], 3)
        seen = (-torch.expm1(-density * samples.deltas) > LEAST_ALPHA).nonzero()[:, 0]
        rgb[seen] = self.field(points[seen], features[seen]).rgb
        return FieldOutput(density=density, rgb=rgb)


def _samples_in_round(rays: int, rays_left: int) -> int:
    return min(MOST_ROUND_SAMPLES, ROUND_SAMPLES * rays // rays_left)


def _in_front_of(
    background: Tensor | None, rays: RayBundle, foreground: Tensor, light: Tensor, depth: Tensor
) -> Rendering:
    """Return what is seen, given the light that comes through and the sum of w t."""
    return Rendering(
        rgb=foreground if background is None else foreground + light[:, None] * background,
        foreground=foreground,
        opacity=1.0 - light,
        depth=depth + light * rays.far,
    )

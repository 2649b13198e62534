"""A level whose samples are packed: only what an occupancy grid does not rule out is computed."""

from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from nerf_lightning.errors import ANOTHER, InputError
from nerf_lightning.nerf.fields.base import Field
from nerf_lightning.nerf.kernels.march.march import march
from nerf_lightning.nerf.models.occupancy_level import GridLevel
from nerf_lightning.nerf.randomness import RayRandom
from nerf_lightning.nerf.rendering.packed import composite_packed, positions_of
from nerf_lightning.nerf.samplers.base import AnySampler
from nerf_lightning.nerf.types.rays import PackedSamples, RayBundle
from nerf_lightning.nerf.types.renderings import FieldOutput, PackedRendering, Rendering

# A ray's random numbers are numbered by its samples: no ray has more.
MOST_SAMPLES = 1 << 12
# In rendering, samples less opaque than this keep their density and lose their colour.
LEAST_ALPHA = 1e-3
# Samples that a ray takes in one round of rendering; more where few rays are left.
ROUND_SAMPLES, MOST_ROUND_SAMPLES = 6, 64


class PackedLevel(GridLevel):
    """March, drop what lies behind opaque samples, ask the field, composite."""

    has_static_shapes = False
    tally: Tensor
    measured: Tensor

    def __init__(self, sampler: AnySampler, field: Field):
        super().__init__(sampler, field)
        # Samples and rays since the last update of the grid, and samples that exceeded the capacity, ever.
        self.register_buffer("tally", torch.zeros(3, dtype=torch.int64))
        # Samples per ray before the last update; negative: unknown.
        self.register_buffer("measured", torch.tensor(-1.0, dtype=torch.float64))
        self._samples_per_ray: float | None = None

    def points_per_ray(self, before: float, training: bool) -> float:
        """In training, as lately measured; in rendering 1, since few rays have more than a handful at a time."""
        if not training:
            return 1.0
        if self._samples_per_ray is None:
            self._samples_per_ray = float(self.measured)
        return max(1.0, self._samples_per_ray if self._samples_per_ray >= 0 else float(self.sampler.num_steps))

    def forget_measurements(self) -> None:
        """Forget how many samples rays have."""
        self.tally.zero_()
        self.measured.fill_(-1.0)
        self._samples_per_ray = None

    def update(self, step: int, key: int) -> None:
        """Bring the grid up to date, where it is time, and count the samples per ray of the steps since."""
        if step % self.sampler.update_every and step != 1:
            return
        self.sampler.update(self.field.density, step, key)
        if int(self.tally[1]):
            self.measured.copy_(self.tally[0] / self.tally[1])
            self.tally[:2] = 0
            self._samples_per_ray = None

    def counts(self) -> list[Tensor]:
        """Return samples and rays since the grid's last update."""
        return [self.tally]

    def measurements(self) -> list[Tensor]:
        """Return the samples per ray; who changes them is asked for `points_per_ray` anew."""
        self._samples_per_ray = None
        return [self.measured]

    def statistics(self) -> dict[str, float]:
        """Samples per ray, the share of cells that are occupied, and samples for which there was no room."""
        return {
            "speed/samples_per_ray": float(self.measured),
            "train/occupied": float(self.sampler.cells.float().mean()),
            "train/dropped_samples": float(self.tally[2]),
        }

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
        samples, features = self.sampler(rays, self.field.density_and_features, random)
        capacity = self.sampler.capacity_on(rays.near.device)
        dropped = 0 if capacity is None else samples.found - samples.found.clamp(max=capacity)
        count = torch.full_like(samples.found, rays.near.shape[0])
        self.tally += torch.stack([samples.found, count, torch.zeros_like(count) + dropped])
        return composite_packed(self._ask(rays, samples, random, features), samples, rays, background)

    def _ask(
        self, rays: RayBundle, samples: PackedSamples, random: RayRandom | None, features: Tensor | None = None
    ) -> FieldOutput:
        index = samples.ray_index
        if random is not None and self.field.needs_random:
            random = RayRandom(key=random.key[index], slots=random.slots[index] * MOST_SAMPLES + samples.place)
        # To the field, each sample is a ray with one sample.
        positions, directions = positions_of(rays, samples)[:, None], rays.view_directions[index][:, None]
        if features is None:
            output = self.field(positions, directions, random)
        else:
            output = self.field.from_features(positions, directions, random, features[:, None])
        return FieldOutput(density=output.density[:, 0], rgb=output.rgb[:, 0])

    def _look(self, rays: RayBundle, samples: PackedSamples) -> FieldOutput:
        # Most samples are all but transparent: their colour, which costs most, is not asked for.
        positions = positions_of(rays, samples)
        density, features = self.field.density_and_features(positions)
        if features is None:
            return self._ask(rays, samples, None)
        rgb = density.new_zeros(density.shape[0], 3)
        seen = (-torch.expm1(-density * samples.deltas) > LEAST_ALPHA).nonzero()[:, 0]
        directions = rays.view_directions[samples.ray_index[seen]]
        output = self.field.from_features(positions[seen][:, None], directions[:, None], None, features[seen][:, None])
        rgb[seen] = output.rgb[:, 0]
        return FieldOutput(density=density, rgb=rgb)

    def _render(self, rays: RayBundle, background: Float[Tensor, "rays 3"] | None) -> Rendering:
        state, lattice, grid = self.sampler.start(rays, None), self.sampler.lattice_over(rays), self.sampler.grid
        rgb, depth = torch.zeros_like(rays.origins), torch.zeros_like(rays.near)
        light = torch.ones_like(rays.near)  # what no sample has absorbed yet
        alive = torch.arange(rays.near.shape[0], device=rays.near.device)
        while alive.numel():
            limit = min(MOST_ROUND_SAMPLES, ROUND_SAMPLES * rays.near.shape[0] // alive.numel())
            left = rays[alive]
            samples, following = march(left, state[alive], lattice, grid, limit)
            part: PackedRendering = composite_packed(self._look(left, samples), samples, left, None)
            before = light[alive]
            rgb[alive] += before[:, None] * part.foreground
            depth[alive] += before * (part.depth - (1.0 - part.opacity) * left.far)
            light[alive] = before * (1.0 - part.opacity)
            state.next[alive] = following
            going = (following < lattice.numel() - 2) & (light[alive] > self.sampler.opaque_below)
            alive = alive[going]
        return Rendering(
            rgb=rgb if background is None else rgb + light[:, None] * background,
            foreground=rgb,
            opacity=1.0 - light,
            depth=depth + light * rays.far,
        )

"""Even steps wherever a ray is inside the scene's box, and no grid."""

import torch

from nerf_lightning.nerf.geometry.boxes import distances_in_box
from nerf_lightning.nerf.samplers.base import RaggedSampler
from nerf_lightning.nerf.types.rays import RaggedSamples


class BoxSampler(RaggedSampler):
    def __init__(self, num_steps: int = 96):
        super().__init__()
        self.num_steps = num_steps
        self.register_buffer("aabb", torch.tensor([[-1.0] * 3, [1.0] * 3]))

    def fit_to(self, scene):
        self.aabb.copy_(scene.aabb)

    @property
    def samples_at_first(self) -> int:
        return self.num_steps

    def forward(self, rays, random):
        enter, leave = distances_in_box(rays, self.aabb)
        step = (self.aabb[1] - self.aabb[0]).norm() / self.num_steps
        count = ((leave - enter).clamp(min=0.0) / step).long()
        ray = torch.repeat_interleave(torch.arange(len(count)), count)
        bounds = torch.cat([count.new_zeros(1), count.cumsum(0)])
        number = torch.arange(len(ray)) - bounds[ray]
        jitter = torch.zeros_like(enter) if random is None else random.uniform("box", 1)[..., 0]
        starts = enter[ray] + (number + jitter[ray]) * step
        return RaggedSamples(ray, starts, starts + step, bounds, bounds[-1])

"""A baked field's bytes, fitted to the photographs that the model learned from.

What mixing between voxels, few spherical harmonics and fog that was left out have cost is learned back: PlenOctrees
(arXiv 2103.14024, Sec. 3.4) tune what they have baked in the same way.
"""

from dataclasses import replace

import numpy as np
import torch
from jaxtyping import Bool, UInt8
from numpy import ndarray

from nerf_lightning.compute.machine import require_memory
from nerf_lightning.data.ray_batches import PixelDomain, gather_batch
from nerf_lightning.export.baking.baked_field import LEAST_MET, BakedField, tiles_of
from nerf_lightning.export.baking.marcher import STEP, Marcher
from nerf_lightning.export.baking.seen_colors import in_coarse_steps
from nerf_lightning.export.density_grid import Report
from nerf_lightning.export.voxel_kernels.layout import VoxelBlocks, Wanted, kernels
from nerf_lightning.nerf.kernels.adam.step import adam_step
from nerf_lightning.nerf.models.ray_generator import RayGenerator
from nerf_lightning.nerf.randomness import RayRandom, fold
from nerf_lightning.nerf.rendering.blending import background_colors, blend
from nerf_lightning.nerf.types.scene import Scene, SceneRecord

RAYS = 8192  # Of one step.
RATE, LAST_RATE = 2.0, 0.3  # Bytes by which Adam moves a value in the first step, and in the last.
BETAS, EPS = (0.8, 0.95), 1e-6
GOLDEN = 0.6180339887  # Each step's pixels lie between those of the steps before it.
BYTES_PER_VALUE = 20  # The values, their moments, the gradient of either half of the rays; each of four bytes.


def fitted(baked: BakedField, scene: Scene, record: SceneRecord, steps: int, report: Report) -> BakedField:
    """Return the field whose pictures of the training views are nearer to the photographs.

    Each step marches some rays through the bytes as they are (`Marcher`: what is shown is what is fitted), and moves
    numbers, of which the bytes are the nearest, against the gradient (straight-through, arXiv 1308.3432). Which
    voxels have a color stays as it was, and so do the densities of all others. The photographs are in the frame of
    the model; to those that it was not trained on, by its record, nothing is fitted.
    """
    known = {record.view_names[view] for view in record.splits["train"]}
    views = [view for view in scene.splits["train"] if scene.view_names[view] in known]
    if not (steps and views):
        return baked
    channels, num_colored = baked.colors.shape
    require_memory(
        f"Fitting {num_colored:,} voxels of {channels + 1} bytes (what.fit_steps={steps})",
        num_colored,
        lambda count: BYTES_PER_VALUE * (channels + 1) * count,
        lambda count: f"what.fit_steps=0 skips it, and a smaller what.resolution, for {count:,} voxels,",
    )
    values, rays = _Values(baked), _TrainingRays(scene, views)
    for step in range(steps):
        values.look_at(rays.of_step(step, values.marcher))
        values.move(RATE * (LAST_RATE / RATE) ** (step / steps), step + 1)
        report("fitted", (step + 1) / steps)
    return values.as_baked()


class _Values:
    """Numbers of which a field's bytes are the nearest: a row for each colored value, its density and its colors."""

    def __init__(self, baked: BakedField):
        self.baked, self.marcher = baked, Marcher(baked)
        rows = np.full(baked.colored.shape, -1, np.int32)
        rows[baked.colored] = np.arange(baked.colors.shape[1])
        self.owner = tiles_of(rows, self.marcher.index, empty=-1)
        self.owned: Bool[ndarray, "blocks 9 9 9"] = self.owner >= 0
        self.row = self.owner[self.owned]
        together = np.concatenate([baked.density[baked.colored][None], baked.colors]).T
        self.values = torch.from_numpy(together.astype(np.float32, order="C"))
        self.first, self.second = torch.zeros_like(self.values), torch.zeros_like(self.values)
        self.gradient = torch.zeros(2, *self.values.shape)

    def look_at(self, wanted: Wanted) -> float:
        """Note which way to go, and return the sum of the squared errors of the rays."""
        baked, marcher = self.baked, self.marcher
        outside = baked.contraction is not None
        field = VoxelBlocks(marcher.index, marcher.density, marcher.colors, self.owner, baked.scale, STEP, outside)
        least_met = LEAST_MET if baked.closed else 0.0
        error: float = kernels("gradients").gradients(field, wanted, least_met, self.gradient.numpy())
        return error

    def move(self, rate: float, step: int) -> None:
        """Take Adam's step numbered so, and let the marcher see it."""
        one, other = self.gradient
        one += other
        other.zero_()
        b1, b2 = BETAS
        scales = (rate / (1.0 - b1**step), (1.0 - b2**step) ** -0.5)
        adam_step(self.values, one, self.first, self.second, *scales, BETAS, EPS)
        self.values.clamp_(0.0, 255.0)
        found = self._as_bytes()
        self.marcher.density[self.owned] = found[self.row, 0]
        self.marcher.colors[self.owned] = found[self.row, 1:]

    def as_baked(self) -> BakedField:
        """Return the field."""
        found, density = self._as_bytes(), self.baked.density.copy()
        density[self.baked.colored] = found[:, 0]
        return replace(self.baked, density=density, colors=np.ascontiguousarray(found[:, 1:].T))

    def _as_bytes(self) -> UInt8[ndarray, "rows channels_and_1"]:
        found = self.values.round()
        found[:, 4:] = in_coarse_steps(self.values[:, 4:])
        return found.to(torch.uint8).numpy()


class _TrainingRays:
    """A part of the rays through the training photographs for each step, spread evenly over all of them."""

    def __init__(self, scene: Scene, views: list[int]):
        self.scene, self.domain = scene, PixelDomain(scene, views)
        self.rays_of = RayGenerator(scene.cameras, scene.near, scene.far)

    def of_step(self, step: int, marcher: Marcher) -> Wanted:
        """Return them as the kernel takes them, and what they should meet."""
        total = len(self.domain)
        stride = max(1, total // RAYS)
        numbers = torch.arange(int(stride * (step * GOLDEN % 1.0)), total, stride)
        batch = gather_batch(self.scene, self.domain.locate(numbers))
        batch = batch[batch.weight > 0]
        count = batch.num_rays
        random = RayRandom(torch.full((count,), fold("fitting", step)), torch.arange(count))
        behind = background_colors(self.scene.background, count, torch.device("cpu"), random, batch.rgba)
        rgb = blend(batch.rgba, behind)
        origins, directions, looks, lengths, _ = marcher.in_grid(self.rays_of(batch.pixels))
        behind = torch.zeros(count, 3) if behind is None else behind
        return Wanted(origins, directions, looks, lengths, rgb.numpy(), behind.numpy())

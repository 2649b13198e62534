"""An occupancy grid: march through the cells that may hold something (Sec. 5.1 and Appendix E, arXiv 2201.05989).

Its numbers: `conf/sampler/occupancy.yaml` and its variants.
The march itself: `kernels/march/`.
"""

import logging
import math
from typing import Any

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from nerf_lightning.messages.errors import InputError
from nerf_lightning.nerf.geometry.boxes import distances_in_box
from nerf_lightning.nerf.kernels.march.grid import BLOCK, GridMarch, MarchState
from nerf_lightning.nerf.kernels.march.op import march
from nerf_lightning.nerf.kernels.march.reference import in_occupied
from nerf_lightning.nerf.randomness import RayRandom
from nerf_lightning.nerf.ranges import require_ranges
from nerf_lightning.nerf.samplers.base import OPAQUE_BELOW, DensityFn, RaggedSampler, RayMarcher
from nerf_lightning.nerf.samplers.occupancy_grid import OccupancyGrid
from nerf_lightning.nerf.samplers.space_carving import possible_cells
from nerf_lightning.nerf.types.rays import RaggedSamples, RayBundle
from nerf_lightning.nerf.types.scene import Scene

log = logging.getLogger(__name__)

CAPACITY = 1 << 20
# Devices on which the host may read a number between two kernels while rendering.
HOSTS = ("cpu", "cuda")
RANGES = {
    "num_steps": (1, 1 << 20),
    "update_every": (1, 1 << 30),
    "warmup_steps": (0, 1 << 40),
    "prune_after": (0, 1 << 40),
    "decay": (0.0, 1.0),
    "min_alpha": (0.0, 1.0),
    "opaque_below": (0.0, 1.0),
    "capacity": (1, 1 << 31),
}


class OccupancySampler(RaggedSampler):
    """Keep a decaying maximum of the density in each cell, and sample only where it is high enough.

    Every `update_every` steps the field is evaluated at random points, one per cell; a cell keeps the larger of its
    decayed value and the new one, and is occupied above the smaller of half the mean and the density that makes one
    interval `min_alpha` opaque. Cells that no training view sees, and those that a photograph's alpha shows to be
    empty, are empty from the start.

    Args:
        resolution: cells along a side of the box; a multiple of 4.
        num_steps: intervals across the diagonal of the scene's box.
        update_every: steps between two updates of the grid.
        warmup_steps: steps in which each update evaluates every cell; later, every other cell.
        prune_after: steps before any cell is pruned; larger if the background is baked into the images, so that dark
            content is not lost before it is learned.
        decay: decay rate of the running density, per update; the larger, the later empty cells are pruned.
        min_alpha: minimum opacity of an occupied interval.
        opaque_below: samples end where the transmittance falls below this; 0 keeps all.
        capacity: size of the arrays of visible samples on GPUs, where no size is read on the host; those of all samples
            in occupied cells, whose density alone is computed, are four times as large. What does not fit is dropped
            and counted. None: twice data.sample_budget, or 2^20 if that is None.
    """

    def __init__(
        self,
        resolution: int = 128,
        num_steps: int = 384,
        update_every: int = 16,
        warmup_steps: int = 256,
        prune_after: int = 0,
        decay: float = 0.8,
        min_alpha: float = 0.01,
        opaque_below: float = OPAQUE_BELOW,
        capacity: int | None = None,
    ):
        super().__init__()
        if resolution % BLOCK or resolution < BLOCK:
            raise ValueError(f"resolution={resolution}: give a multiple of {BLOCK}")
        require_ranges(locals(), RANGES)
        self.num_steps = num_steps
        self.update_every, self.warmup_steps, self.prune_after = update_every, warmup_steps, prune_after
        self.decay, self.min_alpha, self.opaque_below, self.capacity = decay, min_alpha, opaque_below, capacity
        self.grid = OccupancyGrid(resolution)
        # Computed on the host from the buffers when first needed: reading them stalls other devices.
        self._lattice: Tensor | None = None
        self._numbers: Tensor | None = None
        self._least_density = 0.0

    def fit_to(self, scene: Scene) -> None:
        """Set the scene's box, near and far, and mark the cells that must be empty.

        Raises:
            InputError: the scene has no box, no training ray meets it, or nothing is left in it.
        """
        if scene.space == "contracted":
            raise InputError(
                f"The photographs of {scene.name} show what lies far behind the content (space=contracted), and an "
                "occupancy grid needs a box around all that is seen. Use model=fast_proposal (or model=auto), or give "
                "scene.space=bounded if only the content matters."
            )
        self.grid.aabb.copy_(scene.aabb)
        self.grid.range.copy_(torch.stack([scene.near.min(), scene.far.max()]))
        self._lattice = self._numbers = None
        # In normalized device coordinates the cameras do not see cells where they are, but all of them are seen.
        if scene.space == "ndc":
            self.grid.possible.fill_(True)
        else:
            self.grid.possible.copy_(possible_cells(scene, *self.grid.cell_centers()).view_as(self.grid.possible))
        if not bool(self.grid.possible.any()):
            lower, upper = ([round(float(x), 3) for x in corner] for corner in scene.aabb)
            raise InputError(
                f"The box of the scene {scene.name}, from {lower} to {upper}, holds nothing that the training views "
                "show: no camera sees it, or all that they see there is transparent. Correct the box "
                "(scene.aabb_half), or the cameras' poses."
            )
        self.grid.reset_parameters()
        if scene.space == "bounded":
            self._question_cameras_inside(scene)

    def _question_cameras_inside(self, scene: Scene) -> None:
        eyes = scene.cameras.c2w[list(scene.splits["train"]), :, 3]
        inside = int(((eyes > scene.aabb[0]) & (eyes < scene.aabb[1])).all(dim=-1).sum())
        if inside:
            log.warning(
                "%d of %d training cameras are inside the box of the scene %s: what lies outside it is not learned. If "
                "the capture has no bounds, give scene.space=contracted if its reader supports it; otherwise make the "
                "box smaller (scene.aabb_half).",
                inside,
                eyes.shape[0],
                scene.name,
            )

    @property
    def samples_at_first(self) -> int:
        """The number of samples if every interval across the box held something."""
        return self.num_steps

    def forward(self, rays: RayBundle, random: RayRandom | None) -> RaggedSamples:
        """Return the occupied intervals of each ray; without `random`, on the deterministic lattice of evaluation."""
        rays = rays.map(torch.Tensor.detach)  # for learned cameras: which cells a ray meets has no gradient
        capacity = self.capacity_for(rays)
        if capacity is not None and self.opaque_below > 0:
            capacity = min(self.found_per_visible * capacity, self._most_intervals(rays))
        return march(rays, *self.grid_march(rays, random), capacity=capacity)[0]

    def grid_march(self, rays: RayBundle, random: RayRandom | None) -> GridMarch:
        """Return each ray's state, and the grid it goes through."""
        return GridMarch(self.start(rays, random), self.lattice, self.grid.occupied())

    def marcher(self, rays: RayBundle) -> RayMarcher:
        """Start rendering rays: each march continues where it stopped."""
        return GridMarcher(self, rays)

    def statistics(self) -> dict[str, float]:
        """Return the share of occupied cells."""
        return {"train/occupied": float(self.grid.cells.cpu().float().mean())}

    def capacity_for(self, rays: RayBundle) -> int | None:
        """Return the size of the arrays of visible samples; None if sizes may be read on the host."""
        if rays.near.device.type != "cuda":
            return None
        expected = CAPACITY if self.sample_budget is None else 2 * self.sample_budget
        return min(self.capacity or expected, self._most_intervals(rays))

    def _most_intervals(self, rays: RayBundle) -> int:
        return rays.near.shape[0] * (self.lattice.numel() - 2)

    def start(self, rays: RayBundle, random: RayRandom | None) -> MarchState:
        """Return the initial state of a march along rays."""
        enter, leave = distances_in_box(rays, self.grid.aabb)
        jitter = torch.zeros_like(rays.near) if random is None else random.uniform("occupancy", 1)[..., 0]
        return MarchState(enter, leave, jitter, torch.zeros_like(rays.near, dtype=torch.int64))

    def reached_density(self, density: DensityFn, positions: Float[Tensor, "points 3"]) -> Float[Tensor, "points"]:
        """Return the density in occupied cells; elsewhere 0, whatever the field says: rays skip the rest."""
        kept = in_occupied(positions, self.grid.occupied()).nonzero()[:, 0]
        reached = torch.zeros_like(positions[:, 0])
        if kept.numel():
            reached[kept] = density(positions[kept]).float()
        return reached

    @property
    def step_size(self) -> float:
        """Length of an interval in scene units."""
        return float((self.grid.aabb[1] - self.grid.aabb[0]).norm()) / self.num_steps

    @property
    def lattice(self) -> Float[Tensor, "edges"]:
        """The distances at which intervals begin, from the scene's near to beyond its far."""
        if self._lattice is None:
            near, far = self.grid.range.tolist()
            edges, step = [near], self.step_size
            self._require_few((far - near) / step)
            while edges[-1] <= far:
                edges.append(edges[-1] + step)
            edges.append(2 * edges[-1] - edges[-2])
            self._lattice = torch.tensor(edges)
        self._lattice = self._lattice.to(self.grid.aabb.device)
        return self._lattice

    def lattice_over(self, rays: RayBundle) -> Float[Tensor, "edges"]:
        """Return the lattice for rendering from anywhere, near or far.

        It is `lattice` if that covers the rays, else shifted by whole intervals. On devices that compile for fixed
        shapes (XLA) it is always `lattice`.
        """
        if rays.near.device.type not in HOSTS or not rays.near.numel():
            return self.lattice
        near, far = self.grid.range.tolist()
        nearest, farthest = float(rays.near.min()), float(rays.far.max())
        if near <= nearest and farthest <= far:
            return self.lattice
        step = self.step_size
        self._require_few((farthest - nearest) / step)
        first = max(math.floor((nearest - near) / step), math.ceil(-near / step))
        number = torch.arange(first, math.ceil((farthest - near) / step) + 3, dtype=torch.float64)
        return (near + step * number).float().to(rays.near.device)

    def _require_few(self, intervals: float) -> None:
        """Refuse an endless march: near, far and the box may come from a file."""
        if not intervals <= self.max_intervals:
            raise InputError(
                f"A ray from near to far would be cut into {intervals:.3g} intervals of {self.step_size:.3g} scene "
                f"units, and more than {self.max_intervals:,} are not allowed. Give a smaller sampler.num_steps, or a "
                "larger box; or add budgets.intervals=N."
            )

    @torch.no_grad()
    def learn(self, density: DensityFn, step: int, key: int) -> None:
        """Update the cells from the field when it is time, without reading anything on the host.

        Args:
            density: the field's density.
            step: steps taken in this attempt.
            key: key of this step's random numbers.
        """
        if step % self.update_every or step == 0:
            return
        grid = self.grid
        if self._numbers is None:
            self._numbers = grid.possible.flatten().cpu().nonzero()[:, 0]
            self._least_density = self.min_alpha / self.step_size
        number = self._numbers = self._numbers.to(grid.possible.device)
        if step > self.warmup_steps:
            number = number[(step // self.update_every) % 2 :: 2]
        grid.update(density, number, key, self.decay)
        if step >= self.prune_after:
            grid.prune(self._least_density)

    def _load_from_state_dict(self, *args: Any, **kwargs: Any) -> None:
        super()._load_from_state_dict(*args, **kwargs)
        self._lattice = self._numbers = None


class GridMarcher(RayMarcher):
    """Marches of rays through a grid, each with its position."""

    def __init__(self, sampler: OccupancySampler, rays: RayBundle):
        self.rays, self.state = rays, sampler.start(rays, None)
        self.lattice, self.cells = sampler.lattice_over(rays), sampler.grid.occupied()

    def advance(self, alive: Int[Tensor, "alive"], limit: int) -> tuple[RaggedSamples, Bool[Tensor, "alive"]]:
        """Continue each ray's march from its position."""
        samples, following = march(self.rays[alive], self.state[alive], self.lattice, self.cells, limit)
        self.state.next[alive] = following
        return samples, following < self.lattice.numel() - 2

    def grid_march(self) -> GridMarch:
        """Return each ray's state, and the grid it goes through."""
        return GridMarch(self.state, self.lattice, self.cells)

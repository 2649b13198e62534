"""Gradients of a share of a step's batch, tile by tile, with smaller tiles if memory runs out.

The data of a tile of rays stays in the cache, and the sum of the tiles' gradients is the whole batch's up to rounding.
Tiles go through the model in parallel on a CPU's cores, elsewhere in turn. Most operations of a step are too small to
be parallelized one by one: two threads that take a tile each, forward and backward, are almost twice as fast as one,
but two threads in every operation gained a fifth.
"""

import logging
from collections.abc import Callable, Sequence
from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn import Parameter

from nerf_lightning.compute import ranks
from nerf_lightning.messages.errors import InputError
from nerf_lightning.nerf.kernels.hash_grid.op import TableGradient, add_all, defer_table_grads
from nerf_lightning.nerf.kernels.render.workspace import forget_workspaces
from nerf_lightning.nerf.kernels.threads import in_parallel, threads_on, torch_on_one_thread
from nerf_lightning.nerf.models.tiles import is_out_of_memory, pixels_in_tile, tiles
from nerf_lightning.nerf.objective import Objective, StepOutput
from nerf_lightning.nerf.part import coupled_parts, sample_counts
from nerf_lightning.nerf.randomness import batch_random
from nerf_lightning.nerf.types.rays import Batch

# Points per tile when rendering pictures between steps that are not cut into tiles.
WHOLE_BATCH_POINTS = 65_536

log = logging.getLogger(__name__)

Backward = Callable[[Tensor], None]
"""Adds a loss's gradients to the parameters'."""


@dataclass(frozen=True)
class Share:
    """A process's part of a step's batch."""

    first: int
    """Slot of its first ray in the batch."""
    num_rays: int
    """Rays of the whole batch."""


def torch_backward(loss: Tensor) -> None:
    """Add a loss's gradients to the parameters'."""
    loss.backward()


class TileGradients:
    """Send batches forward and backward in tiles.

    Args:
        objective: the loss.
        points: maximum number of points that a tile may send through a field at once; None: the whole batch is one
            tile, as required if a part depends on all rays of a step (`Part.couples_rays`).
        jitter: False: no random numbers.
    """

    replays = False  # see `RecordedGradients`

    def __init__(self, objective: Objective, points: int | None, jitter: bool = True):
        self.objective, self.jitter = objective, jitter
        self.takes_whole_batches = bool(coupled_parts(objective))
        self.points = None if self.takes_whole_batches else points

    def __call__(
        self, batch: Batch, key: int, share: Share | None = None, backward: Backward = torch_backward
    ) -> StepOutput:
        """Add a batch's gradients to the parameters'.

        Args:
            batch: pixels, colors and weights.
            key: key of the step's random numbers.
            share: this part of the step's batch; None: all of it.
            backward: adds a loss's gradients to the parameters'.

        Returns:
            The output of this share; losses and errors of all shares add up to the batch's.

        Raises:
            InputError: memory does not suffice for the smallest tiles.
        """
        # Of a whole batch, no other process has a share: one alone measures tiles.
        weight = batch.weight.sum() if share is None else ranks.total(batch.weight.sum())
        with self.on_threads(batch.weight.device):
            while True:
                counts = [count.clone() for count in sample_counts(self.objective)]
                try:
                    return self.in_tiles_of(self._pixels_in_tile(batch), batch, weight, key, share, backward)
                except RuntimeError as error:
                    if not is_out_of_memory(error):
                        raise
                    forget_workspaces()
                    self._take_smaller_tiles(batch, error)
                self.objective.zero_grad(set_to_none=False)
                for count, before in zip(sample_counts(self.objective), counts, strict=True):
                    count.copy_(before)

    def in_tiles_of(
        self,
        num_pixels: int,
        batch: Batch,
        weight: Float[Tensor, ""],
        key: int | Tensor,
        share: Share | None = None,
        backward: Backward = torch_backward,
    ) -> StepOutput:
        """Add a batch's gradients, in tiles of `num_pixels` pixels, without handling memory errors.

        `weight` is the sum of the weights of all shares of the step's batch.
        """
        share = Share(0, batch.num_rays) if share is None else share
        objective, device = self.objective, batch.weight.device
        random = batch_random(key, batch.num_rays, device, share.first) if self.jitter else None
        # A mean of 1 over the batch, not over each tile. Without masks this is 1 exactly and changes no bit.
        weight_scale = share.num_rays / weight.clamp(min=1.0)

        def lose(tile: slice) -> StepOutput:
            # Learned cameras are evaluated in each tile, since its backward pass ends in them.
            seen = objective(batch[tile], None if random is None else random[tile], weight_scale)
            return seen.scaled((tile.stop - tile.start) / share.num_rays)

        together, threads = objective.pixels_per_patch, 1 if self.points is None else threads_on(device)
        learns_cameras = objective.rays.learns_cameras
        if threads > 1 and not objective.model.takes_whole_rays(device, training=True, learns_cameras=learns_cameras):
            parts = list(tiles(batch.num_rays, num_pixels, together, multiple=threads))
            seen = parallel_backward(lose, parts, backward, list(objective.parameters()))
        else:
            seen = sequential_backward(lose, list(tiles(batch.num_rays, threads * num_pixels, together)), backward)
        for penalty in objective.penalties():
            backward(penalty * (batch.num_rays / share.num_rays))  # all shares add up to one penalty
        return StepOutput.joined(seen)

    @property
    def picture_points(self) -> int:
        """Maximum number of points that a picture's tile, rendered between steps, may send through a field at once."""
        return self.points or WHOLE_BATCH_POINTS

    def on_threads(self, device: torch.device) -> AbstractContextManager[None]:
        """Return a context for steps: torch's threads process whole batches, our own process tiles."""
        return torch_on_one_thread() if self.points is not None and device.type == "cpu" else nullcontext()

    def _pixels_in_tile(self, batch: Batch) -> int:
        if self.points is None:
            return batch.num_rays
        return pixels_in_tile(self.objective.model, self.points, training=True)

    def _take_smaller_tiles(self, batch: Batch, error: RuntimeError) -> None:
        if self.points is None or self._pixels_in_tile(batch) <= self.objective.pixels_per_patch:
            cures = ["fewer rays (data.batch_rays)", "a smaller model", "tiles (trainer.tile_points=auto)"]
            possible = cures[:2] if self.takes_whole_batches else cures
            raise InputError(
                f"There is no memory for a training step: {error}. Use {', '.join(possible[:-1])} or {possible[-1]}."
            ) from error
        points = batch.num_rays * self.objective.model.points_per_ray(training=True)
        self.points = int(min(self.points, points)) // 2
        log.warning("out of memory: reducing tiles to %d points and repeating the step", self.points)


def sequential_backward(
    lose: Callable[[slice], StepOutput], tiles: Sequence[slice], backward: Backward
) -> list[StepOutput]:
    """Send one tile after another forward and backward, and return their outputs in order."""
    losses = []
    for tile in tiles:
        lost = lose(tile)
        backward(lost.losses.sum())
        losses.append(lost.map(Tensor.detach))
    return losses


def parallel_backward(
    lose: Callable[[slice], StepOutput], tiles: Sequence[slice], backward: Backward, parameters: Sequence[Parameter]
) -> list[StepOutput]:
    """Do the same on as many threads as torch has; sums are in the order of the tiles, so their bits are fixed.

    `backward` is called once, with the loss of all tiles, and passes on the gradients that the threads have computed.
    """
    learnt = [parameter for parameter in parameters if parameter.requires_grad]

    def work(tile: slice) -> tuple[StepOutput, Sequence[Tensor | None], Sequence[TableGradient]]:
        with defer_table_grads() as held:
            lost = lose(tile)
            gradients = torch.autograd.grad(lost.losses.sum(), learnt, allow_unused=True)
        return lost.map(Tensor.detach), gradients, held

    found = in_parallel(work, tiles)
    losses = [lost for lost, _, _ in found]
    total = torch.stack([lost.losses for lost in losses]).sum()
    held = [each for _, _, of_tile in found for each in of_tile]
    sums = [_sum([gradients[number] for _, gradients, _ in found]) for number in range(len(learnt))]
    backward(_PrecomputedGradients.apply(total, sums, held, *learnt))
    return losses


def _sum(gradients: Sequence[Tensor | None]) -> Tensor | None:
    found = [gradient for gradient in gradients if gradient is not None]
    return torch.stack(found).sum(dim=0) if found else None


class _PrecomputedGradients(torch.autograd.Function):
    """A loss whose gradients are known already."""

    @staticmethod
    def forward(ctx: Any, total: Tensor, sums: list[Tensor | None], held: list[TableGradient], *_: Tensor) -> Tensor:
        ctx.sums, ctx.held = sums, held
        return total.clone()

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx: Any, scale: Tensor) -> tuple[Tensor | None, ...]:
        add_all(ctx.held, float(scale))
        return None, None, None, *(None if found is None else found * scale for found in ctx.sums)

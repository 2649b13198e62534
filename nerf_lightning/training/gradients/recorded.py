"""A batch's forward and backward pass, recorded once as a CUDA graph and replayed for each batch of its size.

A step of a small model launches hundreds of kernels that each take a few microseconds, and Python takes longer to
launch them than the GPU to compute. A replayed graph is launched once
(https://pytorch.org/blog/accelerating-pytorch-with-cuda-graphs/).

A recording contains what the kernels did, not why: a number that Python computed (the key of random numbers, the weight
of a batch) would stay constant. So everything that changes between steps is passed in tensors at fixed addresses, and
each decision of a model on the host has its own recordings (`Part.step_variant`).
"""

import logging
from collections.abc import Callable, Hashable
from dataclasses import dataclass, replace
from typing import Any

import torch
from torch import Tensor

from nerf_lightning.compute import ranks
from nerf_lightning.messages.errors import InputError
from nerf_lightning.nerf.models.tiles import is_out_of_memory
from nerf_lightning.nerf.objective import Objective, StepOutput
from nerf_lightning.nerf.part import parts_of, sample_counts
from nerf_lightning.nerf.types.rays import Batch
from nerf_lightning.training.gradients.tiles import Backward, Share, TileGradients, torch_backward
from nerf_lightning.training.step_guard import StepGuard

KNOWN = (__name__.partition(".")[0], "torch")
"""Packages for whose modules it is known whether recorded steps can be replayed."""
# The first round compiles kernels and allocates what stays; CUDA's guide recommends a few.
WARM_UPS = 3

log = logging.getLogger(__name__)

Recorder = Callable[[Callable[[], StepOutput]], tuple[Callable[[], None], StepOutput]]
"""Takes work; returns a function that repeats it on the same memory, and its result, which each repetition
overwrites."""


class CudaGraphs:
    """Record work as CUDA graphs, each after a few rounds on a separate stream.

    All share the memory of intermediate results, since no two run at a time and none reads what another has left: many
    batch sizes take as much memory as the largest.
    """

    def __init__(self) -> None:
        self.pool: Any = None

    def __call__(self, work: Callable[[], StepOutput]) -> tuple[Callable[[], None], StepOutput]:
        """Return a function that repeats the work, and its result."""
        if self.pool is None:
            self.pool = torch.cuda.graph_pool_handle()
        graph, side = torch.cuda.CUDAGraph(), torch.cuda.Stream()
        side.wait_stream(torch.cuda.current_stream())
        with torch.cuda.stream(side):
            for _ in range(WARM_UPS):
                work()
        torch.cuda.current_stream().wait_stream(side)
        # The thread that makes batches pins memory, which a capture would otherwise forbid in every thread.
        with torch.cuda.graph(graph, pool=self.pool, capture_error_mode="thread_local"):
            seen = work()
        return graph.replay, seen


@dataclass(frozen=True)
class _Recording:
    """A recording for one batch size."""

    batch: Batch
    weight: Tensor
    key: Tensor
    replay: Callable[[], None]
    output: StepOutput
    gradients: list[Tensor | None]


class RecordedGradients:
    """Compute the gradients of whole batches by replaying the first one of the same size, share and step variants.

    Args:
        tiles: computes the gradients.
        guard: sets a step's nonfinite gradients to zero, if one process has all of them.
        record: makes a recording; None: CUDA graphs.

    Raises:
        InputError: a part decides on the host what a step computes.
    """

    guards: bool
    """Whether nonfinite gradients have already been set to zero."""
    replays = True
    """Whether batches are replayed, until a recording is refused."""

    def __init__(self, tiles: TileGradients, guard: StepGuard, record: Recorder | None = None):
        if kinds := not_replayed(tiles.objective):
            raise InputError(
                "trainer.cuda_graph=true replays the same kernels in each step, and these may want others in another "
                f"step: {', '.join(kinds)}. Leave it out."
            )
        self.tiles, self.guard, self.record = tiles, guard, CudaGraphs() if record is None else record
        self.parts, self.parameters = list(parts_of(tiles.objective)), list(tiles.objective.parameters())
        self.guards = ranks.world_size() == 1  # else the gradients of all processes are summed first
        self.recordings: dict[tuple[int, Hashable], _Recording] = {}

    def __call__(
        self, batch: Batch, key: int, share: Share | None = None, backward: Backward = torch_backward
    ) -> StepOutput:
        """Return a batch's output; its gradients replace the previous ones in the parameters.

        The next call overwrites both. If batches cannot be recorded, this does the same as `TileGradients`, which has
        the same arguments.
        """
        if self.replays:
            try:
                return self._replayed(batch, key, Share.whole(batch) if share is None else share)
            except RuntimeError as error:
                if not is_out_of_memory(error) and "captur" not in str(error):
                    raise
                cause = "there is no memory" if is_out_of_memory(error) else f"CUDA refuses: {error}".splitlines()[0]
            log.warning("Steps are not recorded: %s. The kernels of each step are launched one by one.", cause)
            self.guards = self.replays = False
            self.recordings.clear()
            self.tiles.objective.zero_grad(set_to_none=False)
        return self.tiles(batch, key, share, backward)

    def _replayed(self, batch: Batch, key: int, share: Share) -> StepOutput:
        kind = batch.num_rays, (share.first, share.num_rays, *(part.step_variant for part in self.parts))
        if kind not in self.recordings:
            self.recordings[kind] = self._recorded(batch, key, share)
        kept = self.recordings[kind]
        _copy([*kept.batch.tensors(), kept.weight], [*batch.tensors(), share.weight])
        kept.key.fill_(key)
        kept.replay()
        for parameter, gradient in zip(self.parameters, kept.gradients, strict=True):
            parameter.grad = gradient
        return kept.output

    def _recorded(self, batch: Batch, key: int, share: Share) -> _Recording:
        batch, weight = batch.map(Tensor.clone), share.weight.clone()
        kept_key, share = torch.full((), key, device=weight.device), replace(share, weight=weight)
        for parameter in self.parameters:
            if parameter.grad is None:
                parameter.grad = torch.zeros_like(parameter)
        counts = [*sample_counts(self.tiles.objective), *self.guard.tensors(weight.device)]
        before = [count.clone() for count in counts]

        def work() -> StepOutput:
            for parameter in self.parameters:
                # Others are zero already: the optimizer leaves them so (`optimizers.table_adam`).
                if parameter.grad is not None and not getattr(parameter, "grad_in_place", False):
                    parameter.grad.zero_()
            seen = self.tiles.in_tiles_of(batch.num_rays, batch, share, kept_key)
            if self.guards:
                self.guard.keep_finite(seen.losses, self.tiles.objective.named_weights())
            return seen

        try:
            replay, seen = self.record(work)
        finally:
            for count, former in zip(counts, before, strict=True):
                count.copy_(former)
        for parameter in self.parameters:
            if parameter.grad is not None:
                parameter.grad.zero_()
        return _Recording(batch, weight, kept_key, replay, seen, [parameter.grad for parameter in self.parameters])


def _copy(targets: list[Tensor], sources: list[Tensor]) -> None:
    """Copy tensors, those of one dtype in one kernel."""
    for dtype in {each.dtype for each in targets}:
        ours, theirs = ([each for each in tensors if each.dtype == dtype] for tensors in (targets, sources))
        torch._foreach_copy_(ours, theirs)


def not_replayed(objective: Objective, only_known: bool = False) -> list[str]:
    """Return the classes of the parts whose steps cannot be replayed, each once.

    Args:
        objective: the objective to record.
        only_known: also return other packages' classes that do not set `Part.replays` themselves.
    """
    found = {}
    for module in objective.modules():
        kind = type(module)
        unknown = kind.__module__.partition(".")[0] not in KNOWN and "replays" not in vars(kind)
        if not getattr(module, "replays", True) or (only_known and unknown):
            found[kind.__name__] = True
    return list(found)

"""A batch's forward and backward pass and the update, recorded once as a CUDA graph and replayed for each batch.

A step of a small model launches hundreds of kernels that each take a few microseconds, and Python takes longer to
launch them than the GPU to compute. A replayed graph is launched once
(https://pytorch.org/blog/accelerating-pytorch-with-cuda-graphs/).

A recording contains what the kernels did, not why: a number that Python computed (the key of random numbers, the weight
of a batch) would stay constant. So everything that changes between steps is passed in tensors at fixed addresses, and
each decision of a model on the host has its own recordings (`Part.step_variant`).
"""

import logging
from collections.abc import Callable, Hashable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from torch import Tensor

from nerf_lightning.compute import ranks
from nerf_lightning.messages.errors import InputError
from nerf_lightning.nerf.models.tiles import is_out_of_memory
from nerf_lightning.nerf.objective import Objective, StepOutput
from nerf_lightning.nerf.part import parts_of, sample_counts
from nerf_lightning.nerf.types.rays import Batch, LazyBatch
from nerf_lightning.nerf.types.tensor_struct import overwrite
from nerf_lightning.training.gradients.tiles import Backward, Share, TileGradients, torch_backward

KNOWN = (__name__.partition(".")[0], "torch")
"""Packages for whose modules it is known whether recorded steps can be replayed."""
# The first round compiles kernels and allocates what stays; CUDA's guide recommends a few.
WARM_UPS = 3

log = logging.getLogger(__name__)

Recorder = Callable[[Callable[[], Any]], tuple[Callable[[], None], Any]]
"""Takes work; returns a function that repeats it on the same memory, and its result, which each repetition
overwrites."""


class CudaGraphs:
    """Record work as CUDA graphs, each after a few rounds on a separate stream.

    All share the memory of intermediate results, since no two run at a time and none reads what another has left
    before the same step: many batch sizes take as much memory as the largest.
    """

    def __init__(self) -> None:
        self.pool: Any = None

    def __call__(self, work: Callable[[], Any]) -> tuple[Callable[[], None], Any]:
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
class Rest:
    """The rest of a step, after its gradients."""

    add_up: Callable[[StepOutput], None]
    """Sums outputs and gradients over the processes."""
    finish: Callable[[StepOutput], StepOutput]
    """Recorded, too: uses the gradients."""
    changes: Sequence[Tensor]
    """What `finish` changes besides the gradients."""
    kind: Hashable
    """Differs where `finish` does something else."""


@dataclass(frozen=True)
class _Recording:
    """A recording for one batch size."""

    batch: Batch | LazyBatch
    """Where later batches are copied; a lazy one is gathered by its numbers."""
    numbers: Tensor
    """The key of the step's random numbers, and those of a lazy batch."""
    weigh: Callable[[], None] | None
    """Gathers a process's share of the batch and computes `weight`; None: one process, and `replay` does this."""
    weight: Tensor | None
    """Sum of the weights of the batch."""
    replay: Callable[[], None]
    output: StepOutput
    finish: Callable[[], None] | None
    """Replays the rest of the step, if `replay` does not."""
    gradients: list[Tensor | None]


class RecordedGradients:
    """Compute the gradients of whole batches by replaying the first one of the same size, share and step variants.

    Args:
        tiles: computes the gradients.
        record: makes a recording; None: CUDA graphs.

    Raises:
        InputError: a part decides on the host what a step computes.
    """

    replays = True
    """Whether batches are replayed, until a recording is refused."""

    def __init__(self, tiles: TileGradients, record: Recorder | None = None):
        if kinds := not_replayed(tiles.objective):
            raise InputError(
                "trainer.cuda_graph=true replays the same kernels in each step, and these may want others in another "
                f"step: {', '.join(kinds)}. Leave it out."
            )
        self.tiles, self.record = tiles, CudaGraphs() if record is None else record
        self.parts, self.parameters = list(parts_of(tiles.objective)), list(tiles.objective.parameters())
        self.recordings: dict[tuple[int, Hashable], _Recording] = {}

    def __call__(
        self,
        batch: Batch | LazyBatch,
        key: int,
        share: Share | None = None,
        backward: Backward = torch_backward,
        rest: Rest | None = None,
    ) -> StepOutput:
        """Return a batch's output; its gradients replace the previous ones in the parameters.

        The next call overwrites both. If batches cannot be recorded, this does the same as `TileGradients`, which has
        the same arguments, and the rest of the step, if there is one.
        """
        if self.replays:
            try:
                return self._replayed(batch, key, share, rest)
            except RuntimeError as error:
                if not is_out_of_memory(error) and "captur" not in str(error):
                    raise
                cause = "there is no memory" if is_out_of_memory(error) else f"CUDA refuses: {error}".splitlines()[0]
            log.warning("Steps are not recorded: %s. The kernels of each step are launched one by one.", cause)
            self.replays = False
            self.recordings.clear()
            self.tiles.objective.zero_grad(set_to_none=False)
        seen = self.tiles(batch.now(), key, share, backward)
        if rest is None:
            return seen
        rest.add_up(seen)
        return rest.finish(seen)

    def _replayed(self, batch: Batch | LazyBatch, key: int, share: Share | None, rest: Rest | None) -> StepOutput:
        of_share = None if share is None else (share.first, share.num_rays)
        of_batch, numbers = (batch.kind, batch.numbers) if isinstance(batch, LazyBatch) else (None, ())
        of_rest = None if rest is None else rest.kind
        kind = batch.num_rays, (of_batch, of_share, of_rest, *(part.step_variant for part in self.parts))
        if kind not in self.recordings:
            self.recordings[kind] = self._recorded(batch, (key, *numbers), share, rest)
        kept = self.recordings[kind]
        overwrite(kept.numbers, np.array((key, *numbers)))
        if isinstance(batch, Batch) and isinstance(kept.batch, Batch):
            _copy(kept.batch.tensors(), batch.tensors())
        if kept.weigh is not None and kept.weight is not None:
            kept.weigh()
            ranks.add_up([kept.weight])
        kept.replay()
        if kept.finish is not None and rest is not None:
            rest.add_up(kept.output)
            kept.finish()
        for parameter, gradient in zip(self.parameters, kept.gradients, strict=True):
            parameter.grad = gradient
        return kept.output

    def _recorded(
        self, batch: Batch | LazyBatch, numbers: tuple[int, ...], share: Share | None, rest: Rest | None
    ) -> _Recording:
        of_step = torch.tensor(numbers, device=batch.device)
        kept = batch.map(_copied) if isinstance(batch, Batch) else batch

        def weighed() -> tuple[Batch, Tensor]:
            pixels = kept.gather(of_step[1:]) if isinstance(kept, LazyBatch) else kept
            return pixels, pixels.weight.sum()

        # Sums over processes are not recorded: what is before, between and after them is replayed in turn.
        weigh, of_share = (None, None) if share is None else self.record(weighed)
        for parameter in self.parameters:
            if parameter.grad is None:
                parameter.grad = torch.zeros_like(parameter)
        changed = [*sample_counts(self.tiles.objective), *([] if rest is None else rest.changes)]
        before = [each.clone() for each in changed]

        def work() -> StepOutput:
            self._zero_gradients()
            pixels, weight = weighed() if of_share is None else of_share
            seen = self.tiles.in_tiles_of(pixels.num_rays, pixels, weight, of_step[0], share)
            return rest.finish(seen) if rest is not None and share is None else seen

        finish = None
        try:
            replay, seen = self.record(work)
            if rest is not None and share is not None:
                of_gradients, whole_step = seen, rest
                finish, seen = self.record(lambda: whole_step.finish(of_gradients))
        finally:
            for each, former in zip(changed, before, strict=True):
                each.copy_(former)
        self._zero_gradients(all_of_them=True)
        weight = None if of_share is None else of_share[1]
        gradients = [each.grad for each in self.parameters]
        return _Recording(kept, of_step, weigh, weight, replay, seen, finish, gradients)

    def _zero_gradients(self, all_of_them: bool = False) -> None:
        for parameter in self.parameters:
            # Others are zero already: the optimizer leaves them so (`optimizers.table_adam`).
            if parameter.grad is not None and (all_of_them or not getattr(parameter, "grad_in_place", False)):
                parameter.grad.zero_()


def _copied(tensor: Tensor) -> Tensor:
    return tensor.clone(memory_format=torch.contiguous_format)


def _copy(targets: Sequence[Tensor], sources: Sequence[Tensor]) -> None:
    """Copy tensors, whatever their types, in one kernel; the targets are contiguous."""
    ours, theirs = (
        [each.view(torch.int32) for each in targets],
        [each.contiguous().view(torch.int32) for each in sources],
    )
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

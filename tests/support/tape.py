"""A stand-in for CUDA graphs on the CPU: operations are written down, and done again on the same memory.

As in a graph, a number that Python computed stays as it was, and what asks the host for a number, or for a size that
depends on the data, is refused.
"""

from collections.abc import Iterator
from contextlib import contextmanager
from functools import partial

import pytest
import torch
from torch import Tensor
from torch.utils._python_dispatch import TorchDispatchMode
from torch.utils._pytree import tree_leaves

from nerf_lightning.nerf.kernels.backends import CPU_BACKENDS, without
from nerf_lightning.nerf.kernels.threads import torch_on_one_thread
from nerf_lightning.training import step
from nerf_lightning.training.gradients.recorded import RecordedGradients
from nerf_lightning.training.launch.trainer import TrainerSettings
from nerf_lightning.training.step import TrainStep

ASK_THE_HOST = ("aten::_local_scalar_dense", "aten::nonzero", "aten::masked_select", "aten::unique", "aten::equal")


class Tape(TorchDispatchMode):
    """Write down what torch does within."""

    def __init__(self):
        super().__init__()
        self.operations = []

    def __torch_dispatch__(self, func, types, args=(), kwargs=None):
        kwargs = kwargs or {}
        assert not func.name().startswith(ASK_THE_HOST) or "nonzero_static" in func.name(), f"{func} asks the host"
        outputs = func(*args, **kwargs)
        self.operations.append((func, args, kwargs, outputs))
        return outputs

    def replay(self):
        """Do it again; what comes out is written over what came out then."""
        with torch._C._AutoDispatchBelowAutograd():
            for func, args, kwargs, outputs in self.operations:
                again = func(*args, **kwargs)
                for old, new in zip(tree_leaves(outputs), tree_leaves(again), strict=True):
                    if isinstance(old, Tensor) and old.data_ptr() != new.data_ptr():
                        old.copy_(new)


def tape(work):
    """Record work as `CudaGraphs` does: after a round that allocates what stays."""
    work()
    with Tape() as recorded:
        seen = work()
    return recorded.replay, seen


def replay_steps(train_step: TrainStep, record=tape) -> None:
    """Record steps from now on, and replay them."""
    train_step.gradients = RecordedGradients(train_step.tiles, record)


@contextmanager
def steps_on_tape() -> Iterator[list[int]]:
    """Let every command record its steps, with torch in place of the kernels; return a number for each replay."""
    replays: list[int] = []

    def noted(work):
        replay, seen = tape(work)
        return lambda: (replays.append(len(replays)), replay()), seen

    with without(*CPU_BACKENDS), torch_on_one_thread(shares_out=False), pytest.MonkeyPatch.context() as patch:
        patch.setattr(TrainerSettings, "records", lambda settings, train_step: True)
        patch.setattr(step, "RecordedGradients", partial(RecordedGradients, record=noted))
        yield replays

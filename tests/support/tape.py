"""A stand-in for CUDA graphs on the CPU: operations are written down, and done again on the same memory.

As in a graph, a number that Python computed stays as it was, and what asks the host for a number, or for a size that
depends on the data, is refused.
"""

import torch
from torch import Tensor
from torch.utils._python_dispatch import TorchDispatchMode
from torch.utils._pytree import tree_leaves

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
    """Record work as `cuda_graph` does: after a round that allocates what stays."""
    work()
    with Tape() as recorded:
        seen = work()
    return recorded.replay, seen

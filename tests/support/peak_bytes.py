"""The most bytes that a computation holds at once, counted tensor by tensor."""

import weakref
from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor
from torch.utils._python_dispatch import TorchDispatchMode


class PeakBytes(TorchDispatchMode):
    """Watch what is allocated under it on a kind of device, and freed again; what was there before does not count."""

    def __init__(self, device_type: str):
        super().__init__()
        self.device_type = device_type
        self.held, self.most = 0, 0
        self.watched: set[int] = set()

    def __torch_dispatch__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        """Run the operation, and look at what came out."""
        kwargs = kwargs or {}
        out = func(*args, **kwargs)
        for tensor in _tensors_in(out):
            self._watch(tensor, (args, kwargs))
        return out

    def _watch(self, tensor: Tensor, taken: Any) -> None:
        storage = tensor.untyped_storage()
        key = storage._cdata
        if key in self.watched or storage.device.type != self.device_type:
            return
        if any(key == each.untyped_storage()._cdata for each in _tensors_in(taken)):
            return  # a view of what was there before
        size = storage.nbytes()
        self.watched.add(key)
        self.held += size
        self.most = max(self.most, self.held)
        weakref.finalize(storage, self._forget, key, size)

    def _forget(self, key: int, size: int) -> None:
        self.watched.discard(key)
        self.held -= size


def peak_bytes(work: Callable[[], Any], device: torch.device) -> int:
    """Do the work and return the most bytes that it held on the device at once, beyond what was there before."""
    with PeakBytes(device.type) as counter:
        work()
    return counter.most


def _tensors_in(tree: Any) -> list[Tensor]:
    # What operations take and return is nested no deeper than lists; torch's own flattening takes longer.
    if isinstance(tree, Tensor):
        return [tree]
    if isinstance(tree, dict):
        tree = list(tree.values())
    return [tensor for part in tree for tensor in _tensors_in(part)] if isinstance(tree, (tuple, list)) else []

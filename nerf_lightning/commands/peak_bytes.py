"""Count how much memory some torch code holds at once, to the byte, on any device."""

import weakref
from collections.abc import Callable, Iterator
from typing import Any

import torch
from torch import Tensor
from torch.utils._python_dispatch import TorchDispatchMode


class PeakBytes(TorchDispatchMode):
    """Watch what is allocated under it and freed again; what was there before does not count.

    Args:
        device_type: where; what lies elsewhere does not count.
    """

    def __init__(self, device_type: str):
        super().__init__()
        self.device_type = device_type
        self.held, self.most = 0, 0
        self.watched: set[int] = set()

    def __torch_dispatch__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        """Run the operation, and look at what went in and what came out."""
        kwargs = kwargs or {}
        for tensor in _tensors_in((args, kwargs)):
            self._watch(tensor, is_new=False)
        out = func(*args, **kwargs)
        for tensor in _tensors_in(out):
            self._watch(tensor, is_new=True)
        return out

    def _watch(self, tensor: Tensor, is_new: bool) -> None:
        storage = tensor.untyped_storage()
        key = storage._cdata
        if key in self.watched or storage.device.type != self.device_type:
            return
        size = storage.nbytes() if is_new else 0
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


def _tensors_in(tree: Any) -> Iterator[Tensor]:
    # What operations take and return is nested no deeper than lists; torch's own flattening takes as long as they do.
    if isinstance(tree, Tensor):
        yield tree
    elif isinstance(tree, (tuple, list)):
        for part in tree:
            yield from _tensors_in(part)
    elif isinstance(tree, dict):
        yield from _tensors_in(list(tree.values()))

"""A device that is not there: tensors of the CPU that say they lie on `cuda` or `mps`, and refuse what those refuse.

Where a tensor lies is written on its storage, so that views, parameters and gradients follow by themselves. Two of
torch's modes watch. `_Calls` sees what Python asks for, before it reaches C++: which device, a tensor made there, a
move. `_Operations` sees every operation, those of the backward pass and those that C++ asks for included.

An error (`Refused`) names the line of the project that asked. Always refused are operands that lie apart, NumPy arrays
of what lies on the device, and float64 on `mps`. Within a step (`in_step`) also what makes the host wait: a number
read, a size that depends on numbers, a copy that does not go by way of pinned memory; and float64 on `cuda`, whose
GPUs compute it at a fraction of the speed.
"""

import sys
from collections import Counter
from collections.abc import Iterator, Sequence
from contextlib import ExitStack, contextmanager
from pathlib import Path
from types import FrameType
from typing import Any

import torch
from torch import Tensor
from torch.overrides import TorchFunctionMode
from torch.utils._python_dispatch import TorchDispatchMode
from torch.utils._pytree import tree_leaves

ROOT = Path(__file__).parents[2]
OURS = tuple(str(ROOT / folder) + "/" for folder in ("nerf_lightning", "tests"))
DOUBLE = (torch.float64, torch.complex128)

aten = torch.ops.aten
READS = {torch.Tag.data_dependent_output, torch.Tag.dynamic_output_shape}
INDEXING = (aten.index.Tensor, aten.index_put_.default, aten.index_put.default, aten._index_put_impl_.default)
# Others take a tensor without dimensions for a number, and numbers from the host.
TAKES_NO_NUMBERS = (aten.cat.default, aten.stack.default)
MADE_OF_NUMBERS = (torch.tensor, torch.as_tensor, torch.asarray, Tensor.new_tensor)


class Refused(AssertionError):
    """The device would not do this, or the host would wait for it."""


class StandInDevice:
    """Enter it, and the device is there.

    Args:
        kind: cuda or mps.
    """

    def __init__(self, kind: str):
        # A number that no real device has: the project keeps some tensors for each.
        self.device = torch.device(kind, 7)
        # How often each function waited that may.
        self.waited: Counter[str] = Counter()
        self._may_wait: Sequence[str] | None = None
        self._calls = _Calls(self)

    def __enter__(self) -> "StandInDevice":
        self._stack = ExitStack()
        self._stack.enter_context(_Operations(self))
        self._stack.enter_context(self._calls)
        self._stack.callback(setattr, torch.autograd, "_engine_run_backward", torch.autograd._engine_run_backward)
        torch.autograd._engine_run_backward = self._run_backward(torch.autograd._engine_run_backward)
        return self

    def __exit__(self, *raised: Any) -> None:
        self._stack.__exit__(*raised)

    def _run_backward(self, run: Any) -> Any:
        # torch leaves a mode while it handles a call, `backward` too, and what is Python in there is to be seen, too.
        def seen(roots: Sequence[Tensor], *args: Any, **kwargs: Any) -> Any:
            with self._calls, self._calls.call_on(any(map(lies_there, roots))):
                return run(roots, *args, **kwargs)

        return seen

    @contextmanager
    def in_step(self, *may_wait: str) -> Iterator[None]:
        """Refuse what no step may do, but count it within functions of these qualified names."""
        self._may_wait = may_wait
        try:
            yield
        finally:
            self._may_wait = None

    def refuse_in_step(self, what: str) -> None:
        """Refuse or count what a step may not do."""
        if self._may_wait is None:
            return
        names = [frame.f_code.co_qualname for frame in _frames()]
        found = next((name for name in names if name in self._may_wait), None)
        if found is None:
            self.refuse(what)
        self.waited[str(found)] += 1

    def refuse(self, what: str) -> None:
        """Raise, with the line that asked."""
        frame = next(_frames())
        raise Refused(f"{Path(frame.f_code.co_filename).relative_to(ROOT)}:{frame.f_lineno}: {what}")

    def lay(self, tensor: Tensor, there: bool) -> Tensor:
        """Write down where a tensor lies that was just made."""
        tensor.untyped_storage().lies_there = there  # type: ignore[attr-defined]
        if there and tensor.dtype in DOUBLE and not self._calls.in_quantile:
            (self.refuse if self.device.type == "mps" else self.refuse_in_step)(f"{tensor.dtype} on the device")
        return tensor

    def moved(self, tensor: Tensor, there: bool, non_blocking: bool = False) -> Tensor:
        """Return the tensor where it is wanted."""
        if lies_there(tensor) == there:
            return tensor
        if tensor.requires_grad and torch.is_grad_enabled():
            raise NotImplementedError("gradients that go from one device to the other")
        self.sent(tensor, there, non_blocking)
        return self.lay(tensor.detach().clone(), there)

    def sent(self, tensor: Tensor, there: bool, non_blocking: bool) -> None:
        """Numbers go from the host to the device, or back."""
        if not there:
            self.refuse_in_step("numbers are copied to the host")
        elif tensor.numel() and not (non_blocking and _is_pinned(tensor)):
            self.refuse_in_step("numbers are sent by way of pageable memory, or waited for")


class _Calls(TorchFunctionMode):
    def __init__(self, owner: StandInDevice):
        super().__init__()
        self.owner, kind = owner, owner.device.type
        # Whether what C++ makes for the call that is being handled lies on the device.
        self.on_device = False
        # From 2.15 on torch itself computes in float64 where a quantile lies, one number.
        self.in_quantile = False
        self.answers = {
            Tensor.device.__get__: lambda tensor: owner.device if lies_there(tensor) else torch.device("cpu"),
            Tensor.is_cuda.__get__: lambda tensor: lies_there(tensor) and kind == "cuda",
            Tensor.is_mps.__get__: lambda tensor: lies_there(tensor) and kind == "mps",
            Tensor.is_cpu.__get__: lambda tensor: not lies_there(tensor),
            Tensor.cpu: lambda tensor: owner.moved(tensor, there=False),
            Tensor.to: self.to,
            Tensor.pin_memory: _pinned,
            Tensor.is_pinned: _is_pinned,
        }

    @contextmanager
    def call_on(self, there: bool) -> Iterator[None]:
        former, self.on_device = self.on_device, there
        try:
            yield
        finally:
            self.on_device = former

    def __torch_function__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        owner, kwargs = self.owner, dict(kwargs or {})
        if func in self.answers:
            return self.answers[func](*args, **kwargs)
        there = any(isinstance(each, Tensor) and lies_there(each) for each in tree_leaves((args, kwargs)))
        if there and func in (Tensor.numpy, Tensor.__array__):
            owner.refuse("NumPy sees nothing that lies on a device")
        if there and func is Tensor.tolist:
            owner.refuse_in_step("the host reads numbers (tolist)")
        device = kwargs.pop("device", None)
        there = there if device is None else self.is_meant(device)
        if func in MADE_OF_NUMBERS:
            if isinstance(args[-1], Tensor):
                return self.to(args[-1], there if device is None else device, kwargs.get("dtype"))
            if there:
                owner.refuse_in_step("numbers are sent by way of pageable memory")
        self.in_quantile = func in (torch.quantile, torch.nanquantile)
        with self.call_on(there):
            made = func(*args, **kwargs)
        self.in_quantile = False
        return made if device is None and func not in MADE_OF_NUMBERS else owner.lay(made, there)

    def is_meant(self, device: Any) -> bool:
        return torch.device(device).type == self.owner.device.type

    def to(self, tensor: Tensor, *args: Any, **kwargs: Any) -> Tensor:
        there, non_blocking = lies_there(tensor), kwargs.pop("non_blocking", False)
        for each in (*args, kwargs.pop("device", None), kwargs.pop("other", None)):
            if isinstance(each, str | torch.device):
                there = self.is_meant(each)
            elif isinstance(each, Tensor):
                there, kwargs["dtype"] = lies_there(each), each.dtype
            elif isinstance(each, torch.dtype):
                kwargs["dtype"] = each
        with self.call_on(lies_there(tensor)):  # converted where it lies, and then sent
            converted = tensor.to(**kwargs) if kwargs else tensor
        return self.owner.moved(converted, there, non_blocking)


class _Operations(TorchDispatchMode):
    def __init__(self, owner: StandInDevice):
        super().__init__()
        self.owner = owner

    def __torch_dispatch__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        owner, kwargs = self.owner, kwargs or {}
        operands = [each for each in tree_leaves((args, kwargs)) if isinstance(each, Tensor)]
        there = any(map(lies_there, operands))
        if func is aten.copy_.default and len({lies_there(each) for each in operands}) == 2:
            owner.sent(args[1], lies_there(args[0]), bool(args[2:] and args[2]))
            return func(*args, **kwargs)
        if there:
            self.require_together(func, args, operands)
            if _reads(func, args, kwargs):
                owner.refuse_in_step(f"the host reads numbers, or a size that depends on them ({func.name()})")
        made = func(*args, **kwargs)
        if there if operands else owner._calls.on_device:
            for each in tree_leaves(made):
                if isinstance(each, Tensor):
                    owner.lay(each, True)
        return made

    def require_together(self, func: Any, args: Any, operands: Sequence[Tensor]) -> None:
        apart = [each for each in operands if not lies_there(each) and (each.dim() or func in TAKES_NO_NUMBERS)]
        if func in INDEXING and lies_there(args[0]) and apart:
            self.owner.refuse_in_step("an index is sent by way of pageable memory")
            apart = [each for each in apart if not any(each is index for index in args[1])]
        if apart:
            where = f"of {[tuple(each.shape) for each in apart]} on the host, others on {self.owner.device.type}"
            self.owner.refuse(f"operands lie apart ({func.name()}): {where}")


def lies_there(tensor: Tensor) -> bool:
    """Return whether a tensor lies on the device."""
    return getattr(tensor.untyped_storage(), "lies_there", False)


def _pinned(tensor: Tensor) -> Tensor:
    copy = tensor.clone()
    copy.untyped_storage().pinned = True  # type: ignore[attr-defined]
    return copy


def _is_pinned(tensor: Tensor) -> bool:
    return getattr(tensor.untyped_storage(), "pinned", False)


def _reads(func: Any, args: Any, kwargs: Any) -> bool:
    if func in INDEXING:
        masked = any(each is not None and each.dtype in (torch.bool, torch.uint8) for each in args[1])
        # A number from the host goes wherever a mask says, without anybody counting where that is.
        return masked and not (len(args) > 2 and args[2].numel() == 1 and not lies_there(args[2]))
    if func is aten.repeat_interleave.Tensor and kwargs.get("output_size") is not None:
        return False
    return bool(READS.intersection(func.tags))


def _frames() -> Iterator[FrameType]:
    """Return what of the project is being run, the innermost first."""
    frame: FrameType | None = sys._getframe()
    while frame is not None:
        name = frame.f_code.co_filename
        if name.startswith(OURS) and name != __file__:
            yield frame
        frame = frame.f_back

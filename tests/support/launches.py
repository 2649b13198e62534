"""What a step asks of a GPU that is not here: operations, triton's kernels, and the bytes that both touch.

Counted on `support.stand_in_device` by another of torch's modes. Kernels run through triton's interpreter where
TRITON_INTERPRET=1 chooses it before they are imported: `measured` is for a process of its own.
"""

import gc
import json
import sys
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from typing import Any, Self

import torch
import triton
from support.gpu_training import small, step_by_step
from support.stand_in_device import StandInDevice, lies_there
from support.tape import replay_steps
from torch import Tensor
from torch.multiprocessing.reductions import StorageWeakRef
from torch.utils._python_dispatch import TorchDispatchMode, _disable_current_modes
from torch.utils._pytree import tree_leaves
from torch.utils.flop_counter import flop_registry
from triton.runtime.interpreter import InterpretedFunction
from triton.runtime.jit import JITFunction

from nerf_lightning.nerf.kernels import backends

STEPS = 3
KERNEL = InterpretedFunction if triton.knobs.runtime.interpret else JITFunction
ALLOCATES = {"aten::empty.memory_format", "aten::empty_like", "aten::new_empty", "aten::empty_strided", "aten::detach"}


class Launches(TorchDispatchMode):
    """Count `operations` on the device, `kernels` of triton's, operations of the `host`, and `bytes` on the device.

    An operation counts once, though some start several kernels (a sort). Bytes are those of all arrays that an
    operation or a kernel takes or returns, each once, however much of it is read. `flops` are of torch's products.

    Args:
        launch: what becomes of a launch (kernel, arguments, options); None: the kernel computes. Where it does not,
            what was allocated for its results is zero.
    """

    def __init__(self, launch: Callable[..., object] | None = None):
        super().__init__()
        self.counts: Counter[str] = Counter()
        self.launch, self.computes = launch or KERNEL.run, launch is None
        self.read: dict[str, StorageWeakRef] | None = None
        """Arrays that were read and not made since `noting` began, by address and shape."""
        self.made: list[Tensor] = []

    def __enter__(self) -> Self:
        self._run, self._try = KERNEL.run, backends._try
        if not self.computes:  # a trial of kernels looks at numbers
            backends._try = lambda module: None
        KERNEL.run = lambda kernel, *args, **options: self._launched(kernel, *args, **options)
        return super().__enter__()

    def __exit__(self, *raised: Any) -> None:
        super().__exit__(*raised)
        KERNEL.run, backends._try = self._run, self._try

    def _launched(self, kernel: Any, *args: Any, **options: Any) -> None:
        self.counts.update(kernels=1, bytes=_bytes([*args, *options.values()]))
        self._note([*args, *options.values()])
        with _disable_current_modes(), torch._C.DisableTorchFunction():
            self.launch(kernel, *args, **options)

    @contextmanager
    def noting(self) -> Iterator[dict[str, StorageWeakRef]]:
        """Note which arrays are read that were there before."""
        self.read, self.made = {}, []
        try:
            yield self.read
        finally:
            self.read, self.made = None, []

    def _note(self, taken: list[Any], made: Sequence[Any] = ()) -> None:
        if self.read is None:
            return
        inside = {each.untyped_storage().data_ptr() for each in self.made}
        for each in taken:
            if isinstance(each, Tensor) and lies_there(each) and each.untyped_storage().data_ptr() not in inside:
                name = f"{each.untyped_storage().data_ptr()} {tuple(each.shape)}"
                self.read[name] = StorageWeakRef(each.untyped_storage())
        self.made += [each for each in made if isinstance(each, Tensor)]  # kept, so that no address comes twice

    def __torch_dispatch__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        with torch._C.DisableTorchFunction():  # the stand-in has seen what Python asked for
            made = func(*args, **(kwargs or {}))
        self._note(tree_leaves((args, kwargs)), tree_leaves(made))
        if func.name() in ALLOCATES:
            if not self.computes and func.name() != "aten::detach":
                made.zero_()
        elif not _is_view(func):
            tensors = [each for each in tree_leaves((args, kwargs, made)) if isinstance(each, Tensor)]
            if any(map(lies_there, tensors)):
                self.counts.update(operations=1, bytes=_bytes(tensors))
                if func.overloadpacket in flop_registry:
                    self.counts.update(flops=flop_registry[func.overloadpacket](*args, out_val=made))
            else:
                self.counts.update(host=1)
        return made


def _is_view(func: Any) -> bool:
    returns = func._schema.returns
    return bool(returns) and all(each.alias_info is not None and not each.alias_info.is_write for each in returns)


def _bytes(values: list[Any]) -> int:
    tensors = [each for each in values if isinstance(each, Tensor)]
    return sum(min(each.nbytes, each.untyped_storage().nbytes()) for each in tensors)  # expanded ones are smaller


def replayed(model: str, precision: str) -> tuple[list[str], dict[str, int]]:
    """Return the arrays that a recording of a small model's step would read after they are gone.

    And what a step asks for beside its replay.
    """
    with StandInDevice("cuda") as there, Launches(lambda *_, **__: None) as launches:
        run = step_by_step(model, there.device, precision, None, *small(model, resolution=8, num_levels=4))
        read: dict[str, StorageWeakRef] = {}

        def record(work: Callable[[], Any]) -> tuple[Callable[[], None], Any]:
            work()
            with launches.noting() as noted:
                seen = work()
            read.update(noted)
            return lambda: None, seen

        replay_steps(run.training, record)
        for _ in range(8):  # across updates of grids
            launches.counts.clear()
            run.step()
        gc.collect()
        return [name for name, array in read.items() if array.expired()], dict(launches.counts)


def measured(model: str, precision: str) -> dict[str, Any]:
    """Return what one warm step and one rendered tile of a small model ask for, and losses with and without kernels."""
    changes = small(model, resolution=8, num_levels=4)
    with StandInDevice("cuda") as there, Launches() as launches:
        run = step_by_step(model, there.device, precision, None, *changes)
        for _ in range(STEPS):
            launches.counts.clear()
            run.step()
        step, losses = dict(launches.counts), run.all_losses().tolist()
        rays = run.training.objective.rays(run.loader.batch_at(0, 0).pixels)
        launches.counts.clear()
        with torch.no_grad():
            run.training.objective.model.eval()(rays, torch.ones_like(rays.origins), None)
        tile = dict(launches.counts)
        with backends.without(*backends.CUDA_BACKENDS):
            run = step_by_step(model, there.device, precision, None, *changes)
            for _ in range(STEPS):
                run.step()
    without = run.all_losses().tolist()
    forgotten, replay = replayed(model, precision)
    found = {"step": step, "replay": replay, "tile": tile, "losses": losses, "without": without}
    return found | {"forgotten": forgotten}


if __name__ == "__main__":
    json.dump({case: measured(*case.split(",")) for case in sys.argv[1:]}, sys.stdout)

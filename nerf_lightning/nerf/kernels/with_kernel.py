"""Let a kernel replace a mathematical function where possible; the function's own body is the reference."""

from collections.abc import Callable
from functools import wraps
from typing import Any, ParamSpec, TypeVar

from nerf_lightning.nerf.kernels.backends import cpu_backend, cuda_backend

Arguments = ParamSpec("Arguments")
Result = TypeVar("Result")


def with_kernel(*modules: str) -> Callable[[Callable[Arguments, Result]], Callable[Arguments, Result]]:
    """Let a function return the result of a kernel for its first argument's device, and compute only if there is none.

    When changing the function, change its kernels, too, or remove this decorator until they follow: tests compare them.

    Args:
        modules: modules of `nerf.kernels`, such as `random.cpu`. Each has a function of the same name and arguments,
            which returns None for arguments that it does not support.

    >>> import torch
    >>> @with_kernel("random.cpu")
    ... def uniform(key, slots, word, count):
    ...     return "in plain torch"
    >>> one = torch.ones(1, dtype=torch.int64)
    >>> uniform(one, one, 1, 2).shape, uniform(one.view(1, 1), one.view(1, 1), 1, 2)
    (torch.Size([1, 2]), 'in plain torch')
    """

    def decorate(reference: Callable[Arguments, Result]) -> Callable[Arguments, Result]:
        @wraps(reference)
        def either(*args: Arguments.args, **kwargs: Arguments.kwargs) -> Result:
            first: Any = args[0]
            for module in modules:
                kernels = (cpu_backend if module.endswith(".cpu") else cuda_backend)(module, first.device)
                found = None if kernels is None else getattr(kernels, reference.__name__)(*args, **kwargs)
                if found is not None:
                    return found
            return reference(*args, **kwargs)

        return either

    return decorate

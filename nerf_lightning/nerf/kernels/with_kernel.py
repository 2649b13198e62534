"""A function of the mathematics, which a kernel is asked before; its own body is the reference."""

from collections.abc import Callable
from functools import wraps
from typing import ParamSpec, TypeVar

Arguments = ParamSpec("Arguments")
Result = TypeVar("Result")


def with_kernel(
    kernel: Callable[Arguments, Result | None],
) -> Callable[[Callable[Arguments, Result]], Callable[Arguments, Result]]:
    """Let a function return what a kernel does, and compute only where that returns None.

    Args:
        kernel: takes the same arguments, and knows for which of them there is a kernel (`op.py` of its folder).

    >>> @with_kernel(lambda x: 2 * x if x < 10 else None)
    ... def double(x):
    ...     return x + x + 0.0
    >>> double(3), double(30)
    (6, 60.0)
    """

    def decorate(reference: Callable[Arguments, Result]) -> Callable[Arguments, Result]:
        @wraps(reference)
        def either(*args: Arguments.args, **kwargs: Arguments.kwargs) -> Result:
            found = kernel(*args, **kwargs)
            return reference(*args, **kwargs) if found is None else found

        return either

    return decorate

"""Ask for memory before it is needed: what numba has no word for."""

from typing import Any

from llvmlite import ir
from numba import types
from numba.extending import intrinsic

READ, WRITE, KEEP, DATA = 0, 1, 3, 1


@intrinsic
def prefetch(typing_context: Any, base: Any, offset: Any) -> Any:
    """Start to load the cache line at `base + offset`, an address and a distance in bytes; nothing waits for it.

    LLVM's prefetch, which is nothing on processors without one. No address is wrong: what cannot be read is not.
    """

    def code(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        pointer, number = ir.IntType(8).as_pointer(), ir.IntType(32)
        kind = ir.FunctionType(ir.VoidType(), [pointer, number, number, number])
        ask = builder.module.declare_intrinsic("llvm.prefetch", (pointer,), kind)
        place = builder.inttoptr(builder.add(*arguments), pointer)
        builder.call(ask, [place, number(READ), number(KEEP), number(DATA)])
        return context.get_dummy_value()

    return types.void(types.int64, types.int64), code

"""Adam's step for the CPU, in one pass, 16 numbers at a time.

Most gradients of a hash grid are zero, and a vector of zeros is only read. LLVM does not vectorize this loop by itself,
since it does not know that the arrays do not overlap.
"""

from typing import Any, no_type_check

import numpy as np
import torch
from llvmlite import ir
from numba import njit
from numba.core import cgutils, types
from numba.extending import intrinsic
from torch import Tensor

from nerf_lightning.nerf.kernels.mlp.vectors import ADDRESS, FLOAT, FLOATS, LANES, WORDS, pointer_to
from nerf_lightning.nerf.kernels.threads import over_rows


def adam_step(
    parameter: Tensor,
    grad: Tensor,
    first: Tensor,
    second: Tensor,
    step_size: float,
    root_scale: float,
    beta1: float,
    beta2: float,
    eps: float,
) -> None:
    """Update contiguous float32 arrays in place."""
    arrays = [x.view(-1).numpy() for x in (parameter, grad, first, second)]
    numbers = [np.float32(x) for x in (step_size, root_scale, beta1, beta2, eps)]
    vectors, rest = divmod(parameter.numel(), LANES)
    over_rows(_update_vectors, vectors, *arrays, *numbers)
    if rest:  # in a separate vector, padded with zeros
        last = [np.zeros(LANES, np.float32) for _ in arrays]
        for vector, array in zip(last, arrays, strict=True):
            vector[:rest] = array[-rest:]
        _update_vectors(0, 1, *last, *numbers)
        for vector, array in zip(last, arrays, strict=True):
            array[-rest:] = vector[:rest]


def trial() -> None:
    """Run the kernel once on tiny input; it raises whatever the compiler raises."""
    adam_step(torch.ones(4), torch.ones(4), torch.zeros(4), torch.zeros(4), 0.1, 1.0, 0.9, 0.99, 1e-15)


@intrinsic
def _update(
    context: Any, parameter: Any, grad: Any, first: Any, second: Any, step_size: Any, root_scale: Any, beta1: Any,
    beta2: Any, eps: Any,
) -> Any:  # fmt: skip
    """Update 16 numbers where their gradients are nonzero, and set those gradients to zero."""

    def code(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        at = [pointer_to(builder, address, FLOATS) for address in arguments[:4]]
        zeros, lanes = ir.Constant(FLOATS, [0.0] * LANES), ir.Constant(WORDS, [0] * LANES)

        def spread(number: Any) -> Any:
            vector = builder.insert_element(ir.Constant(FLOATS, ir.Undefined), number, ir.IntType(32)(0))
            return builder.shuffle_vector(vector, ir.Constant(FLOATS, ir.Undefined), lanes)

        g = builder.load(at[1], align=4)
        touched = builder.fcmp_unordered("!=", g, zeros)
        with builder.if_then(
            builder.icmp_unsigned("!=", builder.bitcast(touched, ir.IntType(LANES)), ir.IntType(LANES)(0))
        ):
            step_size, root_scale, beta1, beta2, eps = map(spread, arguments[4:])
            one = spread(FLOAT(1.0))
            p, m, v = (builder.load(each, align=4) for each in (at[0], at[2], at[3]))
            fresh = builder.fmul(builder.fsub(one, beta1), g)
            new_m = builder.fadd(builder.fmul(beta1, m), fresh)
            squared = builder.fmul(builder.fmul(builder.fsub(one, beta2), g), g)
            new_v = builder.fadd(builder.fmul(beta2, v), squared)
            root = cgutils.get_or_insert_function(builder.module, ir.FunctionType(FLOATS, [FLOATS]), "llvm.sqrt.v16f32")
            below = builder.fadd(builder.fmul(builder.call(root, [new_v]), root_scale), eps)
            new_p = builder.fsub(p, builder.fdiv(builder.fmul(step_size, new_m), below))
            for new, old, address in ((new_p, p, at[0]), (new_m, m, at[2]), (new_v, v, at[3])):
                builder.store(builder.select(touched, new, old), address, align=4)
            builder.store(zeros, at[1], align=4)
        return context.get_dummy_value()

    return types.void(*[ADDRESS] * 4, *[types.float32] * 5), code


@njit(nogil=True, cache=True)
@no_type_check
def _update_vectors(start, end, parameter, grad, first, second, step_size, root_scale, beta1, beta2, eps):
    p, g, m, v = parameter.ctypes.data, grad.ctypes.data, first.ctypes.data, second.ctypes.data
    for vector in range(start, end):
        byte = np.int64(4 * LANES * vector)
        _update(p + byte, g + byte, m + byte, v + byte, step_size, root_scale, beta1, beta2, eps)

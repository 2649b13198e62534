"""Real spherical harmonics for CUDA, in one pass. `TRITON_INTERPRET=1` runs the kernel without a GPU.

The constants are those of `encoders.spherical_harmonics`, which is the reference.
"""

from typing import no_type_check

import torch
import triton
import triton.language as tl
from jaxtyping import Float
from torch import Tensor

BLOCK = 256


def spherical_harmonics(
    directions: Float[Tensor, "*points 3"], degree: int
) -> Float[Tensor, "*points features"] | None:
    """Return Y_lm of unit directions, l below `degree`; None if they are not float32, or gradients are needed."""
    if directions.dtype != torch.float32 or directions.requires_grad:
        return None
    count = directions.numel() // 3
    out = torch.empty(*directions.shape[:-1], degree * degree, device=directions.device)
    if count:
        _harmonics[(triton.cdiv(count, BLOCK),)](directions.contiguous(), out, count, degree, BLOCK)
    return out


def trial(device: str = "cuda") -> None:
    """Run the kernel once on tiny input; it raises whatever the compiler or driver raises."""
    for degree in range(1, 5):
        found = spherical_harmonics(torch.ones(1, 3, device=device), degree)
        if found is None or not bool(found.isfinite().all()):
            raise RuntimeError("a trial of its kernels gave numbers that are not finite")


@triton.jit
@no_type_check
def _harmonics(directions, out, count, degree: tl.constexpr, block: tl.constexpr):
    row = (tl.program_id(0) * block + tl.arange(0, block)).to(tl.int64)
    valid = row < count
    x = tl.load(directions + 3 * row, mask=valid, other=0.0)
    y = tl.load(directions + 3 * row + 1, mask=valid, other=0.0)
    z = tl.load(directions + 3 * row + 2, mask=valid, other=0.0)
    into = out + row * (degree * degree)
    tl.store(into, tl.full([block], 0.28209479177387814, tl.float32), mask=valid)
    if degree > 1:
        tl.store(into + 1, -0.4886025119029199 * y, mask=valid)
        tl.store(into + 2, 0.4886025119029199 * z, mask=valid)
        tl.store(into + 3, -0.4886025119029199 * x, mask=valid)
    xx, yy, zz = x * x, y * y, z * z
    if degree > 2:
        tl.store(into + 4, 1.0925484305920792 * x * y, mask=valid)
        tl.store(into + 5, -1.0925484305920792 * y * z, mask=valid)
        tl.store(into + 6, 0.31539156525252005 * (3 * zz - 1), mask=valid)
        tl.store(into + 7, -1.0925484305920792 * x * z, mask=valid)
        tl.store(into + 8, 0.5462742152960396 * (xx - yy), mask=valid)
    if degree > 3:
        tl.store(into + 9, -0.5900435899266435 * y * (3 * xx - yy), mask=valid)
        tl.store(into + 10, 2.890611442640554 * x * y * z, mask=valid)
        tl.store(into + 11, -0.4570457994644658 * y * (5 * zz - 1), mask=valid)
        tl.store(into + 12, 0.3731763325901154 * z * (5 * zz - 3), mask=valid)
        tl.store(into + 13, -0.4570457994644658 * x * (5 * zz - 1), mask=valid)
        tl.store(into + 14, 1.445305721320277 * z * (xx - yy), mask=valid)
        tl.store(into + 15, -0.5900435899266435 * x * (xx - 3 * yy), mask=valid)

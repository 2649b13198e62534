"""Newton's iteration that undistorts lenses, for the CPU (`geometry.lenses`)."""

from typing import no_type_check

import torch
from jaxtyping import Float
from numba import njit
from torch import Tensor

from nerf_lightning.nerf.kernels.threads import over_rows


def undistort(
    plane: Float[Tensor, "*points 2"], lens: Float[Tensor, "*#points 6"], steps: int
) -> Float[Tensor, "*points 2"] | None:
    """Return the undistorted positions that the lens shows at positions in the plane; None if gradients are needed."""
    if plane.requires_grad or lens.requires_grad:
        return None
    rows, of_rows = plane.reshape(-1, 2), lens.expand(*plane.shape[:-1], 6).reshape(-1, 6)
    out = torch.empty_like(rows)
    over_rows(_undistort, len(rows), rows.contiguous().numpy(), of_rows.contiguous().numpy(), steps, out.numpy())
    return out.view(plane.shape)


def trial() -> None:
    """Run the kernel once on tiny input, in both precisions; it raises whatever the compiler raises."""
    for dtype in (torch.float32, torch.float64):
        undistort(torch.zeros(1, 2, dtype=dtype), torch.zeros(1, 6, dtype=dtype), 1)


@njit(nogil=True, cache=True, error_model="numpy")
@no_type_check
def _undistort(first, last, plane, lens, steps, out):
    number = plane.dtype.type
    one, two, three, four, six, eight = number(1), number(2), number(3), number(4), number(6), number(8)
    for i in range(first, last):
        k1, k2, k3, k4, p1, p2 = lens[i, 0], lens[i, 1], lens[i, 2], lens[i, 3], lens[i, 4], lens[i, 5]
        x, y = plane[i, 0], plane[i, 1]
        for _ in range(steps):
            xx, xy, yy = x * x, x * y, y * y
            s = xx + yy
            radial = one + s * (k1 + s * (k2 + s * (k3 + s * k4)))
            slope = two * k1 + s * (four * k2 + s * (six * k3 + s * (eight * k4)))
            off_x = x * radial + two * p1 * xy + p2 * (three * xx + yy) - plane[i, 0]
            off_y = y * radial + p1 * (xx + three * yy) + two * p2 * xy - plane[i, 1]
            along_x = radial + xx * slope + two * p1 * y + six * p2 * x
            along_y = radial + yy * slope + six * p1 * y + two * p2 * x
            across = xy * slope + two * (p1 * x + p2 * y)
            determinant = along_x * along_y - across * across
            x -= (along_y * off_x - across * off_y) / determinant
            y -= (along_x * off_y - across * off_x) / determinant
        out[i, 0], out[i, 1] = x, y

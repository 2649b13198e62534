"""Where the rows of an array end and its padding begins, for CUDA kernels: the number is on the device."""

from typing import no_type_check

import triton
import triton.language as tl


@triton.jit
@no_type_check
def end_of_rows(used, count):
    """Return the row from which on all is padding, to which `used` points; None: there is no padding."""
    if used is None:
        return count
    else:
        return tl.minimum(tl.load(used), count).to(tl.int32)

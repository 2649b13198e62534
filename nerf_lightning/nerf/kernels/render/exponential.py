"""Vectorized exponentials of contiguous numbers: one by one, they took as long as the rest of the quadrature."""

from typing import no_type_check

import numpy as np
from numba import njit

LOWEST, HIGHEST = np.float32(-87.0), np.float32(88.0)
"""Range to which arguments are clamped: a float32 holds no more."""
PER_LN2, LN2, LN2_REST = np.float32(1.4426950408889634), np.float32(0.693359375), np.float32(-2.12194440e-4)
ONE, HALF = np.float32(1.0), np.float32(0.5)
FIFTH, FOURTH, THIRD = np.float32(1.9875691500e-4), np.float32(1.3981999507e-3), np.float32(8.3334519073e-3)
SECOND, FIRST, ZEROTH = np.float32(4.1665795894e-2), np.float32(1.6666665459e-1), np.float32(5.0000001201e-1)
"""Coefficients of a minimax polynomial (Cephes Mathematical Library, `expf`), with an error below 2^-23."""
BIAS, MANTISSA = np.int32(127), np.int32(23)
NEAR_ZERO = np.float32(0.01)
SIXTH = np.float32(1.0 / 6.0)


@njit(fastmath={"contract"}, error_model="numpy")
@no_type_check
def exponentials(x, out, bits):
    """Write e^x of each number of x; `bits` is scratch space for as many int32. NaN stays NaN."""
    for i in range(x.shape[0]):
        v = min(max(x[i], LOWEST), HIGHEST)
        n = np.floor(v * PER_LN2 + HALF)
        r = v - n * LN2 - n * LN2_REST
        p = ((((FIFTH * r + FOURTH) * r + THIRD) * r + SECOND) * r + FIRST) * r + ZEROTH
        p = p * r * r + r + ONE
        out[i] = p if x[i] == x[i] else x[i]
        bits[i] = (np.int32(n) + BIAS) << MANTISSA
    powers = bits.view(np.float32)
    for i in range(x.shape[0]):
        out[i] *= powers[i]


@njit(fastmath={"contract"}, error_model="numpy")
@no_type_check
def absorbed(thickness, out, bits):
    """Write 1 - e^-x of each number x >= 0, exact near 0; `thickness` is overwritten, `bits` is scratch space."""
    for i in range(thickness.shape[0]):
        thickness[i] = -thickness[i]
    exponentials(thickness, out, bits)
    for i in range(thickness.shape[0]):
        x = -thickness[i]
        near = x * (ONE - x * (HALF - x * SIXTH))
        out[i] = near if x < NEAR_ZERO else ONE - out[i]


@njit(fastmath={"contract"}, error_model="numpy")
@no_type_check
def sigmoids(x, out, bits):
    """Write 1 / (1 + e^-x) of each number; x is overwritten, `bits` is scratch space."""
    for i in range(x.shape[0]):
        x[i] = -x[i]
    exponentials(x, out, bits)
    for i in range(x.shape[0]):
        out[i] = ONE / (ONE + out[i])

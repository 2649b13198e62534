"""What whole-ray kernels with gradients keep of each sample, and how they compute it for a block of samples.

Letters as in `rendering.quadrature`.
"""

from typing import no_type_check

import numpy as np
from numba import njit

from nerf_lightning.nerf.activations import LARGEST_SLOPE_RAW
from nerf_lightning.nerf.kernels.mlp.cpu import ROWS
from nerf_lightning.nerf.kernels.render.cpu import LARGEST_RAW, is_inside
from nerf_lightning.nerf.kernels.render.exponential import absorbed, exponentials, sigmoids

BACK, LIGHT, WEIGHT, SHARE, COLOR, DISTANCE = 0, 1, 2, 3, 4, 7
"""Columns of each sample: length times slope of the density times SHARE; the light behind it; its weight; the share of
its gradients that counts (`rendering.near_gradients`); three colors; its distance."""
LARGEST_SLOPE = np.float32(LARGEST_SLOPE_RAW)
ONE, ZERO = np.float32(1.0), np.float32(0.0)


@njit
@no_type_check
def new_rooms():
    """Return scratch space for `absorb` and `shade`: three rows of numbers, and one of bits."""
    floats = np.zeros((3, ROWS), np.float32)
    return floats[0], floats[1], floats[2], np.zeros(ROWS, np.int32)


@njit
@no_type_check
def absorb(count, raw, outer, bias, everywhere, whole_from, delta, t, points, numbers, rooms):
    """Write each sample's alpha, given its raw density, to the third of `rooms`, and what gradients need to `numbers`.

    Space outside the unit cube is empty, unless `everywhere`; from distance `whole_from` on, gradients are whole.
    """
    biased, density, alpha, bits = rooms
    for i in range(count):
        biased[i] = min(raw[i * outer] + bias, LARGEST_RAW)
    exponentials(biased[:count], density[:count], bits[:count])
    for i in range(count):
        if not (everywhere or is_inside(points, i)):
            density[i] = ZERO
    for i in range(count):
        share = ONE
        if whole_from > ZERO:
            share = min((t[i] / whole_from) ** 2, ONE)
        numbers[i, BACK], numbers[i, SHARE] = delta[i] * density[i] * share, share
    for i in range(count):
        if abs(biased[i]) > LARGEST_SLOPE and density[i] > ZERO:  # rare, and a call: apart, so the others vectorize
            slope = np.float32(np.exp(min(max(biased[i], -LARGEST_SLOPE), LARGEST_SLOPE)))
            numbers[i, BACK] = delta[i] * slope * numbers[i, SHARE]
        density[i] *= delta[i]
    absorbed(density[:count], alpha[:count], bits[:count])


@njit
@no_type_check
def shade(count, flat, outer, owner, numbers, rooms, foreground):
    """Add weighted colors, given raw ones, to the foreground of each sample's ray; some samples have no owner."""
    raw, shades, _, bits = rooms
    for c in range(3):
        for i in range(count):
            raw[i] = flat[i * outer + c]
        sigmoids(raw[:count], shades[:count], bits[:count])
        for i in range(count):
            numbers[i, COLOR + c] = shades[i]
            if owner[i] >= 0:
                foreground[owner[i], c] += numbers[i, WEIGHT] * shades[i]

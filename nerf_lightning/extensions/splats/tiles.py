"""Blend splats into pixels and propagate gradients back, on the CPU: one thread per tile of 16 x 16 pixels.

Within a tile, splats are processed once, nearest first, and only in the rows where each is visible: 16 pixels at a
time, which stay in the cache with their remaining light.
"""

import math
from typing import no_type_check

import numpy as np
from jaxtyping import Float, Int
from numba import njit
from numpy import ndarray

from nerf_lightning.extensions.splats.gaussians import LARGEST_ALPHA, LEAST_ALPHA, LEAST_LIGHT
from nerf_lightning.extensions.splats.projection import (
    CONIC_A,
    CONIC_B,
    CONIC_C,
    DEPTH,
    MEAN_X,
    MEAN_Y,
    OPACITY,
    REACH_X,
    REACH_Y,
    RED,
)

SIDE = 16
AREA = SIDE * SIDE
CHECK_EVERY = 16  # Number of splats after which a tile checks whether it is opaque.
HALF, ONE, ZERO = np.float32(0.5), np.float32(1.0), np.float32(0.0)
LEAST, LARGEST, DARK = np.float32(LEAST_ALPHA), np.float32(LARGEST_ALPHA), np.float32(LEAST_LIGHT)
# exp(-8 u) = p(u)^8 for u in [0, 1], to 2e-7: a polynomial vectorizes, the library's function does not.
U1, U2, U3, U4 = (np.uint64(part * AREA) for part in range(1, 5))
EIGHTH, FARTHEST = np.float32(0.125), np.float32(8.0)
P = np.polynomial.Chebyshev.interpolate(lambda u: np.exp(-u), 7, (0, 1)).convert(kind=np.polynomial.Polynomial).coef
P0, P1, P2, P3, P4, P5, P6, P7 = (np.float32(each) for each in P)
FAST = {"contract", "reassoc", "arcp"}  # NaN keeps its meaning: not drawn.


def nearest_first(screen: Float[ndarray, "n 12"]) -> Int[ndarray, "drawn"]:
    """Return the indices of the drawn splats, sorted stably by depth."""
    drawn = np.flatnonzero(screen[:, DEPTH] > 0)
    # Positive floats sort like their bits: one sort of integers, without ties.
    keys = screen[drawn, DEPTH].view(np.uint32).astype(np.uint64) << np.uint64(32) | drawn.astype(np.uint64)
    return (np.sort(keys) & np.uint64(0xFFFFFFFF)).astype(np.int64)


@njit
@no_type_check
def _tiles_of(row, across, down):
    left, right = int((row[MEAN_X] - row[REACH_X]) / SIDE), int((row[MEAN_X] + row[REACH_X]) / SIDE)
    top, bottom = int((row[MEAN_Y] - row[REACH_Y]) / SIDE), int((row[MEAN_Y] + row[REACH_Y]) / SIDE)
    return max(left, 0), min(right, across - 1), max(top, 0), min(bottom, down - 1)


@njit(nogil=True, cache=True)
@no_type_check
def sort_into_tiles(order, screen, across, down):
    """Return the splats of each tile in order, tile by tile, and the start of each tile."""
    starts = np.zeros(across * down + 1, np.int64)
    for i in order:
        left, right, top, bottom = _tiles_of(screen[i], across, down)
        for y in range(top, bottom + 1):
            for x in range(left, right + 1):
                starts[y * across + x + 1] += 1
    starts = np.cumsum(starts)
    splats, filled = np.empty(starts[-1], np.int32), starts[:-1].copy()
    for i in order:
        left, right, top, bottom = _tiles_of(screen[i], across, down)
        for y in range(top, bottom + 1):
            for x in range(left, right + 1):
                splats[filled[y * across + x]] = i
                filled[y * across + x] += 1
    return splats, starts


@njit(inline="always")
@no_type_check
def _exp_minus(s):
    # s is at least 0; beyond 8, where no alpha is visible, the result is exp(-8).
    u = min(max(s, ZERO), FARTHEST) * EIGHTH
    p = P0 + u * (P1 + u * (P2 + u * (P3 + u * (P4 + u * (P5 + u * (P6 + u * P7))))))
    p = p * p
    p = p * p
    return p * p


@njit
@no_type_check
def _is_dark(light):
    most = ZERO
    for pixel in range(AREA):
        most = max(most, light[pixel])
    return most < DARK


@njit
@no_type_check
def _splat(row, x0, y0):
    # A splat relative to a tile: mean, conic, opacity, color, and the rows of pixels in which it is visible.
    mean_x, mean_y = row[MEAN_X] - np.float32(x0) - HALF, row[MEAN_Y] - np.float32(y0) - HALF
    top, bottom = max(math.ceil(mean_y - row[REACH_Y]), 0), min(math.floor(mean_y + row[REACH_Y]), SIDE - 1)
    shape = mean_x, mean_y, row[CONIC_A], row[CONIC_B], row[CONIC_C]
    return *shape, row[OPACITY], row[RED], row[RED + 1], row[RED + 2], top, bottom


@njit(nogil=True, cache=True, error_model="numpy", fastmath=FAST)
@no_type_check
def blend(first, last, across, screen, splats, starts, background, picture):
    """Fill the pixels of some tiles; the picture consists of whole tiles."""
    # Remaining light, and the three colors. One array, so that LLVM knows that its parts do not alias.
    px = np.empty(4 * AREA, np.float32)
    for tile in range(first, last):
        x0, y0 = tile % across * SIDE, tile // across * SIDE
        px[:AREA], px[AREA:] = ONE, ZERO
        for k in range(starts[tile], starts[tile + 1]):
            if (k - starts[tile]) % CHECK_EVERY == CHECK_EVERY - 1 and _is_dark(px):
                break
            mean_x, mean_y, a, b, c, opacity, red, green, blue, top, bottom = _splat(screen[splats[k]], x0, y0)
            for y in range(top, bottom + 1):
                dy, base = np.float32(y) - mean_y, np.uint64(y * SIDE)
                for x in range(SIDE):
                    dx, at = np.float32(x) - mean_x, base + np.uint64(x)
                    alpha = min(opacity * _exp_minus(HALF * (a * dx * dx + c * dy * dy) + b * dx * dy), LARGEST)
                    light = px[at]
                    w = alpha * light if (alpha >= LEAST) & (light >= DARK) else ZERO
                    px[at] = light - w
                    px[at + U1] += w * red
                    px[at + U2] += w * green
                    px[at + U3] += w * blue
        for y in range(SIDE):
            for x in range(SIDE):
                at = y * SIDE + x
                for c in range(3):
                    picture[y0 + y, x0 + x, c] = px[at + (c + 1) * AREA] + px[at] * background[c]


@njit(nogil=True, cache=True, error_model="numpy", fastmath=FAST)
@no_type_check
def blend_back(first, last, across, screen, splats, starts, picture, gradient, parts):
    """Fill the gradient of each splat in each of some tiles: rows of `parts`, the first nine columns of the screen's.

    With g the gradient of a pixel and C its color: dL/dalpha_i = T_i c_i.g - R_i.g / (1 - alpha_i), where
    R_i = C - sum over j <= i of T_j alpha_j c_j is what is behind. Nearest first again, so that the light is the same,
    bit for bit.
    """
    # Remaining light, R.g, and the gradient's three colors.
    px = np.empty(5 * AREA, np.float32)
    for tile in range(first, last):
        x0, y0 = tile % across * SIDE, tile // across * SIDE
        px[:AREA] = ONE
        for y in range(SIDE):
            for x in range(SIDE):
                at, behind = y * SIDE + x, ZERO
                for c in range(3):
                    g = gradient[y0 + y, x0 + x, c]
                    px[at + (2 + c) * AREA] = g
                    behind += g * picture[y0 + y, x0 + x, c]
                px[at + AREA] = behind
        for k in range(starts[tile], starts[tile + 1]):
            if (k - starts[tile]) % CHECK_EVERY == CHECK_EVERY - 1 and _is_dark(px):
                break
            mean_x, mean_y, a, b, c, opacity, red, green, blue, top, bottom = _splat(screen[splats[k]], x0, y0)
            of_opacity = of_x = of_y = of_a = of_b = of_c = of_red = of_green = of_blue = ZERO
            for y in range(top, bottom + 1):
                dy, base = np.float32(y) - mean_y, np.uint64(y * SIDE)
                q0 = q1 = q2 = g_red = g_green = g_blue = ZERO
                for x in range(SIDE):
                    dx, at = np.float32(x) - mean_x, base + np.uint64(x)
                    unclamped = opacity * _exp_minus(HALF * (a * dx * dx + c * dy * dy) + b * dx * dy)
                    alpha = min(unclamped, LARGEST)
                    light, r, g, bl = px[at], px[at + U2], px[at + U3], px[at + U4]
                    drawn = (alpha >= LEAST) & (light >= DARK)
                    w = alpha * light if drawn else ZERO
                    px[at] = light - w
                    color_gradient = red * r + green * g + blue * bl
                    behind = px[at + U1] - w * color_gradient
                    px[at + U1] = behind
                    g_red += w * r
                    g_green += w * g
                    g_blue += w * bl
                    of_alpha = light * color_gradient - behind / (ONE - alpha)
                    q = of_alpha * alpha if drawn & (unclamped < LARGEST) else ZERO
                    q0 += q
                    q1 += q * dx
                    q2 += q * dx * dx
                of_opacity += q0
                of_x += a * q1 + b * dy * q0
                of_y += b * q1 + c * dy * q0
                of_a -= HALF * q2
                of_b -= q1 * dy
                of_c -= HALF * q0 * dy * dy
                of_red += g_red
                of_green += g_green
                of_blue += g_blue
            out = parts[k]
            out[MEAN_X], out[MEAN_Y], out[OPACITY] = of_x, of_y, of_opacity / opacity
            out[CONIC_A], out[CONIC_B], out[CONIC_C] = of_a, of_b, of_c
            out[RED], out[RED + 1], out[RED + 2] = of_red, of_green, of_blue


@njit(nogil=True, cache=True)
@no_type_check
def add_parts(splats, parts, on_screen):
    """Add the tiles' gradients of each splat, always in the same order."""
    for k in range(len(splats)):
        i = splats[k]
        for column in range(parts.shape[1]):
            on_screen[i, column] += parts[k, column]


def trial() -> None:
    """Compile the kernels; errors of the compiler propagate."""
    from nerf_lightning.extensions.splats.rasterizer import try_kernels

    try_kernels()

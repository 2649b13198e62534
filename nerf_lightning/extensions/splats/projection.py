"""Project splats to the screen and gradients back, on the CPU: `gaussians.project` and `gaussians.colors`, fused.

A row of `screen` is one splat: mean (x, y), conic (a, b, c), opacity, color, half width and half height of the box in
which it is visible (pixels), and depth, which is 0 for splats that are not drawn. Gradients on the screen have its
first nine columns.
"""

import math
from typing import no_type_check

import numpy as np
from numba import njit

from nerf_lightning.extensions.splats.gaussians import DILATION, LEAST_ALPHA
from nerf_lightning.nerf.encoders.spherical_harmonics import DEGREE_1, DEGREE_2, DEGREE_3, DEGREE_4

COLUMNS = 12
MEAN_X, MEAN_Y, CONIC_A, CONIC_B, CONIC_C, OPACITY, RED, REACH_X, REACH_Y, DEPTH = 0, 1, 2, 3, 4, 5, 6, 9, 10, 11
DILATED, VISIBLE = np.float32(DILATION), np.float32(LEAST_ALPHA)
ONE, TWO, HALF, ZERO = np.float32(1.0), np.float32(2.0), np.float32(0.5), np.float32(0.0)
FAR_OFF = np.float32(1e6)  # Pixels; larger sizes or distances are numerical errors.
Y0, Y1 = np.float32(DEGREE_1), np.float32(DEGREE_2)
Y2, Y3 = np.array(DEGREE_3, np.float32), np.array(DEGREE_4, np.float32)


@njit(nogil=True, cache=True, error_model="numpy")
@no_type_check
def project(first, last, splats, camera, screen):
    """Fill rows of the screen."""
    means, log_scales, quaternions, logits, sh_dc, sh_rest = splats
    rotation, eye, lens = camera
    r, m, t, basis = _scratch()
    for i in range(first, last):
        screen[i, DEPTH] = ZERO
        x, y, z = _local(means, i, rotation, eye)
        if not z > lens[6]:  # NaN, too
            continue
        _axes(quaternions, log_scales, i, r, m)
        xx, xy, yy = _covariance(x, y, z, rotation, lens, m, t)
        determinant, opacity = xx * yy - xy * xy, ONE / (ONE + math.exp(-logits[i]))
        if not (determinant > ZERO and opacity > VISIBLE):
            continue
        cut = TWO * math.log(opacity / VISIBLE)  # the value of d^T conic d at which alpha is just visible
        mean_x, mean_y = lens[0] * x / z + lens[2], lens[1] * y / z + lens[3]
        reach_x, reach_y = math.sqrt(cut * xx), math.sqrt(cut * yy)
        if not (abs(mean_x) + reach_x < FAR_OFF and abs(mean_y) + reach_y < FAR_OFF):
            continue
        if (
            mean_x + reach_x < ZERO
            or mean_x - reach_x > lens[7]
            or mean_y + reach_y < ZERO
            or mean_y - reach_y > lens[8]
        ):
            continue
        row = screen[i]
        row[MEAN_X], row[MEAN_Y], row[OPACITY], row[REACH_X], row[REACH_Y] = mean_x, mean_y, opacity, reach_x, reach_y
        row[CONIC_A], row[CONIC_B], row[CONIC_C] = yy / determinant, -xy / determinant, xx / determinant
        _harmonics(means, i, eye, sh_rest.shape[1], basis)
        for c in range(3):
            color = HALF + Y0 * sh_dc[i, c]
            for k in range(sh_rest.shape[1]):
                color += basis[k + 1] * sh_rest[i, k, c]
            if not abs(color) < FAR_OFF:
                break
            row[RED + c] = max(color, ZERO)
        else:
            row[DEPTH] = z


@njit(nogil=True, cache=True, error_model="numpy")
@no_type_check
def project_back(first, last, splats, camera, screen, on_screen, gradients):
    """Fill the gradients of splats, given those on the screen."""
    means, log_scales, quaternions, _, _, sh_rest = splats
    rotation, eye, lens = camera
    to_means, to_scales, to_quaternions, to_logits, to_dc, to_rest = gradients
    r, m, t, basis = _scratch()
    to_t, to_m = np.empty((2, 3), np.float32), np.empty((3, 3), np.float32)
    for i in range(first, last):
        if screen[i, DEPTH] == ZERO:
            continue
        g, opacity = on_screen[i], screen[i, OPACITY]
        to_logits[i] = g[OPACITY] * opacity * (ONE - opacity)
        _harmonics(means, i, eye, sh_rest.shape[1], basis)
        for c in range(3):
            if screen[i, RED + c] > ZERO:
                to_dc[i, c] = Y0 * g[RED + c]
                for k in range(sh_rest.shape[1]):
                    to_rest[i, k, c] = basis[k + 1] * g[RED + c]
        x, y, z = _local(means, i, rotation, eye)
        _axes(quaternions, log_scales, i, r, m)
        _covariance(x, y, z, rotation, lens, m, t)
        # Of the covariance C on the screen: -Q G Q, for the conic Q = C^-1 and its gradient G.
        a, b, c = screen[i, CONIC_A], screen[i, CONIC_B], screen[i, CONIC_C]
        ga, gb, gc = g[CONIC_A], HALF * g[CONIC_B], g[CONIC_C]
        left_a, left_b, left_c, left_d = a * ga + b * gb, a * gb + b * gc, b * ga + c * gb, b * gb + c * gc
        xx, xy, yy = -(left_a * a + left_b * b), -(left_a * b + left_b * c), -(left_c * b + left_d * c)
        # C = A A^T with A = T M, T = J W, M = R diag(s).
        for k in range(3):
            a0 = t[0, 0] * m[0, k] + t[0, 1] * m[1, k] + t[0, 2] * m[2, k]
            a1 = t[1, 0] * m[0, k] + t[1, 1] * m[1, k] + t[1, 2] * m[2, k]
            d0, d1 = TWO * (xx * a0 + xy * a1), TWO * (xy * a0 + yy * a1)
            for j in range(3):
                to_m[j, k] = t[0, j] * d0 + t[1, j] * d1
                to_t[0, j] = d0 * m[j, k] + (ZERO if k == 0 else to_t[0, j])
                to_t[1, j] = d1 * m[j, k] + (ZERO if k == 0 else to_t[1, j])
        _axes_back(quaternions, log_scales, i, r, to_m, to_scales, to_quaternions)
        _local_back(x, y, z, rotation, lens, g, to_t, to_means[i])


@njit
@no_type_check
def _scratch():
    r, m, t = np.empty((3, 3), np.float32), np.empty((3, 3), np.float32), np.empty((2, 3), np.float32)
    return r, m, t, np.empty(16, np.float32)


@njit
@no_type_check
def _local(means, i, rotation, eye):
    x, y, z = means[i, 0] - eye[0], means[i, 1] - eye[1], means[i, 2] - eye[2]
    return (
        rotation[0, 0] * x + rotation[0, 1] * y + rotation[0, 2] * z,
        rotation[1, 0] * x + rotation[1, 1] * y + rotation[1, 2] * z,
        rotation[2, 0] * x + rotation[2, 1] * y + rotation[2, 2] * z,
    )


@njit
@no_type_check
def _unit(quaternions, i):
    w, x, y, z = quaternions[i, 0], quaternions[i, 1], quaternions[i, 2], quaternions[i, 3]
    length = math.sqrt(w * w + x * x + y * y + z * z)
    return w / length, x / length, y / length, z / length, length


@njit
@no_type_check
def _axes(quaternions, log_scales, i, r, m):
    # R, and M = R diag(s).
    w, x, y, z, _ = _unit(quaternions, i)
    r[0, 0], r[0, 1], r[0, 2] = ONE - TWO * (y * y + z * z), TWO * (x * y - w * z), TWO * (x * z + w * y)
    r[1, 0], r[1, 1], r[1, 2] = TWO * (x * y + w * z), ONE - TWO * (x * x + z * z), TWO * (y * z - w * x)
    r[2, 0], r[2, 1], r[2, 2] = TWO * (x * z - w * y), TWO * (y * z + w * x), ONE - TWO * (x * x + y * y)
    for k in range(3):
        s = math.exp(log_scales[i, k])
        for j in range(3):
            m[j, k] = r[j, k] * s


@njit
@no_type_check
def _covariance(x, y, z, rotation, lens, m, t):
    # T = J W, and the three numbers of T M M^T T^T + 0.3 I.
    slope_x, slope_y = min(max(x / z, -lens[4]), lens[4]), min(max(y / z, -lens[5]), lens[5])
    for j in range(3):
        t[0, j] = lens[0] / z * (rotation[0, j] - slope_x * rotation[2, j])
        t[1, j] = lens[1] / z * (rotation[1, j] - slope_y * rotation[2, j])
    xx, xy, yy = DILATED, ZERO, DILATED
    for k in range(3):
        a0 = t[0, 0] * m[0, k] + t[0, 1] * m[1, k] + t[0, 2] * m[2, k]
        a1 = t[1, 0] * m[0, k] + t[1, 1] * m[1, k] + t[1, 2] * m[2, k]
        xx, xy, yy = xx + a0 * a0, xy + a0 * a1, yy + a1 * a1
    return xx, xy, yy


@njit
@no_type_check
def _axes_back(quaternions, log_scales, i, r, to_m, to_scales, to_quaternions):
    for k in range(3):
        s = math.exp(log_scales[i, k])
        to_scales[i, k] = s * (r[0, k] * to_m[0, k] + r[1, k] * to_m[1, k] + r[2, k] * to_m[2, k])
        for j in range(3):
            to_m[j, k] *= s  # now the gradient of R
    w, x, y, z, length = _unit(quaternions, i)
    g = to_m
    of_w = TWO * (z * (g[1, 0] - g[0, 1]) + y * (g[0, 2] - g[2, 0]) + x * (g[2, 1] - g[1, 2]))
    of_x = TWO * (y * (g[0, 1] + g[1, 0]) + z * (g[0, 2] + g[2, 0]) + w * (g[2, 1] - g[1, 2]))
    of_y = TWO * (x * (g[0, 1] + g[1, 0]) + z * (g[1, 2] + g[2, 1]) + w * (g[0, 2] - g[2, 0]))
    of_z = TWO * (x * (g[0, 2] + g[2, 0]) + y * (g[1, 2] + g[2, 1]) + w * (g[1, 0] - g[0, 1]))
    of_x -= TWO * TWO * x * (g[1, 1] + g[2, 2])
    of_y -= TWO * TWO * y * (g[0, 0] + g[2, 2])
    of_z -= TWO * TWO * z * (g[0, 0] + g[1, 1])
    along = w * of_w + x * of_x + y * of_y + z * of_z  # the length of a quaternion has no effect
    to_quaternions[i, 0], to_quaternions[i, 1] = (of_w - w * along) / length, (of_x - x * along) / length
    to_quaternions[i, 2], to_quaternions[i, 3] = (of_y - y * along) / length, (of_z - z * along) / length


@njit
@no_type_check
def _local_back(x, y, z, rotation, lens, g, to_t, to_mean):
    # Rows of J are f / z (e - slope e_z): gradients of f / z, of the slope, and of the mean on the screen.
    fx, fy, slope_x, slope_y = lens[0], lens[1], x / z, y / z
    inside_x, inside_y = abs(slope_x) < lens[4], abs(slope_y) < lens[5]
    slope_x, slope_y = min(max(slope_x, -lens[4]), lens[4]), min(max(slope_y, -lens[5]), lens[5])
    of_fx = of_fy = of_slope_x = of_slope_y = ZERO
    for j in range(3):
        of_fx += to_t[0, j] * (rotation[0, j] - slope_x * rotation[2, j])
        of_fy += to_t[1, j] * (rotation[1, j] - slope_y * rotation[2, j])
        of_slope_x -= to_t[0, j] * rotation[2, j] * fx / z
        of_slope_y -= to_t[1, j] * rotation[2, j] * fy / z
    of_x = fx * g[MEAN_X] / z + (of_slope_x / z if inside_x else ZERO)
    of_y = fy * g[MEAN_Y] / z + (of_slope_y / z if inside_y else ZERO)
    of_z = -(of_x * x + of_y * y) / z - (of_fx * fx + of_fy * fy) / (z * z)
    for j in range(3):
        to_mean[j] = rotation[0, j] * of_x + rotation[1, j] * of_y + rotation[2, j] * of_z


@njit
@no_type_check
def _harmonics(means, i, eye, count, basis):
    # As in `SphericalHarmonicsEncoder`, if there are `count` besides the first.
    x, y, z = means[i, 0] - eye[0], means[i, 1] - eye[1], means[i, 2] - eye[2]
    length = math.sqrt(x * x + y * y + z * z)
    x, y, z = x / length, y / length, z / length
    if count > 0:
        basis[1], basis[2], basis[3] = -Y1 * y, Y1 * z, -Y1 * x
    if count > 3:
        basis[4], basis[5], basis[7] = Y2[0] * x * y, -Y2[0] * y * z, -Y2[0] * x * z
        basis[6], basis[8] = Y2[1] * (np.float32(3.0) * z * z - ONE), Y2[2] * (x * x - y * y)
    if count > 8:
        xx, yy, zz, three, five = x * x, y * y, z * z, np.float32(3.0), np.float32(5.0)
        basis[9], basis[10], basis[11] = (
            -Y3[0] * y * (three * xx - yy),
            Y3[1] * x * y * z,
            -Y3[2] * y * (five * zz - ONE),
        )
        basis[12], basis[13] = Y3[3] * z * (five * zz - three), -Y3[2] * x * (five * zz - ONE)
        basis[14], basis[15] = Y3[4] * z * (xx - yy), -Y3[0] * x * (xx - three * yy)


def trial() -> None:
    """Compile the kernels for splats of every degree; errors of the compiler propagate."""
    from nerf_lightning.extensions.splats.rasterizer import try_kernels

    try_kernels()

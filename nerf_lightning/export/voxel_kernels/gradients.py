"""How far what rays meet is from what they should, and which bytes of a baked field would bring it nearer."""

from typing import no_type_check

import numpy as np
from jaxtyping import Float
from numba import njit
from numpy import ndarray

from nerf_lightning.export.voxel_kernels.bounded import MOST_SAMPLES, ONE, SAMPLE, _corner, color_at, walk
from nerf_lightning.export.voxel_kernels.contracted import walk as walk_outside
from nerf_lightning.export.voxel_kernels.layout import TILE, VoxelBlocks, Wanted
from nerf_lightning.nerf.kernels.threads import in_parallel

ZERO = np.float32(0.0)


def gradients(
    blocks: VoxelBlocks, wanted: Wanted, least_met: float, gradient: Float[ndarray, "2 rows channels_and_1"]
) -> float:
    """Add, for each value, the derivative of half the squared errors by its bytes: of density, and of each channel.

    Args:
        blocks: the field.
        wanted: rays and their colors.
        least_met: what rays miss is as what they meet if they meet so much at least; 0: it is the background.
        gradient: of one half of the rays, and of the other: always two, so that sums do not depend on threads.

    Returns:
        The sum of the squared errors.
    """
    middle = len(wanted.origins) // 2

    def part(number: int) -> float:
        rays = slice(0, middle) if number == 0 else slice(middle, None)
        arrays = (wanted.origins, wanted.directions, wanted.looks, wanted.lengths, wanted.rgb, wanted.behind)
        field = (blocks.index, blocks.density, blocks.colors, blocks.owner, blocks.scale, np.float32(blocks.step))
        given = (*field, blocks.outside, np.float32(least_met))
        return float(_gradients(*(each[rays] for each in arrays), *given, gradient[number]))

    return sum(in_parallel(part, [0, 1]))


@njit(nogil=True, cache=True)
@no_type_check
def _gradients(
    origins, directions, looks, lengths, wanted, behind, index, density, colors, owner, scale, step, outside, least_met,
    gradient,
):  # fmt: skip
    samples, rgb = np.empty((MOST_SAMPLES, SAMPLE), np.float32), np.empty((MOST_SAMPLES, 3), np.float32)
    mixed, steepness = np.empty(colors.shape[-1], np.float32), np.empty(colors.shape[-1] + 1, np.float32)
    error, squared = np.empty(4, np.float32), 0.0
    for ray in range(len(origins)):
        origin, along, look = origins[ray], directions[ray], looks[ray]
        if outside:
            count, _ = walk_outside(origin, along, index, density, scale, step, lengths[ray], samples)
        else:
            count, _ = walk(origin, along, index, density, scale, step, lengths[ray], samples)
        for n in range(count):
            tile, x, y, z = int(samples[n, 0]), samples[n, 1], samples[n, 2], samples[n, 3]
            color_at(colors[tile], x, y, z, look, scale, mixed, rgb[n])
        by_opacity = _error(samples[:count], rgb, wanted[ray], behind[ray], least_met, error)
        squared += error[3]
        later = ZERO
        for n in range(count - 1, -1, -1):
            sample = samples[n]
            weight, alpha = sample[4], sample[5]
            gain = by_opacity + _steepness(rgb[n], weight, error, look, scale, steepness)
            # More opacity here is less light for all that lies behind.
            steepness[0] = (weight / alpha * gain * (ONE - alpha) - later) * sample[7]
            later += weight * gain
            _share_out(owner[int(sample[0])], sample[1], sample[2], sample[3], steepness, gradient)
    return squared


@njit
@no_type_check
def _error(samples, rgb, wanted, behind, least_met, error):
    # The derivatives by the sums of weights times colors, and of weights; half of whose squares' sum is what counts.
    error[:] = ZERO
    opacity, by_opacity = ZERO, ZERO
    for n in range(len(samples)):
        opacity += samples[n, 4]
        for channel in range(3):
            error[channel] += samples[n, 4] * min(max(rgb[n, channel], ZERO), ONE)
    closed = least_met > 0
    met = max(opacity, least_met) if closed else ONE
    for channel in range(3):
        found = error[channel] / met
        missing = (ONE - opacity) * behind[channel] if not closed else ZERO
        apart = found + missing - wanted[channel]
        error[3] += apart * apart
        error[channel] = apart / met
        if not closed:
            by_opacity -= apart * behind[channel]
        elif opacity > least_met:
            by_opacity -= error[channel] * found
    return by_opacity


@njit
@no_type_check
def _steepness(rgb, weight, error, look, scale, steepness):
    # The derivatives by the bytes of color; returned is that by the weight.
    gain = ZERO
    for channel in range(3):
        value, slope = rgb[channel], weight * error[channel]
        gain += error[channel] * min(max(value, ZERO), ONE)
        # A color beyond what can be shown may come back.
        if (value < ZERO and slope > ZERO) or (value > ONE and slope < ZERO):
            slope = ZERO
        steepness[1 + channel] = slope / np.float32(255.0)
        for term in range(1, len(look)):
            factor = look[term] * (scale[2] if term < 4 else scale[3]) / np.float32(127.0)
            steepness[1 + 3 * term + channel] = factor * slope
    return gain


@njit
@no_type_check
def _share_out(owner, x, y, z, steepness, gradient):
    (i, u), (j, v), (k, w) = _corner(x), _corner(y), _corner(z)
    for corner in range(8):
        a, b, c = corner >> 2, (corner >> 1) & 1, corner & 1
        row = owner[i + a, j + b, k + c]
        if row >= 0:
            share = (u if a else ONE - u) * (v if b else ONE - v) * (w if c else ONE - w)
            for channel in range(len(steepness)):
                gradient[row, channel] += share * steepness[channel]


def trial() -> None:
    """Run the kernel once on next to nothing; it raises whatever its compiler raises."""
    tile = np.ones((1, TILE, TILE, TILE), np.uint8)
    index, owner = np.zeros((1, 1, 1), np.int32), np.zeros(tile.shape, np.int32)
    blocks = VoxelBlocks(index, tile, tile[..., None].repeat(3, -1), owner, np.ones(4, np.float32), 1.0, False)
    three, one = np.ones((2, 3), np.float32), np.ones(2, np.float32)
    gradients(blocks, Wanted(three, three, one[:, None], one, three, three), 0.0, np.zeros((2, 1, 4), np.float32))

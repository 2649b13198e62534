"""Light through a grid of densities, for the CPU: which cameras see a voxel, and what a baked field looks like.

Places are in voxels: the value numbered (i, j, k) stands at (i, j, k). Densities are optical depths per voxel.
"""

from typing import no_type_check

import numpy as np
from jaxtyping import Float, Int, UInt8
from numba import njit
from numpy import ndarray

from nerf_lightning.export.voxel_kernels.layout import SIDE, TILE, any_in_blocks
from nerf_lightning.nerf.kernels.threads import over_rows

OPAQUE_DEPTH = np.float32(6.0)  # A way as opaque as this lets nothing through.
LEAST_LIGHT = np.float32(0.005)  # A camera sees a voxel from which so much of its light arrives.
LEAST_ALPHA, LEAST_TRANSMITTANCE = np.float32(0.002), np.float32(0.004)
SAMPLE, MOST_SAMPLES = 8, 2760
"""Numbers of one; after so many of the least opacity no light is left: log(0.004) / log(1 - 0.002)."""
ONE, HALF, TINY, LOG_2 = np.float32(1.0), np.float32(0.5), np.float32(1e-9), np.float32(0.6931472)


def seeing_cameras(
    optical: Float[ndarray, "x y z"],
    voxels: Int[ndarray, "voxels 3"],
    places: Float[ndarray, "voxels 3"],
    eyes: Float[ndarray, "cameras 4"],
    views: Float[ndarray, "cameras 7"],
    sides: Float[ndarray, "3"],
    most: int,
    tries: int,
) -> tuple[Int[ndarray, "voxels most"], Float[ndarray, "voxels most"]]:
    """Return some of the cameras that see each voxel (-1: no more), and how much of its light arrives there.

    Args:
        optical: optical depth of each voxel.
        voxels: the numbers of those that are asked about.
        places: where they lie in the world.
        eyes: where the cameras are in the grid, homogeneous: the way there from p is xyz - w p.
        views: a camera's center and unit axis in the world, and the cosine of the widest angle that it sees.
        sides: of a voxel; optical depths are those of a way of 1.
        most: cameras for each voxel.
        tries: so many are asked, other ones for each voxel.
    """
    cameras = np.full((len(voxels), most), -1, np.int32)
    light = np.zeros((len(voxels), most), np.float32)
    filled = any_in_blocks(optical > 0, SIDE)
    over_rows(_seeing, len(voxels), optical, filled, voxels, places, eyes, views, sides, tries, cameras, light)
    return cameras, light


@njit(nogil=True, fastmath=True, cache=True)
@no_type_check
def _seeing(first, last, optical, filled, voxels, places, eyes, views, sides, tries, cameras, light):
    count, most = eyes.shape[0], cameras.shape[1]
    for voxel in range(first, last):
        found = 0
        # Neighbors begin with different cameras; the step is prime, so that all have their turn.
        start = (voxels[voxel, 0] * 73 + voxels[voxel, 1] * 179 + voxels[voxel, 2] * 283) % count
        for turn in range(min(tries, count)):
            camera = (start + turn * 7919) % count
            if not _in_view(places[voxel], views[camera]):
                continue
            arrives = _light(optical, filled, voxels[voxel], eyes[camera], sides)
            if arrives > LEAST_LIGHT:
                cameras[voxel, found], light[voxel, found] = camera, arrives
                found += 1
                if found == most:
                    break


@njit(fastmath=True)
@no_type_check
def _in_view(place, view):
    x, y, z = place[0] - view[0], place[1] - view[1], place[2] - view[2]
    along = x * view[3] + y * view[4] + z * view[5]
    return along >= view[6] * np.sqrt(x * x + y * y + z * z)


@njit(fastmath=True)
@no_type_check
def _light(optical, filled, voxel, eye, sides):
    x, y, z = np.float32(voxel[0]), np.float32(voxel[1]), np.float32(voxel[2])
    dx, dy, dz = eye[0] - eye[3] * x, eye[1] - eye[3] * y, eye[2] - eye[3] * z
    length = np.sqrt(dx * dx + dy * dy + dz * dz) + TINY
    dx, dy, dz = dx / length, dy / length, dz / length
    way = length / eye[3] if eye[3] > 0 else np.float32(1e9)
    depth, t = np.float32(0.0), ONE
    long = np.sqrt((dx * sides[0]) ** 2 + (dy * sides[1]) ** 2 + (dz * sides[2]) ** 2)
    while t < way and depth < OPAQUE_DEPTH:
        i, j, k = x + t * dx + HALF, y + t * dy + HALF, z + t * dz + HALF
        if not (0 <= i < optical.shape[0] and 0 <= j < optical.shape[1] and 0 <= k < optical.shape[2]):
            break
        if filled[int(i) // SIDE, int(j) // SIDE, int(k) // SIDE]:
            depth += long * optical[int(i), int(j), int(k)]
            t += ONE
        else:
            t += max(ONE, _way_out(i, j, k, dx, dy, dz))
    return np.exp(-depth)


@njit(fastmath=True)
@no_type_check
def _way_out(x, y, z, dx, dy, dz):
    # How far it is to the end of the block that a place lies in.
    return min(_ahead(x, dx), min(_ahead(y, dy), _ahead(z, dz)))


@njit(fastmath=True)
@no_type_check
def _ahead(at, speed):
    side = np.float32(SIDE)
    low = np.floor(at / side) * side
    if speed > TINY:
        return (low + side - at) / speed
    if speed < -TINY:
        return (low - at) / speed
    return np.float32(1e9)


def march_tiles(
    origins: Float[ndarray, "rays 3"],
    directions: Float[ndarray, "rays 3"],
    looks: Float[ndarray, "rays basis"],
    index: Int[ndarray, "x y z"],
    density: UInt8[ndarray, "blocks 9 9 9"],
    colors: UInt8[ndarray, "blocks 9 9 9 channels"],
    scale: Float[ndarray, "numbers"],
    step: float,
    lengths: Float[ndarray, "rays"],
) -> Float[ndarray, "rays 7"]:
    """Return color (3), opacity, and expected distance of the stopped light times it; samples of density, of color.

    Args:
        origins: in voxels.
        directions: unit, in voxels.
        looks: spherical harmonics of the direction in the world.
        index: the number of each block's tile, -1 where it is empty.
        density: bytes.
        colors: bytes, three for each harmonic.
        scale: the exponents of density 0 and of one more, and the half range of each degree's coefficients.
        step: voxels between samples.
        lengths: how long a way of one voxel is along each ray; densities are optical depths of a way of 1.
    """
    out = np.zeros((len(origins), 7), np.float32)
    arrays = (origins, directions, looks, index, density, colors, scale, np.float32(step), lengths, out)
    over_rows(_march, len(origins), *arrays)
    return out


@njit(nogil=True, cache=True)
@no_type_check
def _march(first, last, origins, directions, looks, index, density, colors, scale, step, lengths, out):
    samples = np.empty((MOST_SAMPLES, SAMPLE), np.float32)
    for ray in range(first, last):
        given = (index, density, scale, step, lengths[ray])
        count, asked = walk(origins[ray], directions[ray], *given, samples)
        look_at(samples[:count], looks[ray], colors, scale, out[ray])
        out[ray, 5] = asked


@njit
@no_type_check
def walk(origin, along, index, density, scale, step, length, samples):
    """Note where a ray's light is stopped, and return at how many places of how many that were asked.

    A sample is a tile, a place in it (3), its share of the light, its opacity, its distance, and by how much its
    optical depth changes when its byte does.
    """
    nothing, doubling = np.exp2(scale[0]), LOG_2 * scale[1]
    enter, leave = np.float32(0.0), np.float32(1e9)
    for axis in range(3):
        speed = along[axis] if abs(along[axis]) > TINY else TINY
        a, b = -origin[axis] / speed, (np.float32(index.shape[axis] * SIDE) - origin[axis]) / speed
        enter, leave = max(enter, min(a, b)), min(leave, max(a, b))
    number, through, count, asked = 0, ONE, 0, 0
    while through > LEAST_TRANSMITTANCE:
        t = enter + (number + HALF) * step
        if t >= leave:
            break
        x, y, z = origin[0] + t * along[0], origin[1] + t * along[1], origin[2] + t * along[2]
        i, j, k = int(x) // SIDE, int(y) // SIDE, int(z) // SIDE
        i, j, k = min(i, index.shape[0] - 1), min(j, index.shape[1] - 1), min(k, index.shape[2] - 1)
        tile = index[i, j, k]
        if tile < 0:
            beyond = t + _way_out(x, y, z, along[0], along[1], along[2])
            number = max(number + 1, int(np.ceil((beyond - enter) / step - HALF)))
            continue
        number, asked = number + 1, asked + 1
        x, y, z = x - i * SIDE, y - j * SIDE, z - k * SIDE
        value = _between(density[tile], x, y, z)
        deep = np.exp2(scale[0] + scale[1] * value)
        alpha = ONE - np.exp(-(deep - nothing) * step * length)
        if alpha < LEAST_ALPHA:
            continue
        note(samples[count], tile, x, y, z, through * alpha, alpha, t, deep * doubling * step * length)
        count += 1
        through *= ONE - alpha
    return count, asked


@njit
@no_type_check
def note(sample, tile, x, y, z, weight, alpha, t, rate):
    """Write a sample down."""
    sample[0], sample[1], sample[2], sample[3] = tile, x, y, z
    sample[4], sample[5], sample[6], sample[7] = weight, alpha, t, rate


@njit
@no_type_check
def look_at(samples, look, colors, scale, result):
    """Add up the colors, opacity and distance of a ray's samples."""
    rgb, mixed = np.empty(3, np.float32), np.empty(colors.shape[-1], np.float32)
    for sample in samples:
        weight = sample[4]
        color_at(colors[int(sample[0])], sample[1], sample[2], sample[3], look, scale, mixed, rgb)
        for channel in range(3):
            result[channel] += weight * min(max(rgb[channel], np.float32(0.0)), ONE)
        result[3] += weight
        result[4] += weight * sample[6]
    result[6] = len(samples)


@njit
@no_type_check
def _corner(at):
    low = min(int(at), SIDE - 1)
    return low, np.float32(at - low)


@njit
@no_type_check
def _between(tile, x, y, z):
    (i, u), (j, v), (k, w) = _corner(x), _corner(y), _corner(z)
    value = np.float32(0.0)
    for corner in range(8):
        a, b, c = corner >> 2, (corner >> 1) & 1, corner & 1
        share = (u if a else ONE - u) * (v if b else ONE - v) * (w if c else ONE - w)
        value += share * tile[i + a, j + b, k + c]
    return value


@njit
@no_type_check
def color_at(tile, x, y, z, look, scale, mixed, rgb):
    """Mix the bytes of the eight values around a place, and find their color; it may lie beyond 0 to 1."""
    (i, u), (j, v), (k, w) = _corner(x), _corner(y), _corner(z)
    mixed[:] = np.float32(0.0)
    for corner in range(8):
        a, b, c = corner >> 2, (corner >> 1) & 1, corner & 1
        share = (u if a else ONE - u) * (v if b else ONE - v) * (w if c else ONE - w)
        values = tile[i + a, j + b, k + c]
        for channel in range(len(mixed)):
            mixed[channel] += share * values[channel]
    for channel in range(3):
        rgb[channel] = mixed[channel] / np.float32(255.0)
    for term in range(1, len(look)):
        factor = look[term] * (scale[2] if term < 4 else scale[3]) / np.float32(127.0)
        for channel in range(3):
            rgb[channel] += factor * (mixed[3 * term + channel] - np.float32(128.0))


def trial() -> None:
    """Run every kernel once on next to nothing; it raises whatever their compiler raises."""
    one = np.ones((1, 3), np.float32)
    optical = np.ones((SIDE,) * 3, np.float32)
    eyes, views = np.ones((1, 4), np.float32), np.ones((1, 7), np.float32)
    seeing_cameras(optical, one.astype(np.int32), one, eyes, views, one[0], 1, 1)
    tile = np.ones((1, TILE, TILE, TILE), np.uint8)
    looks, index = np.ones((1, 1), np.float32), np.zeros((1, 1, 1), np.int32)
    march_tiles(one, one, looks, index, tile, tile[..., None].repeat(3, -1), np.ones(4, np.float32), 1.0, one[0, :1])

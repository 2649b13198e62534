"""The kernels of `bounded` for all of space: rays are straight in each part of a contracted cube.

Space is measured in halves of the inner cube's side, from its middle: u. Its contraction keeps the inner cube, and
brings what lies beyond each of its faces into a box on that face: with r = max |u|, p = u / r, but for the largest
coordinate, which becomes its sign times 2 - 1 / r (Eq. 4, arXiv 2302.12249). A straight ray stays one within each box.
The grid's value numbered (i, j, k) stands at p = spacing (i, j, k) - 2; its optical depths are along rays that go
straight out, where a voxel is spacing r^2 long.
"""

from typing import no_type_check

import numpy as np
from jaxtyping import Bool, Float, Int, UInt8
from numba import njit
from numpy import ndarray

from nerf_lightning.export.voxel_kernels.bounded import (
    HALF,
    LEAST_ALPHA,
    LEAST_LIGHT,
    LEAST_TRANSMITTANCE,
    LOG_2,
    MOST_SAMPLES,
    ONE,
    OPAQUE_DEPTH,
    SAMPLE,
    _between,
    _in_view,
    _way_out,
    look_at,
    note,
)
from nerf_lightning.export.voxel_kernels.layout import SIDE, TILE, any_in_blocks
from nerf_lightning.nerf.kernels.threads import in_parallel, over_rows

MOST_STEPS = 4096
FARTHEST = np.float32(1e4)  # Halves of the inner cube: beyond, places in the grid are no longer told apart.
INTO_NEXT = np.float32(0.01)  # Voxels beyond the end of an empty block, so that the next one is found.
LEAST_STOPPED = np.float32(1e-4)  # Less of a ray's light is not worth noting.
TWO, NEVER = np.float32(2.0), np.float32(-1.0)


def seeing_cameras(
    optical: Float[ndarray, "x y z"],
    voxels: Int[ndarray, "voxels 3"],
    places: Float[ndarray, "voxels 3"],
    units: Float[ndarray, "voxels 3"],
    eyes: Float[ndarray, "cameras 3"],
    views: Float[ndarray, "cameras 7"],
    near: float,
    most: int,
    tries: int,
) -> tuple[Int[ndarray, "voxels most"], Float[ndarray, "voxels most"]]:
    """Return what `bounded.seeing_cameras` does; `places` are in the world, `units` and `eyes` in u.

    Nothing is as close to a camera as `near`, in u.
    """
    cameras = np.full((len(voxels), most), -1, np.int32)
    light = np.zeros((len(voxels), most), np.float32)
    filled = any_in_blocks(optical > 0, SIDE)
    given = (optical, filled, voxels, places, units, eyes, views, np.float32(near), tries, cameras, light)
    over_rows(_seeing, len(voxels), *given)
    return cameras, light


@njit(nogil=True, fastmath=True, cache=True)
@no_type_check
def _seeing(first, last, optical, filled, voxels, places, units, eyes, views, near, tries, cameras, light):
    count, most = eyes.shape[0], cameras.shape[1]
    for voxel in range(first, last):
        found = 0
        # As in `bounded`: neighbors begin with different cameras.
        start = (voxels[voxel, 0] * 73 + voxels[voxel, 1] * 179 + voxels[voxel, 2] * 283) % count
        for turn in range(min(tries, count)):
            camera = (start + turn * 7919) % count
            if not _in_view(places[voxel], views[camera]):
                continue
            arrives = _light(optical, filled, units[voxel], eyes[camera], near)
            if arrives > LEAST_LIGHT:
                cameras[voxel, found], light[voxel, found] = camera, arrives
                found += 1
                if found == most:
                    break


@njit(fastmath=True)
@no_type_check
def _light(optical, filled, at, eye, near):
    spacing = np.float32(4.0 / optical.shape[0])
    dx, dy, dz = eye[0] - at[0], eye[1] - at[1], eye[2] - at[2]
    way = np.sqrt(dx * dx + dy * dy + dz * dz) + np.float32(1e-9)
    dx, dy, dz = dx / way, dy / way, dz / way
    depth, t, first = np.float32(0.0), np.float32(0.0), True
    while t < way - near and depth < OPAQUE_DEPTH:
        x, y, z, gx, gy, gz, r, v = _contracted(at[0] + t * dx, at[1] + t * dy, at[2] + t * dz, dx, dy, dz)
        speed = np.sqrt(gx * gx + gy * gy + gz * gz)
        step = _ahead(spacing, speed, r, v)
        if first:  # its own light is not stopped by itself
            t, first = t + step, False
            continue
        i, j, k = (x + TWO) / spacing + HALF, (y + TWO) / spacing + HALF, (z + TWO) / spacing + HALF
        a, b, c = _within(i, optical.shape[0]), _within(j, optical.shape[1]), _within(k, optical.shape[2])
        if filled[a // SIDE, b // SIDE, c // SIDE]:
            depth += optical[a, b, c] * step / (spacing * r * r)
        else:
            way_out = _way_out(i, j, k, gx / speed, gy / speed, gz / speed) + INTO_NEXT
            step = _ahead(max(ONE, way_out) * spacing, speed, r, v)
        if step < 0:
            break
        t += step
    return np.exp(-depth)


def stopped_light(
    optical: Float[ndarray, "x y z"],
    origins: Float[ndarray, "rays 3"],
    directions: Float[ndarray, "rays 3"],
    near: float,
    step: float,
) -> Float[ndarray, "x y z"]:
    """Return how much of the light of rays is stopped at each value, shared out among the eight around a sample.

    Rays have unit directions and begin at `near`; it and `origins` are in u, and `step` voxels lie between samples.
    """
    filled = any_in_blocks(_with_border(optical > 0), SIDE)
    given = (np.float32(near), np.float32(step))

    def part(rays: slice) -> Float[ndarray, "x y z"]:
        stopped = np.zeros(optical.shape, np.float32)
        _stop(origins[rays], directions[rays], optical, filled, *given, stopped)
        return stopped

    # Always two, however many threads there are: sums of other parts would be others in their last digits.
    middle = len(origins) // 2
    one, other = in_parallel(part, [slice(0, middle), slice(middle, None)])
    return one + other


def _with_border(mask: Bool[ndarray, "x y z"]) -> Bool[ndarray, "x y z"]:
    # A place whose upper neighbors hold something does so too.
    grown = mask.copy()
    for axis in range(3):
        np.moveaxis(grown, axis, 0)[:-1] |= np.moveaxis(grown.copy(), axis, 0)[1:]
    return grown


@njit(nogil=True, fastmath=True, cache=True)
@no_type_check
def _stop(origins, directions, optical, filled, near, step, stopped):
    size = optical.shape[0]
    spacing = np.float32(4.0 / size)
    for ray in range(len(origins)):
        (ox, oy, oz), (dx, dy, dz) = origins[ray], directions[ray]
        t, through = near, ONE
        for _ in range(MOST_STEPS):
            if through <= LEAST_TRANSMITTANCE:
                break
            x, y, z, gx, gy, gz, r, v = _contracted(ox + t * dx, oy + t * dy, oz + t * dz, dx, dy, dz)
            if r > FARTHEST:
                break
            speed = np.sqrt(gx * gx + gy * gy + gz * gz)
            x, y, z = (x + TWO) / spacing, (y + TWO) / spacing, (z + TWO) / spacing
            i, j, k = min(int(x), size - 2), min(int(y), size - 2), min(int(z), size - 2)
            full = filled[i // SIDE, j // SIDE, k // SIDE]
            out = np.float32(0.0) if full else _way_out(x, y, z, gx / speed, gy / speed, gz / speed)
            way = _ahead((step if full else max(out, np.float32(0.0)) + INTO_NEXT) * spacing, speed, r, v)
            if way < 0:
                break
            t += way
            if not full:
                continue
            u, w, q = min(x - i, ONE), min(y - j, ONE), min(z - k, ONE)
            depth = np.float32(0.0)
            for corner in range(8):
                a, b, c = corner >> 2, (corner >> 1) & 1, corner & 1
                share = (u if a else ONE - u) * (w if b else ONE - w) * (q if c else ONE - q)
                depth += share * optical[i + a, j + b, k + c]
            weight = through * (ONE - np.exp(-depth * way / (spacing * r * r)))
            if weight < LEAST_STOPPED:
                continue
            through -= weight
            for corner in range(8):
                a, b, c = corner >> 2, (corner >> 1) & 1, corner & 1
                share = (u if a else ONE - u) * (w if b else ONE - w) * (q if c else ONE - q)
                stopped[i + a, j + b, k + c] += share * weight


@njit
@no_type_check
def _within(at, size):
    return min(max(int(at), 0), size - 1)


@njit
@no_type_check
def _contracted(x, y, z, dx, dy, dz):
    # Where a place of u lies, how it moves there per unit of the ray, its r, and how r grows.
    ax, ay, az = abs(x), abs(y), abs(z)
    r = max(ax, max(ay, az))
    if r <= ONE:
        return x, y, z, dx, dy, dz, ONE, np.float32(0.0)
    f = ONE / r
    v = (dx * x if ax == r else (dy * y if ay == r else dz * z)) * f
    px, py, pz = x * f, y * f, z * f
    gx, gy, gz = (dx - px * v) * f, (dy - py * v) * f, (dz - pz * v) * f
    if ax == r:
        px, gx = px * (TWO - f), dx * f * f
    elif ay == r:
        py, gy = py * (TWO - f), dy * f * f
    else:
        pz, gz = pz * (TWO - f), dz * f * f
    return px, py, pz, gx, gy, gz, r, v


@njit
@no_type_check
def _ahead(distance, speed, r, v):
    # How far a ray goes while its place in the contracted cube moves by a distance; never: it ends before.
    left = speed * r - distance * v
    return distance * r / left if left > np.float32(1e-9) else NEVER


def march_tiles(
    origins: Float[ndarray, "rays 3"],
    directions: Float[ndarray, "rays 3"],
    looks: Float[ndarray, "rays basis"],
    index: Int[ndarray, "x y z"],
    density: UInt8[ndarray, "blocks 9 9 9"],
    colors: UInt8[ndarray, "blocks 9 9 9 channels"],
    scale: Float[ndarray, "numbers"],
    step: float,
    near: float,
) -> Float[ndarray, "rays 7"]:
    """Return what `bounded.march_tiles` does; origins, distances, and `near`, where rays begin, are in u."""
    out = np.zeros((len(origins), 7), np.float32)
    arrays = (origins, directions, looks, index, density, colors, scale, np.float32(step), np.float32(near), out)
    over_rows(_march, len(origins), *arrays)
    return out


@njit(nogil=True, cache=True)
@no_type_check
def _march(first, last, origins, directions, looks, index, density, colors, scale, step, near, out):
    samples = np.empty((MOST_SAMPLES, SAMPLE), np.float32)
    for ray in range(first, last):
        count, asked = walk(origins[ray], directions[ray], index, density, scale, step, near, samples)
        look_at(samples[:count], looks[ray], colors, scale, out[ray])
        out[ray, 5] = asked


@njit
@no_type_check
def walk(origin, along, index, density, scale, step, near, samples):
    """Note where a ray's light is stopped, as that of `bounded` does."""
    spacing = np.float32(4.0 / (index.shape[0] * SIDE))
    nothing, doubling = np.exp2(scale[0]), LOG_2 * scale[1]
    (ox, oy, oz), (dx, dy, dz) = origin, along
    t, through, count, asked = near, ONE, 0, 0
    for _ in range(MOST_STEPS):
        if through <= LEAST_TRANSMITTANCE:
            break
        x, y, z, gx, gy, gz, r, v = _contracted(ox + t * dx, oy + t * dy, oz + t * dz, dx, dy, dz)
        if r > FARTHEST:
            break
        speed = np.sqrt(gx * gx + gy * gy + gz * gz)
        gx, gy, gz = gx / speed, gy / speed, gz / speed
        x, y, z = (x + TWO) / spacing, (y + TWO) / spacing, (z + TWO) / spacing
        i, j, k = int(x) // SIDE, int(y) // SIDE, int(z) // SIDE
        i, j, k = min(i, index.shape[0] - 1), min(j, index.shape[1] - 1), min(k, index.shape[2] - 1)
        tile = index[i, j, k]
        voxels = step if tile >= 0 else max(_way_out(x, y, z, gx, gy, gz), np.float32(0.0)) + INTO_NEXT
        way = _ahead(voxels * spacing, speed, r, v)
        if way < 0:
            break
        if tile >= 0:
            x, y, z = x + HALF * step * gx, y + HALF * step * gy, z + HALF * step * gz
            outward = max(abs(x * spacing - TWO), max(abs(y * spacing - TWO), abs(z * spacing - TWO)))
            shrunk = min(ONE, TWO - outward)
            x, y, z = _in_tile(x - i * SIDE), _in_tile(y - j * SIDE), _in_tile(z - k * SIDE)
            value = _between(density[tile], x, y, z)
            asked += 1
            share = way * shrunk * shrunk / spacing
            deep = np.exp2(scale[0] + scale[1] * value)
            alpha = ONE - np.exp(-(deep - nothing) * share)
            if alpha >= LEAST_ALPHA:
                note(samples[count], tile, x, y, z, through * alpha, alpha, t + HALF * way, deep * doubling * share)
                count += 1
                through *= ONE - alpha
        t += way
    return count, asked


@njit
@no_type_check
def _in_tile(at):
    return min(max(at, np.float32(0.0)), np.float32(SIDE))


def trial() -> None:
    """Run every kernel once on next to nothing; it raises whatever their compiler raises."""
    one = np.ones((1, 3), np.float32)
    optical = np.ones((SIDE,) * 3, np.float32)
    seeing_cameras(optical, one.astype(np.int32), one, one, 2 * one, np.ones((1, 7), np.float32), 0.1, 1, 1)
    stopped_light(optical, one, one, 0.1, 1.0)
    tile = np.ones((1, TILE, TILE, TILE), np.uint8)
    looks, index = np.ones((1, 1), np.float32), np.zeros((1, 1, 1), np.int32)
    march_tiles(one, one, looks, index, tile, tile[..., None].repeat(3, -1), np.ones(4, np.float32), 1.0, 0.1)

"""Closed forms of convex solids centered at the origin of their own frame: ray intervals, distances and normals.

A ray is inside a convex solid between two distances, so every solid here is an intersection of intervals. All
functions broadcast: axis 0 of `origin`, `direction` (of unit length) and `point` is x, y, z; axis 0 of `size` is the
solid's parameters.

| solid    | size                                                                        |
|----------|-----------------------------------------------------------------------------|
| box      | half extents x, y, z                                                        |
| wedge    | half extents x, y, z, then a cut: keep a x + c z <= w, with a, c of unit length |
| cylinder | radius, half length along z (with caps)                                     |
| ball     | radius                                                                      |
"""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from jaxtyping import Float
from numpy import ndarray

TINY = 1e-12
"""Replaces a zero component of a direction, so that a slab's distances are huge instead of undefined."""

Vectors = Float[ndarray, "3 ..."]
Numbers = Float[ndarray, "..."]
Sizes = Float[ndarray, "numbers ..."]
Interval = tuple[Numbers, Numbers]


class Solid(NamedTuple):
    """The functions that the tracer needs for a kind of solid."""

    interval: Callable[[Vectors, Vectors, Sizes], Interval]
    """(origin, direction, size) -> distances of entry and exit; a miss has entry > exit."""
    distance: Callable[[Vectors, Sizes], Numbers]
    """(point, size) -> signed distance, negative inside; a wedge's is a lower bound."""
    normal: Callable[[Vectors, Sizes], Vectors]
    """(point, size) -> outward unit normal at a point on the surface."""
    extent: Callable[[Sizes], Vectors]
    """(size) -> half extents of the bounding box."""


def _nonzero(values: Numbers) -> Numbers:
    return np.where(np.abs(values) < TINY, values.dtype.type(TINY), values)


def _slab_interval(origin: Numbers, direction: Numbers, half: Numbers) -> Interval:
    """Return the interval in which a line is within `half` of 0 along one axis (Kay and Kajiya, SIGGRAPH 1986).

    If the line is parallel to the slab, its ends are huge: of the same sign outside the slab, of opposite signs inside.
    """
    inverse = 1 / _nonzero(direction)
    middle, reach = -origin * inverse, half * np.abs(inverse)
    return middle - reach, middle + reach


def _box_interval(origin: Vectors, direction: Vectors, size: Sizes) -> Interval:
    entry, exit = _slab_interval(origin[0], direction[0], size[0])
    for axis in (1, 2):
        low, high = _slab_interval(origin[axis], direction[axis], size[axis])
        entry, exit = np.maximum(entry, low), np.minimum(exit, high)
    return entry, exit


def _wedge_interval(origin: Vectors, direction: Vectors, size: Sizes) -> Interval:
    entry, exit = _box_interval(origin, direction, size)
    along, cut_x, cut_z = size[5], size[3], size[4]
    slope = _nonzero(cut_x * direction[0] + cut_z * direction[2])
    plane = (along - cut_x * origin[0] - cut_z * origin[2]) / slope
    inwards = slope < 0
    return np.where(inwards, np.maximum(entry, plane), entry), np.where(inwards, exit, np.minimum(exit, plane))


def _cylinder_interval(origin: Vectors, direction: Vectors, size: Sizes) -> Interval:
    # The discriminant is written as (a r^2 - (o x d)^2): b^2 - a c loses its digits for a small cylinder far away.
    square = np.maximum(direction[0] ** 2 + direction[1] ** 2, TINY)
    closest = -(origin[0] * direction[0] + origin[1] * direction[1]) / square
    moment = origin[0] * direction[1] - origin[1] * direction[0]
    under = square * size[0] ** 2 - moment**2
    half = np.sqrt(np.maximum(under, 0)) / square
    low, high = _slab_interval(origin[2], direction[2], size[1])
    return np.maximum(np.where(under > 0, closest - half, np.inf), low), np.minimum(closest + half, high)


def _ball_interval(origin: Vectors, direction: Vectors, size: Sizes) -> Interval:
    closest = -(origin[0] * direction[0] + origin[1] * direction[1] + origin[2] * direction[2])
    miss = sum((origin[i] + closest * direction[i]) ** 2 for i in range(3))
    under = size[0] ** 2 - miss
    half = np.sqrt(np.maximum(under, 0))
    return np.where(under > 0, closest - half, np.inf), closest + half


def _box_distance(point: Vectors, size: Sizes) -> Numbers:
    x, y, z = (np.abs(point[i]) - size[i] for i in range(3))
    outside = np.sqrt(np.maximum(x, 0) ** 2 + np.maximum(y, 0) ** 2 + np.maximum(z, 0) ** 2)
    return outside + np.minimum(np.maximum(np.maximum(x, y), z), 0)


def _wedge_distance(point: Vectors, size: Sizes) -> Numbers:
    return np.maximum(_box_distance(point, size), size[3] * point[0] + size[4] * point[2] - size[5])


def _cylinder_distance(point: Vectors, size: Sizes) -> Numbers:
    around = np.sqrt(point[0] ** 2 + point[1] ** 2) - size[0]
    along = np.abs(point[2]) - size[1]
    outside = np.sqrt(np.maximum(around, 0) ** 2 + np.maximum(along, 0) ** 2)
    return outside + np.minimum(np.maximum(around, along), 0)


def _ball_distance(point: Vectors, size: Sizes) -> Numbers:
    return np.sqrt(point[0] ** 2 + point[1] ** 2 + point[2] ** 2) - size[0]


def _box_normal(point: Vectors, size: Sizes) -> Vectors:
    face = np.argmax(np.abs(point) - size[:3], axis=0)
    picked = np.arange(3).reshape(3, *[1] * face.ndim) == face
    return np.where(picked, np.copysign(1, point), 0).astype(point.dtype)


def _wedge_normal(point: Vectors, size: Sizes) -> Vectors:
    to_faces = np.max(np.abs(point) - size[:3], axis=0)
    to_cut = size[3] * point[0] + size[4] * point[2] - size[5]
    cut = np.stack([size[3], np.zeros_like(size[3]), size[4]])
    return np.where(to_cut > to_faces, cut, _box_normal(point, size))


def _cylinder_normal(point: Vectors, size: Sizes) -> Vectors:
    around = np.sqrt(point[0] ** 2 + point[1] ** 2)
    zero = np.zeros_like(around)
    side = np.stack([point[0], point[1], zero]) / np.maximum(around, TINY)
    cap = np.stack([zero, zero, np.copysign(1, point[2])])
    return np.where(around - size[0] > np.abs(point[2]) - size[1], side, cap)


def _ball_normal(point: Vectors, size: Sizes) -> Vectors:
    return point / np.sqrt(np.sum(point**2, axis=0))


BOX = Solid(_box_interval, _box_distance, _box_normal, lambda size: size[:3])
WEDGE = Solid(_wedge_interval, _wedge_distance, _wedge_normal, lambda size: size[:3])
CYLINDER = Solid(_cylinder_interval, _cylinder_distance, _cylinder_normal, lambda size: size[[0, 0, 1]])
BALL = Solid(_ball_interval, _ball_distance, _ball_normal, lambda size: size[[0, 0, 0]])

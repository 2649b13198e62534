"""What of the light reaches a point: shadows of the key light, and the openness of the surroundings.

Both are exact whatever the culling: points are sorted into cells, and a cell asks only the parts that can matter.
"""

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int
from numpy import ndarray

from nerf_lightning.data.bricks.parts import Triple
from nerf_lightning.data.bricks.solids import Solids


@dataclass(frozen=True)
class Light:
    """What shines on a model. Colours are linear."""

    key: Float[ndarray, "3"]
    """Towards the middle of the key light, in world axes; unit length."""
    key_color: Triple
    fill_color: Triple
    """Of the fill light, which casts no shadow."""
    sky_light: Triple
    """What an upward surface receives from the surroundings."""
    ground_light: Triple
    """What a downward surface receives."""


DAY = Light(
    key=np.array([0.42, -0.55, 0.72]) / np.linalg.norm([0.42, -0.55, 0.72]),
    key_color=(0.98, 0.92, 0.82),
    fill_color=(0.20, 0.23, 0.30),
    sky_light=(0.44, 0.47, 0.52),
    ground_light=(0.20, 0.18, 0.17),
)
SPREAD = 0.09
"""Tangent of the key light's angular radius: large enough for soft edges."""
SIDES = 4
"""The key light is a disc of SIDES^2 directions, one for each ray through a pixel."""
PROBES = (0.025, 0.05, 0.1, 0.18)
"""Heights over the surface, in world units, at which the room to the next part is asked."""
LIFT = 1e-3
"""Shadow rays start this far above the surface."""
SHADOW_CELL, PROBE_CELL = 0.12, 0.24


def key_axes(light: Light) -> Float[ndarray, "3 3"]:
    """Return rows across, across and towards the key light."""
    across = np.cross([0.0, 0.0, 1.0], light.key)
    across /= np.linalg.norm(across)
    return np.stack([across, np.cross(light.key, across), light.key])


def key_directions(light: Light) -> Float[ndarray, "3 directions"]:
    """Return unit directions spread evenly over the light's disc (a spiral of equal areas)."""
    index = np.arange(SIDES**2)
    radius = SPREAD * np.sqrt((index + 0.5) / SIDES**2)
    angle = index * np.pi * (3 - np.sqrt(5))
    local = np.stack([radius * np.cos(angle), radius * np.sin(angle), np.ones(SIDES**2)])
    return key_axes(light).T @ (local / np.linalg.norm(local, axis=0))


def key_visible(
    solids: Solids,
    points: Float[ndarray, "3 points"],
    normals: Float[ndarray, "3 points"],
    rays: Int[ndarray, "points"],
    light: Light = DAY,
) -> Float[ndarray, "points"]:
    """Return 1 where the key light's direction number `rays` is free, 0 where it is blocked or behind."""
    directions = key_directions(light).astype(points.dtype)[:, rays]
    starts = points + points.dtype.type(LIFT) * normals
    visible = np.zeros_like(points[0])
    facing = np.flatnonzero(np.sum(directions * normals, axis=0) > 0)
    axes = key_axes(light)
    spans = solids.corners() @ axes.T
    low, high = spans.min(axis=1), spans.max(axis=1)
    seen = axes.astype(points.dtype) @ starts[:, facing]
    for members in cells(seen[:2], SHADOW_CELL):
        least, most = seen[:, members].min(axis=1), seen[:, members].max(axis=1)
        ahead = high[:, 2] - least[2]
        drift = SPREAD * np.maximum(ahead, 0)[:, None]
        near = (low[:, :2] - drift <= most[:2]) & (high[:, :2] + drift >= least[:2])
        chosen = facing[members]
        candidates = solids.only(near.all(axis=1) & (ahead >= 0))
        visible[chosen] = ~candidates.blocked(starts[:, chosen], directions[:, chosen])
    return visible


def openness(
    solids: Solids,
    points: Float[ndarray, "3 points"],
    normals: Float[ndarray, "3 points"],
    rays: Int[ndarray, "points"],
) -> Float[ndarray, "points"]:
    """Return the room above each point as a share of the height asked, in [0, 1]; small in corners and gaps.

    Each ray through a pixel asks at one height, so that the pixel's mean takes all of them.
    """
    step = rays % len(PROBES)
    heights = np.array(PROBES, points.dtype)[step]
    probes = points + heights * normals
    spans = solids.corners()
    low, high = spans.min(axis=1), spans.max(axis=1)
    room = np.ones_like(heights)
    for members in cells(np.concatenate([probes, PROBE_CELL * (step[None] + 0.5)]), PROBE_CELL):
        reach = float(heights[members].max())
        least, most = probes[:, members].min(axis=1) - reach, probes[:, members].max(axis=1) + reach
        candidates = solids.only(((low <= most) & (high >= least)).all(axis=1))
        room[members] = candidates.room(probes[:, members], reach) / reach
    return np.clip(room, 0, 1)


def cells(places: Float[ndarray, "axes points"], width: float) -> Iterator[Int[ndarray, "members"]]:
    """Yield the points of each occupied cell of a grid."""
    if not places.shape[1]:
        return
    grid = np.floor(places / width).astype(np.int32)
    grid -= grid.min(axis=1, keepdims=True)
    shape = grid.max(axis=1) + 1
    flat = np.ravel_multi_index(tuple(grid), tuple(shape))
    # A short type lets numpy sort by radix, ten times as fast.
    flat = flat.astype(np.min_scalar_type(int(np.prod(shape))))
    order = np.argsort(flat, kind="stable")
    yield from np.split(order, np.flatnonzero(flat[order][1:] != flat[order][:-1]) + 1)

"""Shading: shadows of the key light, the openness of the surroundings, and the response of a surface.

Culling keeps shadows and openness exact: points are sorted into cells, and a cell tests only the parts that can matter.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int
from numpy import ndarray

from nerf_lightning.data.bricks.parts import Part, Triple
from nerf_lightning.data.bricks.solids import Solids


@dataclass(frozen=True)
class Light:
    """The lights of a model: a key light, a fill light that casts no shadow, and the surroundings.

    `key` is the unit vector toward the key light; an upward surface receives `sky_light`, a downward one
    `ground_light`. Colors are linear.
    """

    key: Float[ndarray, "3"]
    key_color: Triple
    fill_color: Triple
    sky_light: Triple
    ground_light: Triple


@dataclass(frozen=True)
class Model:
    """What is rendered, in world units."""

    parts: Sequence[Part]
    light: Light


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
"""Heights above the surface, in world units, at which the distance to the nearest part is queried."""
LIFT = 1e-3
"""Shadow rays start this far above the surface."""
SHADOW_CELL, PROBE_CELL = 0.12, 0.24
FILL = np.array([-0.60, 0.66, 0.45]) / np.linalg.norm([-0.60, 0.66, 0.45])
"""Toward the fill light, which casts no shadow."""
ZENITH, HORIZON, GROUND = (0.34, 0.52, 0.92), (1.00, 1.00, 1.00), (0.26, 0.22, 0.20)
"""Linear colors of what surrounds the model, as surfaces mirror it."""


def _key_axes(light: Light) -> Float[ndarray, "3 3"]:
    """Return rows across, across and toward the key light."""
    across = np.cross([0.0, 0.0, 1.0], light.key)
    across /= np.linalg.norm(across)
    return np.stack([across, np.cross(light.key, across), light.key])


def _key_directions(axes: Float[ndarray, "3 3"]) -> Float[ndarray, "3 directions"]:
    """Return unit directions spread evenly over the light's disc (a spiral of equal areas)."""
    index = np.arange(SIDES**2)
    radius = SPREAD * np.sqrt((index + 0.5) / SIDES**2)
    angle = index * np.pi * (3 - np.sqrt(5))
    local = np.stack([radius * np.cos(angle), radius * np.sin(angle), np.ones(SIDES**2)])
    return axes.T @ (local / np.linalg.norm(local, axis=0))


def key_visible(
    solids: Solids,
    points: Float[ndarray, "3 points"],
    normals: Float[ndarray, "3 points"],
    rays: Int[ndarray, "points"],
    light: Light = DAY,
) -> Float[ndarray, "points"]:
    """Return 1 where the key light's direction number `rays` is unoccluded, 0 where it is blocked or behind."""
    axes = _key_axes(light)
    directions = _key_directions(axes).astype(points.dtype)[:, rays]
    starts = points + points.dtype.type(LIFT) * normals
    visible = np.zeros_like(points[0])
    facing = np.flatnonzero(np.sum(directions * normals, axis=0) > 0)
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
    """Return the free space above each point as a share of the queried height, in [0, 1]; small in corners and gaps.

    Each ray through a pixel queries one height, so that the pixel's mean covers all of them.
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
    """Yield the points in each occupied cell of a grid."""
    if not places.shape[1]:
        return
    grid = np.floor(places / width).astype(np.int32)
    grid -= grid.min(axis=1, keepdims=True)
    shape = grid.max(axis=1) + 1
    flat = np.ravel_multi_index(tuple(grid), tuple(shape))
    # A short type lets NumPy use radix sort, ten times as fast.
    flat = flat.astype(np.min_scalar_type(int(np.prod(shape))))
    order = np.argsort(flat, kind="stable")
    yield from np.split(order, np.flatnonzero(flat[order][1:] != flat[order][:-1]) + 1)


def palette(parts: Sequence[Part], dtype: type[np.floating]) -> Float[ndarray, "6 parts"]:
    """Return the parts' materials: linear red, green and blue, then specular, sharpness and mirror."""
    made = [part.material for part in parts]
    shine = np.array([(m.specular, m.sharpness, m.mirror) for m in made]).T
    return np.concatenate([decode_srgb(np.array([m.color for m in made]).T), shine]).astype(dtype)


def shade(
    materials: Float[ndarray, "6 parts"],
    light: Light,
    part: Int[ndarray, "hits"],
    normals: Float[ndarray, "3 hits"],
    directions: Float[ndarray, "3 hits"],
    lit: Float[ndarray, "hits"],
    openness: Float[ndarray, "hits"],
) -> Float[ndarray, "3 hits"]:
    """Return the sRGB-encoded color of each hit.

    Lambert plus a Blinn-Phong highlight of the key light (the half vector's cosine to the power of 2^sharpness),
    plus the mirrored surroundings with Schlick's Fresnel term: both change with the view.

    Args:
        materials: what `palette` returns.
        light: the lights of the model.
        part: which part was hit.
        normals: outward, unit length.
        directions: of the incoming rays, unit length.
        lit: share of the key light that arrives.
        openness: share of the surroundings not hidden by nearby parts.
    """
    dtype, (red, green, blue, specular, sharpness, mirror) = normals.dtype, materials[:, part]
    key = _column(light.key, dtype)
    lambert = np.maximum(np.sum(normals * key, axis=0), 0) * lit
    fill = np.maximum(np.sum(normals * _column(FILL, dtype), axis=0), 0) * (0.4 + 0.6 * openness)
    ambient = _mix(light.ground_light, light.sky_light, 0.5 + 0.5 * normals[2]) * openness
    received = ambient + _column(light.key_color, dtype) * lambert + _column(light.fill_color, dtype) * fill
    cosine = np.clip(-np.sum(normals * directions, axis=0), 0, 1)
    fresnel = mirror + (1 - mirror) * (1 - cosine) ** 5 * dtype.type(0.5)
    mirrored = _surroundings(directions + 2 * cosine * normals) * (0.25 + 0.75 * openness)
    half = key - directions
    half /= np.sqrt(np.sum(half**2, axis=0))
    highlight = np.maximum(np.sum(half * normals, axis=0), 0)
    for power in range(int(materials[4].max())):
        highlight = np.where(power < sharpness, highlight * highlight, highlight)
    shine = specular * lit * highlight
    linear = (1 - fresnel) * np.stack([red, green, blue]) * received + fresnel * mirrored
    return encode_srgb(linear + shine)


def _surroundings(directions: Float[ndarray, "3 rays"]) -> Float[ndarray, "3 rays"]:
    """Return the linear color of the sky, of the ground, and of the soft step between them."""
    height = directions[2]
    sky = _mix(HORIZON, ZENITH, np.clip(height, 0, 1) ** 0.5)
    rise = np.clip((height + 0.12) / 0.16, 0, 1)
    rise = rise * rise * (3 - 2 * rise)
    return _column(GROUND, directions.dtype) * (1 - rise) + sky * rise


def encode_srgb(linear: Float[ndarray, "..."]) -> Float[ndarray, "..."]:
    """Return the sRGB code of linear light, clipped to [0, 1] (IEC 61966-2-1)."""
    light = np.clip(linear, 0, 1)
    return np.where(light <= 0.0031308, 12.92 * light, 1.055 * light ** (1 / 2.4) - 0.055)


def decode_srgb(code: Float[ndarray, "..."]) -> Float[ndarray, "..."]:
    """Return the linear light of an sRGB code in [0, 1]."""
    return np.where(code <= 0.04045, code / 12.92, ((code + 0.055) / 1.055) ** 2.4)


def _mix(low: Triple, high: Triple, share: Float[ndarray, "rays"]) -> Float[ndarray, "3 rays"]:
    return _column(low, share.dtype) * (1 - share) + _column(high, share.dtype) * share


def _column(values: Sequence[float] | Float[ndarray, "3"], dtype: np.dtype) -> Float[ndarray, "3 1"]:
    return np.array(values, dtype)[:, None]

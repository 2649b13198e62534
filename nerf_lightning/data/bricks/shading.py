"""From a surface to a colour: a warm key light with shadows, a cool fill, a sky, highlights and mirrored sky."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int
from numpy import ndarray

from nerf_lightning.data.bricks.light import DAY, Light
from nerf_lightning.data.bricks.parts import Part

FILL = np.array([-0.60, 0.66, 0.45]) / np.linalg.norm([-0.60, 0.66, 0.45])
"""Towards the fill light, which casts no shadow."""
ZENITH, HORIZON, GROUND = (0.34, 0.52, 0.92), (1.00, 1.00, 1.00), (0.26, 0.22, 0.20)
"""Linear colours of what surrounds the model, as surfaces mirror it."""


@dataclass(frozen=True)
class Palette:
    """The materials of a model, one column per part; colours linear."""

    albedo: Float[ndarray, "3 parts"]
    specular: Float[ndarray, "parts"]
    sharpness: Int[ndarray, "parts"]
    mirror: Float[ndarray, "parts"]

    @classmethod
    def of(cls, parts: Sequence[Part], dtype: type[np.floating]) -> "Palette":
        """Collect the materials of parts."""
        made = [part.material for part in parts]
        return cls(
            albedo=decode_srgb(np.array([m.color for m in made]).T).astype(dtype),
            specular=np.array([m.specular for m in made], dtype),
            sharpness=np.array([m.sharpness for m in made]),
            mirror=np.array([m.mirror for m in made], dtype),
        )


@dataclass(frozen=True)
class Hits:
    """Points of surfaces that rays have found."""

    part: Int[ndarray, "hits"]
    normals: Float[ndarray, "3 hits"]
    directions: Float[ndarray, "3 hits"]
    """Of the rays that came, unit length."""
    key: Float[ndarray, "hits"]
    """Share of the key light that arrives."""
    openness: Float[ndarray, "hits"]
    """Share of the surroundings that is not hidden by nearby parts."""


def shade(palette: Palette, hits: Hits, light: Light = DAY) -> Float[ndarray, "3 hits"]:
    """Return the sRGB-encoded colour of each hit.

    Lambert plus a Blinn-Phong highlight of the key light (the half vector's cosine to the power of 2^sharpness),
    plus the mirrored surroundings with Schlick's Fresnel term: both change with the view.
    """
    normals, open_ = hits.normals, hits.openness
    dtype = normals.dtype
    key = _column(light.key, dtype)
    lambert = np.maximum(np.sum(normals * key, axis=0), 0) * hits.key
    fill = np.maximum(np.sum(normals * _column(FILL, dtype), axis=0), 0) * (0.4 + 0.6 * open_)
    upward = 0.5 + 0.5 * normals[2]
    ambient = _mix(light.ground_light, light.sky_light, upward) * open_
    received = ambient + _column(light.key_color, dtype) * lambert + _column(light.fill_color, dtype) * fill
    cosine = np.clip(-np.sum(normals * hits.directions, axis=0), 0, 1)
    fresnel = palette.mirror[hits.part]
    fresnel = fresnel + (1 - fresnel) * (1 - cosine) ** 5 * dtype.type(0.5)
    bounced = hits.directions + 2 * cosine * normals
    mirrored = surroundings(bounced) * (0.25 + 0.75 * open_)
    shine = palette.specular[hits.part] * hits.key * _highlight(palette, hits, key)
    linear = (1 - fresnel) * palette.albedo[:, hits.part] * received + fresnel * mirrored
    return encode_srgb(linear + shine)


def surroundings(directions: Float[ndarray, "3 rays"]) -> Float[ndarray, "3 rays"]:
    """Return the linear colour of the sky, of the ground, and of the soft step between them."""
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


def _highlight(palette: Palette, hits: Hits, key: Float[ndarray, "3 1"]) -> Float[ndarray, "hits"]:
    half = key - hits.directions
    half /= np.sqrt(np.sum(half**2, axis=0))
    value = np.maximum(np.sum(half * hits.normals, axis=0), 0)
    squarings = palette.sharpness[hits.part]
    for power in range(int(palette.sharpness.max())):
        value = np.where(power < squarings, value * value, value)
    return value


def _mix(
    low: tuple[float, float, float], high: tuple[float, float, float], share: Float[ndarray, "rays"]
) -> Float[ndarray, "3 rays"]:
    return _column(low, share.dtype) * (1 - share) + _column(high, share.dtype) * share


def _column(values: Sequence[float] | Float[ndarray, "3"], dtype: np.dtype) -> Float[ndarray, "3 1"]:
    return np.array(values, dtype)[:, None]

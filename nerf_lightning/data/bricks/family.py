"""A family of models: random vehicles and towers of bricks, each a function of its number alone.

Number 0 is the fire engine (`vehicle`) in its own light. The others differ in what they are, in shape, in colours, in
how they are turned and in where the light comes from.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from nerf_lightning.data.bricks.draws import Draws
from nerf_lightning.data.bricks.light import DAY, Light
from nerf_lightning.data.bricks.parts import Part
from nerf_lightning.data.bricks.solids import Solids
from nerf_lightning.data.bricks.towers import tower
from nerf_lightning.data.bricks.vehicle import SCALE, fire_engine
from nerf_lightning.data.bricks.vehicles import vehicle

REACH = 1.65
"""No part of a model lies farther from the origin, in world units: cameras stand at 4, and near and far are 2 and 6."""
HALF = 1.2
"""Nor beyond this along an axis."""


@dataclass(frozen=True)
class Model:
    """What is rendered."""

    parts: Sequence[Part]
    """In world units."""
    light: Light


def model(variant: int) -> Model:
    """Return the model of a number, 0 or more; the middle of its box is the origin."""
    if variant == 0:
        return Model(fire_engine(), DAY)
    draws = Draws(variant)
    built = draws.pick("kind", (vehicle, tower))(draws)
    return Model(_placed(_turned(built, draws.number("turn", 0.0, 2 * np.pi))), _light(draws))


def _turned(parts: Sequence[Part], angle: float) -> list[Part]:
    """Turn parts around the vertical axis."""
    cos, sin = float(np.cos(angle)), float(np.sin(angle))
    turn = np.array([[cos, -sin, 0.0], [sin, cos, 0.0], [0.0, 0.0, 1.0]])
    turned = []
    for part in parts:
        x, y, z = turn @ np.array(part.center)
        turned.append(replace(part, center=(float(x), float(y), float(z)), frame=turn @ part.frame))
    return turned


def _placed(parts: Sequence[Part]) -> list[Part]:
    """Bring the middle of the parts' box to the origin, and scale."""
    corners = Solids.of(parts).corners().reshape(-1, 3)
    low, high = corners.min(axis=0), corners.max(axis=0)
    middle, half = 0.5 * (low + high), 0.5 * (high - low)
    reach = np.linalg.norm(corners - middle, axis=1).max()
    # The fire engine's scale, or less for what would be larger than it.
    scale = min(SCALE, HALF / float(half.max()), REACH / float(reach))
    x, y, z = (-float(place) for place in middle)
    return [part.scaled(scale, (x, y, z)) for part in parts]


def _light(draws: Draws) -> Light:
    """Return a key light from anywhere above, white, evening or morning, and surroundings that suit it."""
    turn, height = draws.number("light.turn", 0.0, 2 * np.pi), draws.number("light.height", 0.45, 0.9)
    across = float(np.sqrt(1 - height**2))
    warm, strength = draws.number("light.warm", -0.16, 0.2), draws.number("light.strength", 0.6, 1.15)
    sky = draws.number("light.sky", 0.75, 1.3)
    (red, green, blue), (sky_red, sky_green, sky_blue) = DAY.key_color, DAY.sky_light
    return replace(
        DAY,
        key=np.array([across * np.cos(turn), across * np.sin(turn), height]),
        key_color=(strength * red * (1 + warm), strength * green, strength * blue * (1 - warm)),
        sky_light=(sky * sky_red, sky * sky_green, sky * sky_blue),
    )

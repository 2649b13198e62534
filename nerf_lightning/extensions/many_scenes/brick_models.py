"""Models of bricks besides the fire engine: random vehicles and towers, each a function of its number alone.

They differ in kind, shape, colors, orientation and direction of the light.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch

from nerf_lightning.data.bricks.light import DAY, Light, Model
from nerf_lightning.data.bricks.parts import SCALE, Part
from nerf_lightning.data.bricks.reader import BricksReader
from nerf_lightning.data.bricks.solids import Solids
from nerf_lightning.extensions.many_scenes.draws import Draws
from nerf_lightning.extensions.many_scenes.towers import tower
from nerf_lightning.extensions.many_scenes.vehicles import vehicle
from nerf_lightning.messages.errors import InputError
from nerf_lightning.nerf.types.scene import Scene

FAMILY_VERSION = 1
"""Part of the cache's key: raise it whenever one of the models changes."""
REACH = 1.65
"""Maximum distance of any part from the origin, in world units: cameras are at 4, and near and far are 2 and 6."""
HALF = 1.2
"""Maximum coordinate along an axis."""


@dataclass
class BrickModelReader(BricksReader):
    """Render a random model of bricks like the built-in scene, with exact depth and normals.

    Args:
        variant: which model: 0 is the fire engine; every other number is a different vehicle or tower, with its own
            colors and light.
        gain: every color c (sRGB, between 0 and 1) is photographed as gain * c^gamma, as by a camera with other
            settings.
        gamma: see gain.
    """

    variant: int = 1
    gain: float = 1.0
    gamma: float = 1.0
    name: str = "brick_model"

    def model(self) -> Model:
        """Return the model of `variant`."""
        return model(self.variant) if self.variant else super().model()

    def model_key(self) -> dict[str, int]:
        """Return what distinguishes this model from others in the cache."""
        return {"variant": self.variant, "family": FAMILY_VERSION} if self.variant else {}

    def read(self) -> Scene:
        """Return all views, photographed with this gain and gamma; alpha stays.

        Raises:
            InputError: an argument is out of range.
        """
        if self.variant < 0:
            raise InputError(f"There is no brick model scene.variant={self.variant}: give 0 or more.")
        if not (self.gain > 0 and self.gamma > 0):
            raise InputError(f"scene.gain={self.gain} and scene.gamma={self.gamma}: give numbers above 0.")
        scene = super().read()
        if self.gain == self.gamma == 1.0:
            return scene
        codes = (255.0 * self.gain * (torch.arange(256) / 255.0) ** self.gamma).round().clamp(max=255).to(torch.uint8)
        rgba = scene.pixels.rgba
        pixels = replace(scene.pixels, rgba=torch.cat([codes[rgba[:, :3].long()], rgba[:, 3:]], dim=1))
        photographed = {"colors of the photographs": f"{self.gain:g} c^{self.gamma:g}"}
        return replace(scene, pixels=pixels, protocol={**scene.protocol, **photographed})


def model(variant: int) -> Model:
    """Return the model of a number, 1 or more; its box is centered at the origin."""
    draws = Draws(variant)
    built = draws.pick("kind", (vehicle, tower))(draws)
    return Model(_placed(_turned(built, draws.number("turn", 0.0, 2 * np.pi))), _light(draws))


def _turned(parts: Sequence[Part], angle: float) -> list[Part]:
    """Rotate parts around the vertical axis."""
    cos, sin = float(np.cos(angle)), float(np.sin(angle))
    turn = np.array([[cos, -sin, 0.0], [sin, cos, 0.0], [0.0, 0.0, 1.0]])
    turned = []
    for part in parts:
        x, y, z = turn @ np.array(part.center)
        turned.append(replace(part, center=(float(x), float(y), float(z)), frame=turn @ part.frame))
    return turned


def _placed(parts: Sequence[Part]) -> list[Part]:
    """Center the parts' box at the origin, and scale."""
    corners = Solids.of(parts).corners().reshape(-1, 3)
    low, high = corners.min(axis=0), corners.max(axis=0)
    middle, half = 0.5 * (low + high), 0.5 * (high - low)
    reach = np.linalg.norm(corners - middle, axis=1).max()
    # The fire engine's scale, or less for larger models.
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

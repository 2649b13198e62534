"""Parts of a model (a solid, its place and its material), and those of the fire engine.

Lengths are in studs until `scaled`.
"""

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from jaxtyping import Float
from numpy import ndarray

from nerf_lightning.data.bricks.shapes import BALL, BOX, CYLINDER, WEDGE, Solid

Triple = tuple[float, float, float]

ALONG_X = np.array([[0.0, 0, 1], [1, 0, 0], [0, 1, 0]])
"""Frame whose z axis is the world's x; the columns are the frame's axes."""
ALONG_Y = np.array([[0.0, 1, 0], [0, 0, 1], [1, 0, 0]])
ALONG_Z = np.eye(3)
AXES = {"x": ALONG_X, "y": ALONG_Y, "z": ALONG_Z}


@dataclass(frozen=True)
class Material:
    """A surface. Colors are sRGB-encoded."""

    color: Triple
    specular: float = 0.25
    """Strength of the highlight of the key light, whose exponent is two to the power of `sharpness`."""
    sharpness: int = 5
    mirror: float = 0.03
    """Share of the surroundings that is mirrored at normal incidence; the rest is diffuse."""


@dataclass(frozen=True)
class Part:
    """One convex solid in the world: its size (see `shapes`), its center, and its rotation to the world."""

    solid: Solid
    size: tuple[float, ...]
    center: Triple
    frame: Float[ndarray, "3 3"]
    material: Material

    def scaled(self, scale: float, shift: Triple) -> "Part":
        """Return the part moved by `shift` (studs) and then scaled about the origin."""
        lengths = tuple(x if self.solid is WEDGE and i in (3, 4) else scale * x for i, x in enumerate(self.size))
        x, y, z = (scale * (a + b) for a, b in zip(self.center, shift, strict=True))
        return replace(self, size=lengths, center=(x, y, z))


def block(low: Triple, high: Triple, material: Material) -> Part:
    """Return the box between two corners."""
    size, center = _size_and_center(low, high)
    return Part(BOX, size, center, ALONG_Z, material)


def slope(low: Triple, high: Triple, start: tuple[float, float], end: tuple[float, float], material: Material) -> Part:
    """Return a box cut by the plane through two points (x, z); what lies to the right of start -> end is removed."""
    size, center = _size_and_center(low, high)
    run, rise = end[0] - start[0], end[1] - start[1]
    length = float(np.hypot(run, rise))
    cut_x, cut_z = rise / length, -run / length
    offset = cut_x * (start[0] - center[0]) + cut_z * (start[1] - center[2])
    return Part(WEDGE, (*size, cut_x, cut_z, offset), center, ALONG_Z, material)


def rod(center: Triple, radius: float, length: float, frame: Float[ndarray, "3 3"], material: Material) -> Part:
    """Return a cylinder whose axis is the z axis of `frame`."""
    return Part(CYLINDER, (radius, 0.5 * length), center, frame, material)


def ball(center: Triple, radius: float, material: Material) -> Part:
    """Return a ball."""
    return Part(BALL, (radius,), center, ALONG_Z, material)


def _size_and_center(low: Triple, high: Triple) -> tuple[Triple, Triple]:
    half = tuple(0.5 * (b - a) for a, b in zip(low, high, strict=True))
    middle = tuple(0.5 * (a + b) for a, b in zip(low, high, strict=True))
    return half, middle  # type: ignore[return-value]


RED = Material((0.86, 0.10, 0.08))
WHITE = Material((0.94, 0.94, 0.92))
YELLOW = Material((0.99, 0.79, 0.08))
BLUE = Material((0.05, 0.35, 0.92), specular=0.6, sharpness=6, mirror=0.06)
SKIN = Material((0.98, 0.82, 0.20))
GREY = Material((0.62, 0.64, 0.66))
DARK = Material((0.20, 0.21, 0.23))
BLACK = Material((0.10, 0.10, 0.11), specular=0.12, sharpness=3, mirror=0.02)
SILVER = Material((0.78, 0.80, 0.82), specular=0.4, mirror=0.08)
LAMP = Material((1.0, 0.93, 0.70), specular=0.6, sharpness=6, mirror=0.08)
GLASS = Material((0.10, 0.20, 0.32), specular=1.0, sharpness=7, mirror=0.22)
CHROME = Material((0.86, 0.88, 0.92), specular=1.5, sharpness=6, mirror=0.75)

SCALE = 0.185
"""World units per stud: the model is about as large as the scenes of the Blender set."""
MIDDLE = (0.0, 0.0, -4.0)
"""Translation of the model's center to the origin, in studs."""
RISE = np.radians(6.0)
"""How far the ladder is raised."""
LADDER = np.array([[np.cos(RISE), 0, -np.sin(RISE)], [0, 1, 0], [np.sin(RISE), 0, np.cos(RISE)]])
"""Axes along the ladder, across it, and up from it."""


def fire_engine() -> list[Part]:
    """Return all parts in world units, each within [-1.2, 1.2]^3."""
    lines = Path(__file__).with_name("fire_engine.txt").read_text(encoding="utf-8").splitlines()
    return [_part(*line.split()).scaled(SCALE, MIDDLE) for line in lines if not line.startswith("#")]


def _part(kind: str, color: str, *words: str) -> Part:
    material: Material = globals()[color.upper()]
    a, b, c, *more = (float(word) for word in words if word not in AXES)
    if kind == "block":
        return block((a, b, c), (more[0], more[1], more[2]), material)
    if kind == "slope":
        return slope((a, b, c), (more[0], more[1], more[2]), (more[3], more[4]), (more[5], more[6]), material)
    if kind == "rod":
        return rod((a, b, c), more[0], more[1], AXES[words[-1]], material)
    if kind == "ball":
        return ball((a, b, c), more[0], material)
    return Part(BOX, tuple(more), (a, b, c), LADDER, material)

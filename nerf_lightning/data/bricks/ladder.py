"""The ladder on its turntable, raised over the cab, with a firefighter in the basket."""

import numpy as np

from nerf_lightning.data.bricks.paint import BLACK, BLUE, CHROME, DARK, GREY, RED, SKIN, WHITE, YELLOW
from nerf_lightning.data.bricks.parts import (
    ALONG_Y,
    ALONG_Z,
    STUD_HEIGHT,
    Material,
    Part,
    Triple,
    ball,
    block,
    rod,
)
from nerf_lightning.data.bricks.shapes import BOX

RISE = np.radians(6.0)
"""How far the ladder is raised."""
FOOT = (-4.1, 0.0, 6.1)
"""The hinge of the ladder, in studs."""
FRAME = np.array([[np.cos(RISE), 0, -np.sin(RISE)], [0, 1, 0], [np.sin(RISE), 0, np.cos(RISE)]])
"""Axes along the ladder, across it, and up from it."""


def ladder() -> list[Part]:
    """Return turntable, ladder, basket and firefighter, in studs."""
    parts = [
        rod((-3.4, 0.0, 5.2), 1.5, 0.4, ALONG_Z, GREY),
        rod((-3.4, 0.0, 5.45), 1.2, 0.2, ALONG_Z, DARK),
        block((-4.5, -1.15, 5.4), (-2.9, -0.85, 6.5), GREY),
        block((-4.5, 0.85, 5.4), (-2.9, 1.15, 6.5), GREY),
        rod(FOOT, 0.25, 2.6, ALONG_Y, CHROME),
    ]
    for side in (-1, 1):
        parts.append(_bar(-0.4, 8.4, 0.66 * side, 0.09, 0.0, 0.13, YELLOW))
        parts.append(_bar(-0.4, 8.4, 0.66 * side, 0.09, 0.62, 0.09, YELLOW))
        for step in range(5):
            parts.append(_bar(0.1 + 1.95 * step, 0.3 + 1.95 * step, 0.66 * side, 0.07, 0.31, 0.31, YELLOW))
    for step in range(12):
        along = 0.2 + 0.7 * step
        parts.append(_bar(along - 0.09, along + 0.09, 0.0, 0.62, 0.0, 0.09, YELLOW))
    return [*parts, *_basket(), *_firefighter()]


def _bar(start: float, end: float, across: float, width: float, up: float, height: float, material: Material) -> Part:
    """A box along the ladder; `width` and `height` are half extents."""
    x, y, z = np.array(FOOT) + FRAME @ np.array([0.5 * (start + end), across, up])
    return Part(BOX, (0.5 * (end - start), width, height), (float(x), float(y), float(z)), FRAME, material)


def _tip() -> Triple:
    x, y, z = np.array(FOOT) + FRAME @ np.array([8.4, 0, 0])
    return float(x), float(y), float(z)


def _basket() -> list[Part]:
    x, _, z = _tip()
    parts = [
        block((x, -0.9, z - 0.35), (x + 1.5, 0.9, z - 0.15), GREY),
        block((x, -0.9, z - 0.15), (x + 0.15, 0.9, z + 0.45), WHITE),
        block((x + 1.35, -0.9, z - 0.15), (x + 1.5, 0.9, z + 0.45), WHITE),
    ]
    for side in (-1, 1):
        ys = sorted((0.75 * side, 0.9 * side))
        parts.append(block((x, ys[0], z - 0.15), (x + 1.5, ys[1], z + 0.45), WHITE))
    return parts


def _firefighter() -> list[Part]:
    """A little figure: legs, coat with a yellow belt, arms, head and helmet."""
    x, _, z = _tip()
    x, z = x + 0.75, z - 0.15
    parts = [
        block((x - 0.22, -0.42, z), (x + 0.22, 0.42, z + 0.5), BLACK),
        block((x - 0.24, -0.44, z + 0.5), (x + 0.24, 0.44, z + 1.2), BLUE),
        block((x - 0.26, -0.46, z + 0.75), (x + 0.26, 0.46, z + 0.9), YELLOW),
        rod((x, 0.0, z + 1.42), 0.29, 0.5, ALONG_Z, SKIN),
        ball((x, 0.0, z + 1.62), 0.34, RED),
        rod((x, 0.0, z + 1.6), 0.46, 0.1, ALONG_Z, RED),
        rod((x, 0.0, z + 1.97), 0.12, STUD_HEIGHT, ALONG_Z, RED),
    ]
    for side in (-1, 1):
        ys = sorted((0.44 * side, 0.64 * side))
        parts.append(block((x - 0.14, ys[0], z + 0.62), (x + 0.14, ys[1], z + 1.15), BLUE))
        parts.append(ball((x + 0.05, 0.54 * side, z + 0.56), 0.13, SKIN))
    return parts

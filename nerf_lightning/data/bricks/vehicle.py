"""The model: a fire engine of bricks. Built in studs: x forward, y to its left, z up from the ground."""

import numpy as np

from nerf_lightning.data.bricks.parts import (
    ALONG_X,
    ALONG_Y,
    ALONG_Z,
    BLACK,
    BLUE,
    CHROME,
    DARK,
    GLASS,
    GREY,
    LAMP,
    RED,
    SILVER,
    SKIN,
    STUD_HEIGHT,
    WHITE,
    YELLOW,
    Material,
    Part,
    Triple,
    ball,
    block,
    rod,
    slope,
    studs,
)
from nerf_lightning.data.bricks.shapes import BOX

SCALE = 0.185
"""World units per stud: the model is about as large as the scenes of the Blender set."""
MIDDLE = (0.0, 0.0, -4.0)
"""Brings the middle of the model to the origin, in studs."""


def fire_engine() -> list[Part]:
    """Return all parts in world units, each within [-1.2, 1.2]^3."""
    parts = [*_chassis(), *_cab(), *_front(), *_body(), *_rear(), *ladder()]
    for x in (3.3, -3.2):
        for side in (-1, 1):
            parts += _wheel(x, side)
    return [part.scaled(SCALE, MIDDLE) for part in parts]


def _wheel(x: float, side: int) -> list[Part]:
    """A tyre of three rings, a rim with four spokes and a bolted hub."""
    z = 1.2
    parts = [
        rod((x, side * 2.5, z), 1.2, 0.62, ALONG_Y, BLACK),
        rod((x, side * 2.5, z), 1.1, 0.94, ALONG_Y, BLACK),
        rod((x, side * 2.5, z), 0.74, 0.98, ALONG_Y, SILVER),
        rod((x, side * 2.98, z), 0.26, 0.24, ALONG_Y, RED),
        block((x - 0.66, side * 3.02 - 0.05, z - 0.1), (x + 0.66, side * 3.02 + 0.05, z + 0.1), WHITE),
        block((x - 0.1, side * 3.02 - 0.05, z - 0.66), (x + 0.1, side * 3.02 + 0.05, z + 0.66), WHITE),
    ]
    for turn in range(4):
        angle = np.pi * (0.25 + 0.5 * turn)
        at = (x + 0.46 * float(np.cos(angle)), side * 3.0, z + 0.46 * float(np.sin(angle)))
        parts.append(rod(at, 0.1, 0.12, ALONG_Y, DARK))
    return parts


def _chassis() -> list[Part]:
    """Frame, running boards, mudguards and the chrome tanks between the wheels."""
    parts = [block((-5.2, -2.0, 1.0), (5.3, 2.0, 2.5), DARK)]
    for side in (-1, 1):
        for x in (3.3, -3.2):
            parts.append(_plate(x - 1.5, x + 1.5, side, 2.45, 2.72, WHITE))
            parts.append(_plate(x - 1.6, x - 1.35, side, 1.7, 2.5, WHITE))
            parts.append(_plate(x + 1.35, x + 1.6, side, 1.7, 2.5, WHITE))
        parts.append(_plate(-1.6, 1.7, side, 2.3, 2.72, RED))
        parts.append(_plate(-5.4, -4.7, side, 1.3, 2.72, RED))
        parts.append(_plate(-1.5, 1.6, side, 0.85, 1.05, GREY))
        parts.append(rod((0.05, side * 2.45, 1.67), 0.52, 2.7, ALONG_X, CHROME))
        for x in (-0.8, 0.9):
            parts.append(rod((x, side * 2.45, 1.67), 0.56, 0.16, ALONG_X, RED))
    return parts


def _plate(low: float, high: float, side: int, bottom: float, top: float, material: Material) -> Part:
    ys = sorted((side * 1.9, side * 3.0))
    return block((low, ys[0], bottom), (high, ys[1], top), material)


def _cab() -> list[Part]:
    """Doors, windows between pillars, a sloped windscreen, a studded roof with the blue lights."""
    parts = [
        block((2.0, -2.8, 2.7), (5.4, 2.8, 4.0), RED),
        slope((2.1, -2.65, 4.0), (5.3, 2.65, 5.3), (5.3, 4.0), (4.75, 5.3), GLASS),
        block((2.0, -2.8, 5.3), (4.95, 2.8, 5.65), RED),
        block((2.0, -2.8, 4.0), (2.4, 2.8, 5.3), RED),
        *studs([2.5, 3.5, 4.5], [-2.2, 2.2], 5.65, RED),
        block((3.3, -1.75, 5.65), (4.2, 1.75, 5.8), SILVER),
    ]
    for side in (-1, 1):
        y = side * 2.7
        parts += [
            block((3.65, y - 0.1, 4.0), (3.9, y + 0.1, 5.3), RED),
            slope((4.5, y - 0.1, 4.0), (5.4, y + 0.1, 5.3), (5.4, 4.0), (4.85, 5.3), RED),
            block((2.0, y - 0.12, 3.1), (5.4, y + 0.12, 3.4), WHITE),
            block((2.7, side * 2.88 - 0.06, 3.6), (3.2, side * 2.88 + 0.06, 3.75), CHROME),
            block((5.0, side * 3.0 - 0.2, 4.1), (5.15, side * 3.0 + 0.2, 4.8), DARK),
            rod((3.75, side * 1.25, 6.02), 0.4, 0.45, ALONG_Z, BLUE),
            ball((3.75, side * 1.25, 6.24), 0.4, BLUE),
            rod((1.8, side * 2.45, 4.7), 0.17, 4.2, ALONG_Z, CHROME),
            rod((1.8, side * 2.45, 6.0), 0.25, 1.2, ALONG_Z, CHROME),
        ]
    return parts


def _front() -> list[Part]:
    """Grille, lamps and bumper."""
    parts = [
        block((5.3, -1.45, 2.5), (5.46, 1.45, 3.95), DARK),
        block((5.0, -2.9, 1.1), (5.85, 2.9, 1.75), SILVER),
        block((5.0, -2.8, 1.75), (5.45, 2.8, 2.8), RED),
        *studs([5.6], [-2.0, -1.0, 0.0, 1.0, 2.0], 1.75, SILVER),
    ]
    parts += [block((5.4, -1.45, z), (5.58, 1.45, z + 0.16), CHROME) for z in (2.5, 2.85, 3.2, 3.55, 3.83)]
    for side in (-1, 1):
        parts += [
            rod((5.42, side * 2.1, 3.0), 0.5, 0.2, ALONG_X, CHROME),
            rod((5.45, side * 2.1, 3.0), 0.38, 0.3, ALONG_X, LAMP),
            block((5.4, side * 2.1 - 0.35, 2.05), (5.52, side * 2.1 + 0.35, 2.3), YELLOW),
        ]
    return parts


def _body() -> list[Part]:
    """Lockers with ribbed shutters, a white stripe, a studded deck."""
    parts = [
        block((-5.4, -2.8, 2.7), (1.5, 2.8, 5.0), RED),
        *studs([-5.0 + i for i in range(7)], [-2.0, -1.0, 0.0, 1.0, 2.0], 5.0, RED),
    ]
    for side in (-1, 1):
        y = side * 2.8
        parts.append(block((-5.4, y - 0.06, 2.85), (1.5, y + 0.06, 3.2), WHITE))
        for low in (-5.1, -2.9, -0.7):
            parts.append(block((low, y - 0.05, 3.4), (low + 1.9, y + 0.05, 4.75), DARK))
            for rib in range(4):
                z = 3.45 + 0.33 * rib
                parts.append(block((low + 0.08, y - 0.12, z), (low + 1.82, y + 0.12, z + 0.24), SILVER))
    return parts


def _rear() -> list[Part]:
    """Tail lights, step and a hose reel."""
    parts = [
        block((-5.8, -2.6, 1.2), (-5.2, 2.6, 1.5), SILVER),
        block((-5.46, -1.2, 2.9), (-5.3, 1.2, 4.8), DARK),
        rod((-5.3, 0.0, 3.9), 0.62, 1.7, ALONG_Y, YELLOW),
        rod((-5.3, 0.0, 3.9), 0.7, 0.16, ALONG_Y, RED),
    ]
    for side in (-1, 1):
        parts += [
            rod((-5.3, side * 0.9, 3.9), 0.76, 0.16, ALONG_Y, GREY),
            block((-5.5, side * 2.2 - 0.35, 2.9), (-5.3, side * 2.2 + 0.35, 3.4), LAMP),
            block((-5.5, side * 2.2 - 0.35, 3.5), (-5.3, side * 2.2 + 0.35, 4.0), YELLOW),
        ]
    return parts


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

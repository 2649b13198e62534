"""Random towers: stacked floors with windows, a roof, possibly a wing and a base plate. In studs, z up."""

import numpy as np

from nerf_lightning.data.bricks.parts import (
    ALONG_Z,
    CHROME,
    DARK,
    GLASS,
    LAMP,
    Material,
    Part,
    ball,
    block,
    rod,
    slope,
)
from nerf_lightning.extensions.many_scenes.draws import Draws, studs


def tower(draws: Draws) -> list[Part]:
    """Return a tower on the ground."""
    wide, deep = draws.number("wide", 2.0, 4.2), draws.number("deep", 1.8, 3.6)
    round_, paints = draws.chance("round", 0.35), draws.paints(4)
    parts, low = _ground(draws, wide, deep, paints[3])
    for floor in range(draws.whole("floors", 1, 5)):
        high = low + draws.number(f"floor.{floor}", 1.3, 2.6)
        paint = paints[floor % 2] if draws.chance("striped", 0.5) else paints[0]
        parts += _round_floor(wide, low, high, paint) if round_ else _square_floor(draws, wide, deep, low, high, paint)
        parts += _ledge(wide, deep, high, paints[2], round_)
        low, shrink = high + 0.25, draws.number(f"shrink.{floor}", 0.72, 1.0)
        wide, deep = shrink * wide, shrink * deep
    roof = draws.pick("roof.round" if round_ else "roof", (_dome, _spire, _crown) if round_ else ROOFS)
    parts += roof(draws, wide, wide if round_ else deep, low, paints[2])
    return parts


def _ground(draws: Draws, wide: float, deep: float, paint: Material) -> tuple[list[Part], float]:
    """Return a plate with studs or trees, and a wing, if any, and the height of the tower's base."""
    parts: list[Part] = []
    if draws.chance("plate", 0.7):
        x, y = wide + 1.4, deep + 1.4
        parts.append(block((-x, -y, 0.0), (x, y, 0.4), paint))
        for number in range(draws.whole("plate.things", 0, 4)):
            what = f"thing.{number}"
            turn = draws.number(what, 0.0, 2 * np.pi)
            at = (float(np.sign(np.cos(turn)) * (x - 0.6)), float(np.sign(np.sin(turn)) * (y - 0.6)))
            at = (at[0], at[1] * draws.number(f"{what}.along", -1.0, 1.0))
            leaves, high = draws.paints(9)[4 + number], draws.number(f"{what}.high", 1.0, 2.4)
            parts.append(rod((*at, 0.4 + 0.5 * high), 0.15, high, ALONG_Z, DARK))
            parts.append(ball((*at, 0.5 + high), 0.55, leaves))
        low = 0.4
    else:
        low = 0.0
    if draws.chance("wing", 0.5):
        side, high = draws.pick("wing.side", (-1, 1)), draws.number("wing.high", 1.2, 3.0)
        xs = sorted((0.0, side * (wide + draws.number("wing.wide", 1.0, 2.4))))
        wall, cover = draws.paints(11)[9:]
        parts.append(block((xs[0], -0.7 * deep, low), (xs[1], 0.7 * deep, low + high), wall))
        parts.append(
            block((xs[0] - 0.2, -0.75 * deep, low + high), (xs[1] + 0.2, 0.75 * deep, low + high + 0.3), cover)
        )
    return parts, low


def _square_floor(draws: Draws, wide: float, deep: float, low: float, high: float, paint: Material) -> list[Part]:
    """Walls with a row of windows on each side."""
    parts = [block((-wide, -deep, low), (wide, deep, high), paint)]
    glass = LAMP if draws.chance("lit", 0.3) else GLASS
    bottom, top = low + 0.3 * (high - low), low + 0.85 * (high - low)
    for half, is_x in ((wide, True), (deep, False)):
        count = max(1, int(half / draws.number("window.every", 0.8, 1.6)))
        for place in range(count):
            at = half * (2 * place + 1 - count) / count
            room = 0.6 * half / count
            if is_x:
                parts.append(block((at - room, -deep - 0.07, bottom), (at + room, deep + 0.07, top), glass))
            else:
                parts.append(block((-wide - 0.07, at - room, bottom), (wide + 0.07, at + room, top), glass))
    return parts


def _round_floor(radius: float, low: float, high: float, paint: Material) -> list[Part]:
    """A drum with a band of glass behind pillars."""
    third = (high - low) / 3
    parts = [
        rod((0.0, 0.0, 0.5 * (low + high)), 0.92 * radius, high - low, ALONG_Z, GLASS),
        rod((0.0, 0.0, low + 0.5 * third), radius, third, ALONG_Z, paint),
        rod((0.0, 0.0, high - 0.2 * third), radius, 0.4 * third, ALONG_Z, paint),
    ]
    for turn in np.arange(6) * np.pi / 3:
        at = (0.93 * radius * float(np.cos(turn)), 0.93 * radius * float(np.sin(turn)), 0.5 * (low + high))
        parts.append(rod(at, 0.16 * radius, high - low, ALONG_Z, paint))
    return parts


def _ledge(wide: float, deep: float, low: float, paint: Material, round_: bool) -> list[Part]:
    if round_:
        return [rod((0.0, 0.0, low + 0.125), wide + 0.2, 0.25, ALONG_Z, paint)]
    return [block((-wide - 0.2, -deep - 0.2, low), (wide + 0.2, deep + 0.2, low + 0.25), paint)]


def _gable(draws: Draws, wide: float, deep: float, low: float, paint: Material) -> list[Part]:
    """Two slopes that meet in a ridge, and a chimney."""
    top = low + draws.number("gable", 1.0, 2.4)
    out = wide + 0.3
    return [
        slope((0.0, -deep - 0.2, low), (out, deep + 0.2, top), (out, low), (0.0, top), paint),
        slope((-out, -deep - 0.2, low), (0.0, deep + 0.2, top), (0.0, top), (-out, low), paint),
        block((0.4 * wide, -0.4, low), (0.4 * wide + 0.7, 0.4, top + 0.5), DARK),
    ]


def _dome(draws: Draws, wide: float, deep: float, low: float, paint: Material) -> list[Part]:
    """Half a ball and a mast."""
    radius = 0.9 * min(wide, deep)
    mast = draws.number("mast", 0.6, 2.0)
    return [
        ball((0.0, 0.0, low), radius, paint),
        rod((0.0, 0.0, low + radius + 0.5 * mast), 0.12, mast, ALONG_Z, CHROME),
    ]


def _spire(draws: Draws, wide: float, deep: float, low: float, paint: Material) -> list[Part]:
    """Drums that become smaller, and a ball."""
    steps, step = draws.whole("spire.steps", 3, 5), draws.number("spire.step", 0.5, 0.9)
    parts = []
    for place in range(steps):
        radius = min(wide, deep) * (1 - place / steps)
        parts.append(rod((0.0, 0.0, low + (place + 0.5) * step), radius, step, ALONG_Z, paint))
    return [*parts, ball((0.0, 0.0, low + steps * step + 0.2), 0.35, LAMP)]


def _crown(draws: Draws, wide: float, deep: float, low: float, paint: Material) -> list[Part]:
    """Battlements on the corners and between them."""
    high, parts = draws.number("crown", 0.6, 1.1), []
    for x in (-wide, 0.0, wide):
        for y in (-deep, 0.0, deep):
            if x or y:
                at = 0.85 * x, 0.85 * y
                parts.append(block((at[0] - 0.35, at[1] - 0.35, low), (at[0] + 0.35, at[1] + 0.35, low + high), paint))
    return parts


def _deck(draws: Draws, wide: float, deep: float, low: float, paint: Material) -> list[Part]:
    """Studs, and a water tank on legs."""
    xs = [-0.75 * wide, -0.25 * wide, 0.25 * wide, 0.75 * wide]
    tank = draws.number("deck.tank", 0.6, 1.1)
    return [
        *studs(xs, [-0.6 * deep, 0.6 * deep], low, paint),
        rod((0.0, 0.0, low + 0.4), 0.7 * tank, 0.8, ALONG_Z, DARK),
        rod((0.0, 0.0, low + 0.8 + 0.6 * tank), tank, 1.2 * tank, ALONG_Z, paint),
    ]


ROOFS = (_gable, _dome, _spire, _crown, _deck)

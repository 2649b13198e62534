"""Random vehicles: a frame on wheels, a cab, and something behind it. In studs: x forward, z up from the ground."""

from nerf_lightning.data.bricks.parts import (
    ALONG_X,
    ALONG_Y,
    ALONG_Z,
    BLACK,
    BLUE,
    CHROME,
    DARK,
    GLASS,
    LAMP,
    SILVER,
    Material,
    Part,
    ball,
    block,
    rod,
    slope,
)
from nerf_lightning.extensions.many_scenes.draws import Draws, studs


def vehicle(draws: Draws) -> list[Part]:
    """Return a vehicle that faces x."""
    half, wide = draws.number("length", 3.2, 6.2), draws.number("width", 1.8, 2.9)
    radius = draws.number("wheels", 0.75, 1.35)
    floor = radius + draws.number("clearance", 0.5, 1.0)
    body, cab, trim = draws.paints(3)
    behind = half - draws.number("cab.length", 1.9, 3.2)
    parts = [
        block((-half, -0.75 * wide, radius - 0.2), (half, 0.75 * wide, floor), DARK),
        block((-half, -wide, floor), (half, wide, floor + 0.35), trim),
        *_wheels(draws, half, wide, radius),
        *_cab(draws, behind, half, wide, floor + 0.35, cab, trim),
    ]
    return parts + draws.pick("load", LOADS)(draws, -half, behind - 0.25, wide, floor + 0.35, body)


def _wheels(draws: Draws, half: float, wide: float, radius: float) -> list[Part]:
    count = draws.whole("axles", 2, 3 if half < 4.6 else 4)
    rim = draws.paints(4)[3]
    reach, parts = half - 1.2 * radius, []
    for axle in range(count):
        x = reach - 2 * reach * axle / (count - 1)
        for side in (-1, 1):
            parts.append(rod((x, side * wide, radius), radius, 0.9, ALONG_Y, BLACK))
            parts.append(rod((x, side * (wide + 0.1), radius), 0.55 * radius, 0.9, ALONG_Y, rim))
    return parts


def _cab(
    draws: Draws, rear: float, front: float, wide: float, floor: float, paint: Material, trim: Material
) -> list[Part]:
    """Doors, glass between pillars, a roof; lamps in front."""
    door, roof = floor + draws.number("cab.doors", 1.0, 1.6), draws.number("cab.glass", 1.0, 1.6)
    lean, top = draws.number("cab.lean", 0.1, 0.9), door + roof
    parts = [
        block((rear, -wide, floor), (front, wide, door), paint),
        slope((rear + 0.1, 0.1 - wide, door), (front, wide - 0.1, top), (front, door), (front - lean, top), GLASS),
        block((rear, -wide, top), (front - lean, wide, top + 0.35), paint),
        block((rear, -wide, door), (rear + 0.4, wide, top), paint),
        block((front, -0.5 * wide, floor + 0.2), (front + 0.15, 0.5 * wide, door - 0.2), DARK),
        block((front - 0.2, -wide, floor - 0.5), (front + 0.4, wide, floor), SILVER),
    ]
    parts += [rod((front, side * 0.75 * wide, floor + 0.5), 0.3, 0.3, ALONG_X, LAMP) for side in (-1, 1)]
    signal = draws.pick("signal", ("none", "lights", "studs", "pipe"))
    if signal == "lights":
        parts += [ball((rear + 0.8, side * 0.5 * wide, top + 0.5), 0.4, BLUE) for side in (-1, 1)]
    if signal == "studs":
        parts += studs([rear + 0.6, rear + 1.5], [-0.5 * wide, 0.5 * wide], top + 0.35, trim)
    if signal == "pipe":
        parts += [rod((rear - 0.15, side * 0.8 * wide, top), 0.2, 3.0, ALONG_Z, CHROME) for side in (-1, 1)]
    return parts


def _box(draws: Draws, rear: float, front: float, wide: float, floor: float, paint: Material) -> list[Part]:
    """A box with a stripe, and studs or a ridge on its roof."""
    top = floor + draws.number("box.height", 1.8, 4.2)
    stripe, (low, high) = draws.paints(5)[4], (floor + 0.5, floor + draws.number("box.stripe", 0.8, 1.3))
    parts = [block((rear, -wide, floor), (front, wide, top), paint)]
    parts.append(block((rear - 0.06, -wide - 0.06, low), (front + 0.06, wide + 0.06, high), stripe))
    if draws.chance("box.studs", 0.6):
        xs = [rear + 0.7 + i for i in range(int(front - rear - 0.4))]
        return parts + studs(xs, [-0.55 * wide, 0.55 * wide], top, paint)
    return [*parts, block((rear, -0.3 * wide, top), (front, 0.3 * wide, top + 0.5), stripe)]


def _tank(draws: Draws, rear: float, front: float, wide: float, floor: float, paint: Material) -> list[Part]:
    """A lying cylinder with hoops and a lid."""
    radius, middle = draws.number("tank.radius", 1.2, 2.0), 0.5 * (rear + front)
    height, hoop = floor + radius + 0.1, draws.paints(5)[4]
    parts = [rod((middle, 0.0, height), radius, front - rear, ALONG_X, paint)]
    for place in range(draws.whole("tank.hoops", 2, 4)):
        x = rear + (front - rear) * (place + 0.5) / 4
        parts.append(rod((x, 0.0, height), 1.06 * radius, 0.3, ALONG_X, hoop))
    parts.append(block((rear + 0.3, -0.7 * wide, floor), (front - 0.3, 0.7 * wide, floor + 0.6), DARK))
    return [*parts, rod((middle, 0.0, height + radius), 0.6, 0.7, ALONG_Z, hoop)]


def _stack(draws: Draws, rear: float, front: float, wide: float, floor: float, paint: Material) -> list[Part]:
    """Low walls, and bricks, barrels and balls of many colors between them."""
    parts = [
        block((rear, -wide, floor), (front, 0.3 - wide, floor + 0.8), paint),
        block((rear, wide - 0.3, floor), (front, wide, floor + 0.8), paint),
        block((rear, -wide, floor), (rear + 0.3, wide, floor + 0.8), paint),
    ]
    paints, count = draws.paints(9)[4:], max(1, int((front - rear) / 1.5))
    for place in range(count):
        x = rear + (front - rear) * (place + 0.5) / count
        for side in (-1, 1):
            what = f"stack.{place}.{side}"
            high, y, material = draws.number(what, 0.6, 2.6), side * 0.45 * wide, draws.pick(f"{what}.paint", paints)
            shape = draws.pick(f"{what}.shape", ("brick", "barrel", "ball"))
            if shape == "brick":
                parts.append(block((x - 0.6, y - 0.6, floor), (x + 0.6, y + 0.6, floor + high), material))
            elif shape == "barrel":
                parts.append(rod((x, y, floor + 0.5 * high), 0.6, high, ALONG_Z, material))
            else:
                parts.append(ball((x, y, floor + 0.65), 0.65, material))
    return parts


def _crane(draws: Draws, rear: float, front: float, wide: float, floor: float, paint: Material) -> list[Part]:
    """A turntable with a house, a mast and a boom with its hook."""
    middle, boom = 0.5 * (rear + front), draws.paints(5)[4]
    mast, reach = draws.number("crane.mast", 2.2, 4.2), draws.number("crane.reach", 2.5, 5.5)
    side = draws.number("crane.side", -0.6, 0.6) * wide
    top = floor + 0.8 + mast
    return [
        rod((middle, 0.0, floor + 0.25), 0.8 * wide, 0.5, ALONG_Z, DARK),
        block((middle - 1.2, -0.8 * wide, floor + 0.5), (middle + 0.9, 0.1, floor + 2.0), paint),
        block((middle - 0.1, -0.7 * wide, floor + 1.1), (middle + 1.0, 0.0, floor + 1.8), GLASS),
        block((middle - 0.35, side - 0.35, floor + 0.5), (middle + 0.35, side + 0.35, top), boom),
        block((middle - 1.4, side - 0.3, top), (middle + reach, side + 0.3, top + 0.55), boom),
        block((middle - 1.8, side - 0.5, top - 0.5), (middle - 0.8, side + 0.5, top + 0.7), DARK),
        rod((middle + reach - 0.4, side, top - 0.6), 0.1, 1.2, ALONG_Z, CHROME),
        ball((middle + reach - 0.4, side, top - 1.4), 0.35, paint),
    ]


def _seats(draws: Draws, rear: float, front: float, wide: float, floor: float, paint: Material) -> list[Part]:
    """A body with a row of windows: a bus, of one deck or two."""
    parts, decks = [], draws.whole("bus.decks", 1, 2)
    for deck in range(decks):
        low = floor + 2.3 * deck
        parts += [
            block((rear, -wide, low), (front, wide, low + 1.0), paint),
            block((rear + 0.1, 0.1 - wide, low + 1.0), (front, wide - 0.1, low + 2.1), GLASS),
            block((rear, -wide, low + 2.1), (front, wide, low + 2.3), paint),
        ]
        count = draws.whole("bus.windows", 2, 4)
        for place in range(count + 1):
            x = rear + (front - rear - 0.3) * place / count
            parts.append(block((x, -wide, low + 1.0), (x + 0.3, wide, low + 2.1), paint))
    return parts


LOADS = (_box, _tank, _stack, _crane, _seats)

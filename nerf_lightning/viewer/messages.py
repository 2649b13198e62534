"""The gate for what browsers send: a message is dropped, or passes with known keys and numbers in range."""

import math
from collections.abc import Callable
from typing import Any

import msgspec

from nerf_lightning.viewer.limits import (
    LEAST_FOV,
    MOST_COORDINATE,
    MOST_FOV,
    MOST_LETTERS,
    MOST_PIXELS,
    MOST_SIDE,
    MOST_VALUE,
)

# Several controls of one kind in a row: the two ends of a slider.
MOST_VALUES = 8
# A rotation's quaternion whose length is nothing names no rotation; neither does an up of no length.
LEAST_LENGTH = 1e-6


class _Unfit(Exception):
    """A message that nothing can be made of."""


def admitted(raw: object) -> bytes | None:
    """Return what viser may read of a message, or None where it is none of the page's.

    The page sends cameras, values of its panel and clicks on cameras. All else that viser would act on is dropped:
    uploads, answers to questions that were not asked, and the wish to be published through somebody else's server.
    """
    try:
        given = msgspec.msgpack.decode(raw) if isinstance(raw, bytes) else None
        kind = given.get("type") if isinstance(given, dict) else None
        gate = GATES.get(kind) if isinstance(kind, str) else None
        if given is None or gate is None:
            return None
        return msgspec.msgpack.encode({"type": kind} | gate(given))
    except (_Unfit, KeyError, ValueError, TypeError, msgspec.MsgspecError, RecursionError):
        return None


def _camera(given: dict[Any, Any]) -> dict[str, Any]:
    width, height = (_number(given[key], 1.0, MOST_VALUE) for key in ("image_width", "image_height"))
    shrunk = min(1.0, MOST_SIDE / max(width, height), math.sqrt(MOST_PIXELS / (width * height)))
    return {
        "wxyz": _unit(given["wxyz"], 4),
        "position": _place(given["position"]),
        "look_at": _place(given["look_at"]),
        "up_direction": _unit(given["up_direction"], 3),
        "fov": _number(given["fov"], LEAST_FOV, MOST_FOV),
        "near": _number(given["near"], 1e-9, MOST_VALUE),
        "far": _number(given["far"], 1e-9, MOST_VALUE),
        "image_width": max(1, int(width * shrunk)),
        "image_height": max(1, int(height * shrunk)),
    }


def _panel(given: dict[Any, Any]) -> dict[str, Any]:
    # Any attribute of viser's handle could be named here.
    updates = given["updates"]
    if not isinstance(updates, dict):
        raise _Unfit
    return {"uuid": _text(given["uuid"]), "updates": {"value": _value(updates["value"])}}


def _click(given: dict[Any, Any]) -> dict[str, Any]:
    return {
        "name": _text(given["name"]),
        "instance_index": None,
        "ray_origin": _place(given["ray_origin"]),
        "ray_direction": _place(given["ray_direction"]),
        "screen_pos": _numbers(given["screen_pos"], 2, MOST_VALUE),
        "modifier": None,
        "owner": _text(given["owner"]),
    }


GATES: dict[str, Callable[[dict[Any, Any]], dict[str, Any]]] = {
    "ViewerCameraMessage": _camera,
    "GuiUpdateMessage": _panel,
    "SceneNodeClickMessage": _click,
}


def _number(value: object, least: float, most: float) -> float:
    """Return a number within its range, the nearest one for one outside; not finite is none."""
    if isinstance(value, bool) or not isinstance(value, int | float) or not math.isfinite(value):
        raise _Unfit
    return min(max(float(value), least), most)


def _numbers(values: object, count: int, most: float) -> list[float]:
    if not isinstance(values, list) or len(values) != count:
        raise _Unfit
    return [_number(value, -most, most) for value in values]


def _place(values: object) -> list[float]:
    return _numbers(values, 3, MOST_COORDINATE)


def _unit(values: object, count: int) -> list[float]:
    numbers = _numbers(values, count, MOST_COORDINATE)
    length = math.hypot(*numbers)
    if length < LEAST_LENGTH:
        raise _Unfit
    return [number / length for number in numbers]


def _text(value: object) -> str:
    if not isinstance(value, str) or len(value) > MOST_LETTERS:
        raise _Unfit
    return value


def _value(value: object) -> bool | float | str | list[float]:
    if isinstance(value, bool):
        return value
    if isinstance(value, str):
        return _text(value)
    if isinstance(value, list) and 0 < len(value) <= MOST_VALUES:
        return _numbers(value, len(value), MOST_VALUE)
    return _number(value, -MOST_VALUE, MOST_VALUE)

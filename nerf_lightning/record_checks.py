"""The scene in a checkpoint, held against what a scene is: whoever reads it may rely on shapes and names."""

from collections.abc import Mapping
from typing import Any, get_args

import torch
from torch import Tensor

from nerf_lightning.types.scene import Background, LensModel, Space

SPLITS = ("train", "val", "test")
MOST_PIXELS = 1 << 28
"""Of one camera: a film has the size of the photographs where nobody says otherwise."""


def require_sound_scene(scene: Mapping[str, Any]) -> None:
    """Refuse what is no scene.

    Raises:
        ValueError: what is wrong, in a few words.
        KeyError: what is missing.
    """
    cameras, names = scene["cameras"], scene["view_names"]
    views = len(names)
    shapes = {"c2w": (views, 3, 4), "focal": (views, 2), "center": (views, 2), "lens": (views, 6)}
    for key, shape in shapes.items():
        _require_numbers(cameras[key], key, shape)
    for key, values in (("near", scene["near"]), ("far", scene["far"])):
        _require_numbers(values, key, (views,))
    if cameras.get("ndc") is not None:
        _require_numbers(cameras["ndc"], "ndc", (views, 2))
    _require_sizes(cameras["width"], cameras["height"], views)
    _require_numbers(scene["aabb"], "aabb", (2, 3))
    _require_numbers(scene["to_user"], "to_user", (4, 4))
    for key, value, known in (
        ("lens_model", cameras["lens_model"], get_args(LensModel)),
        ("background", scene["background"], get_args(Background)),
        ("space", scene.get("space", "bounded"), get_args(Space)),
    ):
        if value not in known:
            raise ValueError(f"{key} {str(value)[:40]!r}")
    if not isinstance(scene["name"], str) or not isinstance(names, tuple) or not _all(names, str):
        raise ValueError("name or view_names")
    _require_splits(scene["splits"], views)


def _require_numbers(values: object, key: str, shape: tuple[int, ...]) -> None:
    if not isinstance(values, Tensor) or values.shape != shape or not values.is_floating_point():
        raise ValueError(f"{key}, which should be numbers of the shape {shape}")
    if not bool(torch.isfinite(values).all()):
        raise ValueError(f"{key}, which holds NaN or infinity")


def _require_sizes(width: object, height: object, views: int) -> None:
    for key, values in (("width", width), ("height", height)):
        if not isinstance(values, Tensor) or values.dtype != torch.int64 or values.shape != (views,):
            raise ValueError(f"{key}, which should be {views} whole numbers")
        if not bool(((values > 0) & (values <= MOST_PIXELS)).all()):
            raise ValueError(key)
    assert isinstance(width, Tensor)
    assert isinstance(height, Tensor)
    if not bool((width * height <= MOST_PIXELS).all()):
        raise ValueError(f"width and height: more than {MOST_PIXELS:,} pixels")


def _require_splits(splits: object, views: int) -> None:
    if not isinstance(splits, dict) or not set(splits) <= set(SPLITS):
        raise ValueError("splits")
    for numbers in splits.values():
        if not isinstance(numbers, tuple) or not _all(numbers, int) or not all(0 <= n < views for n in numbers):
            raise ValueError("splits")


def _all(values: tuple[Any, ...], kind: type) -> bool:
    return all(type(value) is kind for value in values)

"""The settings of what `nerf render` films.

The defaults: `conf/render.yaml`.
"""

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Literal, get_args

from nerf_lightning.messages.errors import InputError, require_one_of
from nerf_lightning.video.panels import FILMS
from nerf_lightning.video.paths.base import is_point

Form = Literal["video", "webm", "prores", "animation", "frames", "exr"]
FILES: dict[Form, str] = {"video": ".mp4", "webm": ".webm", "prores": ".mov", "animation": ".webp"}
ENDINGS: dict[Form, str] = FILES | {"frames": "", "exr": ""}
Projection = Literal["perspective", "equirectangular"]
Corner = tuple[float, float, float]
EXR_OUTPUTS = ("rgb", "depth")
SWITCHES = ("mosaic", "hold_camera", "alpha")


@dataclass(frozen=True)
class FilmSettings:
    """What is filmed. Distances and places are in the frame and the units of the capture's own files."""

    outputs: tuple[str, ...] = ("rgb", "depth")
    """Keys of `video.panels.FILMS`, or channels of the model's field."""
    mosaic: bool = False
    """One film of all outputs instead of one for each."""
    form: Form = "video"
    alpha: bool = False
    """The film of the colors has straight colors, with the opacity as alpha; nothing is behind the scene."""
    near: float | None = None
    """Where rays begin; None: as for the photographs."""
    crop: tuple[Corner, Corner] | None = None
    """Lower and upper corner of a box, outside of which nothing is shown."""
    hold_camera: bool = False
    """Stay at the first camera, and move only the direction from which color is looked up."""
    projection: Projection = "perspective"
    """Equirectangular: each frame is a panorama of all directions, centered where the camera looks."""
    precision: str | None = None
    """The models' precision, which the caller has set; frames of another precision belong to another film."""


def film_settings(config: Mapping[str, Any]) -> FilmSettings:
    """Return the settings of a film, given plain values; invalid ones are refused."""
    for name in SWITCHES:
        if not isinstance(config[name], bool):
            raise InputError(f"{name}={config[name]} is not valid: it must be true or false.")
    outputs = tuple(map(str, as_list(config["outputs"])))
    if not outputs or len(set(outputs)) < len(outputs) or not all(map(str.isidentifier, outputs)):
        raise InputError(
            f"outputs={list(outputs)}: choose one or more of {', '.join(FILMS)}, or channels of the model, each once."
        )
    if config["format"] not in get_args(Form):
        raise InputError(
            f"format={config['format']}: choose video (mp4), webm (VP9), prores (ProRes 4444 in mov), animation (WebP, "
            "which pages play by themselves), frames (PNG files) or exr (OpenEXR files)."
        )
    if config["format"] == "exr" and (config["mosaic"] or not set(outputs) <= set(EXR_OUTPUTS)):
        raise InputError(
            f"format=exr holds {' and '.join(EXR_OUTPUTS)} as numbers. Leave mosaic and other outputs out."
        )
    if config["alpha"]:
        _check_alpha(config, outputs)
    require_one_of(get_args(Projection), projection=config["projection"])
    plain = {name: config[name] for name in (*SWITCHES, "projection")}
    return FilmSettings(
        outputs, form=config["format"], near=_near(config["near"]), crop=crop_corners(config["crop"]), **plain
    )


def _check_alpha(config: Mapping[str, Any], outputs: tuple[str, ...]) -> None:
    if config["format"] == "video":
        reason = (
            "format=video makes mp4, which has no alpha. Give format=webm (for browsers), format=prores (for editing), "
            "format=animation, format=frames or format=exr"
        )
    elif config["background"] is not None:
        reason = f"background={config['background']} would lie behind the scene. Leave one of the two out"
    elif config["mosaic"]:
        reason = "mosaic=true puts pictures on white. Leave one of the two out"
    elif "rgb" not in outputs:
        reason = "the colors get it, and outputs has no rgb"
    else:
        return
    raise InputError(f"alpha=true: {reason}.")


def as_list(value: Any) -> list[Any]:
    """Return one value or a list of values as a list."""
    return list(value) if isinstance(value, list) else [value]


def _near(value: Any) -> float | None:
    if value is None:
        return None
    if not isinstance(value, (int, float)) or isinstance(value, bool) or not 0 <= value < math.inf:
        raise InputError(f"near={value}: give a distance from the camera, not negative, or null.")
    return float(value)


def crop_corners(corners: Any) -> tuple[Corner, Corner] | None:
    """Return the lower and the upper corner of a box in the capture's own frame; None: there is no box.

    Raises:
        InputError: it is no box.
    """
    if corners is None:
        return None
    if not isinstance(corners, list) or len(corners) != 2 or not all(map(is_point, corners)):
        raise InputError(f"crop={corners}: give the lower and the upper corner of a box, crop=[[x,y,z],[x,y,z]].")
    (x, y, z), (upper_x, upper_y, upper_z) = (map(float, corner) for corner in corners)
    if not (x < upper_x and y < upper_y and z < upper_z):
        raise InputError(
            f"crop={corners} holds nothing: the first corner must be smaller than the second along each axis."
        )
    return (x, y, z), (upper_x, upper_y, upper_z)

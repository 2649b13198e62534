"""A capture as a scene, with the readers and settings of the command line."""

import os
from pathlib import Path
from typing import Any

from nerf_lightning.config.compose import compose_config
from nerf_lightning.config.error_messages import in_words
from nerf_lightning.config.instantiate import build
from nerf_lightning.config.overrides import quoted
from nerf_lightning.files.budgets import Budgets, set_limits
from nerf_lightning.nerf.types.scene import Scene


def read(capture: str | os.PathLike[str] | None = None, *, scene: str = "auto", **settings: Any) -> Scene:
    """Read a capture: photographs, cameras and bounds.

    `nl.read("data/fox")` recognizes COLMAP, nerfstudio, instant-ngp, Blender, LLFF and others by their files;
    `nl.read("photographs", scene="photos")` finds the cameras first, and `nl.read(scene="bricks")` generates the
    built-in scene.

    Args:
        capture: the capture's folder, or an .npz file; None for a generated scene.
        scene: the format by its name in `conf/scene/`; auto: recognized by its files.
        **settings: settings of the scene, as `nerf help scene=...` lists them: `downscale=2`, `background="white"`.

    Returns:
        Cameras (one per view; axes right, up, back; pixels) and near and far of each view in scene units.
        `scene.pixels.view(i)` is view i, uint8 of height x width x 4 with straight alpha; `scene.to_user` transforms
        scene coordinates to the capture's own.

    Raises:
        InputError: the capture or a setting is invalid; the message says how to fix it.
    """
    given = dict(settings)
    if capture is not None:
        is_archive = Path(capture).suffix == ".npz"
        scene = "npz" if is_archive and scene == "auto" else scene
        given["path" if is_archive else "root"] = capture
    overrides = [f"scene={scene}", *(f"scene.{key}={quoted(value)}" for key, value in given.items())]
    with in_words("train"):
        config = compose_config("train", overrides).config
        set_limits(Budgets(**config.budgets))
        result: Scene = build(config.scene).read()
    return result

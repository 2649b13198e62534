"""A capture as a scene, with the readers and settings of the command line."""

import os
from pathlib import Path
from typing import Any

from nerf_lightning.config.compose import compose_config
from nerf_lightning.config.instantiate import build
from nerf_lightning.config.messages import in_words
from nerf_lightning.config.overrides import quoted
from nerf_lightning.files.budgets import Budgets, set_limits
from nerf_lightning.nerf.types.scene import Scene


def read(capture: str | os.PathLike[str] | None = None, *, scene: str = "auto", **settings: Any) -> Scene:
    """Read a capture: photographs, cameras, and where the content lies.

    `nl.read("data/fox")` recognises COLMAP, nerfstudio, instant-ngp, Blender and LLFF by their files;
    `nl.read("photographs", scene="photos")` finds the cameras first, and `nl.read(scene="bricks")` makes the embedded
    scene.

    Args:
        capture: the capture's folder, or an .npz file; None for a scene that the program makes.
        scene: the format by its name in `conf/scene/`; auto: the files tell.
        **settings: of the scene, as `nerf help scene=...` lists them: `downscale=2`, `background="white"`.

    Returns:
        Cameras (one per view; axes right, up, back; pixels) and the near and far of each view in scene units;
        `scene.pixels.view(i)` is view i, uint8 of height x width x 4 with straight alpha; `scene.to_user` takes scene
        coordinates to the capture's own.

    Raises:
        InputError: the capture or a setting is not as it must be; the message says what to do.
    """
    given = dict(settings)
    if capture is not None:
        is_archive = Path(capture).suffix == ".npz"
        scene = "npz" if is_archive and scene == "auto" else scene
        given["path" if is_archive else "root"] = capture
    overrides = [f"scene={scene}", *(f"scene.{key}={quoted(value)}" for key, value in given.items())]
    with in_words("train"):
        config, _ = compose_config("train", overrides)
        set_limits(Budgets(**config.budgets))
        result: Scene = build(config.scene).read()
    return result

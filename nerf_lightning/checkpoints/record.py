"""What a checkpoint holds besides weights and optimizer.

A checkpoint consists of tensors and plain containers only, so it loads with `weights_only=True`; nothing in it is
executed. Under the key `nerf_lightning`: format, version, config (resolved, as yaml text), choices (the names picked
from each config group), scene (cameras, bounds, splits, frame), refined (those cameras as learned, if they were),
quantized (weights in fewer bytes, if it was made smaller), pixels (a hash of each photograph), and the run's state
(`training/restore.py`). The types are in `format.py`.
"""

from dataclasses import fields
from typing import Any

from nerf_lightning import __version__
from nerf_lightning.checkpoints.format import FORMAT
from nerf_lightning.data.captures.checks import check_scene
from nerf_lightning.files.trust import Mismatch
from nerf_lightning.messages.errors import InputError
from nerf_lightning.messages.escaping import for_terminal
from nerf_lightning.nerf.types.scene import Scene, SceneRecord


def scene_record(scene: Scene) -> SceneRecord:
    """Return the part of a scene that outlives its pictures."""
    return SceneRecord(**{field.name: getattr(scene, field.name) for field in fields(SceneRecord)})


def make_record(scene: Scene, config: str, choices: dict[str, str]) -> dict[str, Any]:
    """Return the part of a checkpoint that does not change during a run.

    Raises:
        InputError: no checkpoint could keep the scene, which is better reported before training than after.
    """
    record = scene_record(scene)
    try:
        check_scene(record, "The scene")
    except Mismatch as error:
        raise InputError(
            f"The scene {for_terminal(scene.name[:200])} cannot be kept in a checkpoint: {error}. Fix the capture, or "
            "the settings (scene.*, budgets.*)."
        ) from error
    kept = vars(record) | {"cameras": dict(vars(scene.cameras))}
    return {"format": FORMAT, "version": __version__, "config": config, "choices": choices, "scene": kept}

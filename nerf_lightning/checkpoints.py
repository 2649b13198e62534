"""What a checkpoint holds beside weights and optimizer, and how it is read back: the file is enough on its own.

A checkpoint is tensors and plain containers only, so it loads with `weights_only=True`; nothing in it is executed.
Under the key `nerf_lightning`: format, version, config (resolved, as yaml text), choices (the names picked from each
config group), scene (cameras, bounds, splits, frame), and the run's state that the system adds.
"""

import pickle
import zipfile
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any

from jaxtyping import Float
from torch import Tensor

from nerf_lightning import __version__
from nerf_lightning.errors import InputError
from nerf_lightning.record_checks import require_sound_scene
from nerf_lightning.tensor_files import load_tensors
from nerf_lightning.types import Background, Cameras, Scene, Space

FORMAT = 1
KEY = "nerf_lightning"
PRECISIONS = ("32-true", "tf32", "bf16-mixed")


@dataclass(frozen=True)
class SceneRecord:
    """What outlives the pictures: enough to render, and to place what is rendered in the user's frame."""

    name: str
    cameras: Cameras
    near: Float[Tensor, "views"]
    far: Float[Tensor, "views"]
    aabb: Float[Tensor, "2 3"]
    splits: dict[str, tuple[int, ...]]
    view_names: tuple[str, ...]
    background: Background
    to_user: Float[Tensor, "4 4"]
    space: Space = "bounded"


@dataclass(frozen=True)
class Checkpoint:
    """A checkpoint as read."""

    path: Path
    config: str
    """The run's resolved config, yaml text from a stranger."""
    choices: dict[str, str]
    scene: SceneRecord
    weights: dict[str, Tensor]
    """The model's state dict."""
    step: int
    """Optimizer steps of the run."""
    precision: str
    tile_points: int | None


def scene_record(scene: Scene) -> SceneRecord:
    """Return what outlives the pictures of a scene."""
    return SceneRecord(**{field.name: getattr(scene, field.name) for field in fields(SceneRecord)})


def make_record(scene: Scene, config: str, choices: dict[str, str]) -> dict[str, Any]:
    """Return the part of a checkpoint that does not change during a run."""
    kept = dict(vars(scene_record(scene)))
    kept["cameras"] = dict(vars(scene.cameras))
    return {"format": FORMAT, "version": __version__, "config": config, "choices": choices, "scene": kept}


def read_checkpoint(path: str | Path) -> Checkpoint:
    """Read a checkpoint onto the CPU.

    Raises:
        InputError: the file is missing, damaged, not a checkpoint of this program, or of another format.
    """
    path = Path(path)
    content = _load(path)
    record = content.get(KEY)
    if not isinstance(record, dict) or "state_dict" not in content:
        raise InputError(
            f"{path} is a file of PyTorch's, but not a checkpoint of nerf_lightning. "
            "Give the checkpoints/last.ckpt or checkpoints/best.ckpt of a run folder."
        )
    if record.get("format") != FORMAT:
        raise InputError(
            f"{path} has checkpoint format {_short(record.get('format'))} (written by nerf_lightning "
            f"{_short(record.get('version'))}), "
            f"and this version, {__version__}, reads format {FORMAT}. Use the version that wrote it, or train again."
        )
    try:
        scene = dict(record["scene"])
        scene["cameras"] = _with_lens(scene["cameras"])
        require_sound_scene(scene)
        scene["cameras"] = Cameras(**scene["cameras"])
        _require_sound_run(record, content["global_step"])
        prefix = "model."
        state = content["state_dict"]
        return Checkpoint(
            path=path,
            config=record["config"],
            choices=record["choices"],
            scene=SceneRecord(**scene),
            weights={key[len(prefix) :]: value for key, value in state.items() if key.startswith(prefix)},
            step=content["global_step"],
            precision=record["precision"],
            tile_points=record["tile_points"],
        )
    except (KeyError, TypeError, ValueError, AttributeError) as error:
        raise InputError(f"{path} is damaged: its record lacks or garbles {error}. Use another checkpoint.") from error


def _with_lens(cameras: dict[str, Any]) -> dict[str, Any]:
    # The first checkpoints knew pinholes only, and name no lens.
    lens = {"lens": cameras["focal"].new_zeros(*cameras["focal"].shape[:-1], 6), "lens_model": "pinhole"}
    return lens | cameras


def _require_sound_run(record: dict[str, Any], step: object) -> None:
    config, choices, tile = record["config"], record["choices"], record["tile_points"]
    if type(step) is not int or not (tile is None or (type(tile) is int and tile > 0)):
        raise ValueError("global_step or tile_points")
    if record["precision"] not in PRECISIONS:
        raise ValueError(f"precision {_short(record['precision'])}")
    if not isinstance(config, str) or not isinstance(choices, dict):
        raise ValueError("config or choices")
    if not all(isinstance(word, str) for pair in choices.items() for word in pair):
        raise ValueError("choices")


def _short(value: object) -> str:
    # What nests itself a thousandfold is not written out.
    return str(value)[:40] if isinstance(value, (str, int, float)) else type(value).__name__


def _load(path: Path) -> dict[str, Any]:
    if not path.is_file():
        raise InputError(
            f"There is no checkpoint at {path}. A run keeps its checkpoints in RUN_FOLDER/checkpoints/; "
            "look there for last.ckpt or best.ckpt."
        )
    try:
        content = load_tensors(path)
    except pickle.UnpicklingError as error:
        raise InputError(
            f"{path} is not a checkpoint of nerf_lightning: it holds more than tensors and plain values, and nothing "
            "from a file is executed. Give the checkpoints/last.ckpt or checkpoints/best.ckpt of a run folder."
        ) from error
    except (RuntimeError, EOFError, OSError, ValueError, KeyError, zipfile.BadZipFile) as error:
        raise InputError(
            f"{path} cannot be read ({path.stat().st_size} bytes; cut off, empty, or not a checkpoint). "
            "Use the other checkpoint of the run (best.ckpt or last.ckpt), or train again."
        ) from error
    return content if isinstance(content, dict) else {}

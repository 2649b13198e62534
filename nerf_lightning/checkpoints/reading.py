"""How a checkpoint is read, and which one of a run folder is read; what it holds is made in `record.py`."""

import contextlib
import logging
import os
import re
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from torch import Tensor, nn

from nerf_lightning.checkpoints.format import (
    BEST,
    KEY,
    LAST,
    PREVIOUS,
    require_checkpoint,
    require_our_format,
    scene_of,
)
from nerf_lightning.checkpoints.quantization import dequantized
from nerf_lightning.files.regular import AbsentError
from nerf_lightning.files.tensor_files import load_tensors
from nerf_lightning.files.trust import reading, require_fit
from nerf_lightning.messages.errors import InputError
from nerf_lightning.nerf.types.scene import Cameras, SceneRecord

OTHER_MODEL = (
    "Use another one, or give the model, field and encoder settings that it was trained with (.hydra/overrides.yaml of "
    "that run)."
)

log = logging.getLogger(__name__)


@dataclass(frozen=True)
class Checkpoint:
    """A checkpoint as read."""

    path: Path
    config: str
    """The run's resolved config, as untrusted yaml text."""
    choices: dict[str, str]
    scene: SceneRecord
    """With the cameras as refined in training, if they were."""
    given_cameras: Cameras | None
    """The cameras before training refined them; None if it did not."""
    weights: dict[str, Tensor]
    """The model's state dict."""
    correction: dict[str, Tensor]
    """The correction's state dict."""
    step: int
    """Optimizer steps of the run."""
    precision: str
    tile_points: int | None
    good: bool
    """Saved while everything was finite and no step was being skipped."""
    record: dict[str, Any]
    """What a checkpoint made from this one would keep, besides weights."""

    def load_weights(self, model: nn.Module) -> None:
        """Load the weights into a model.

        Raises:
            InputError: names the first tensor that is missing, unknown, of another shape or dtype, or not finite.
        """
        self._load(self.weights, model, "weights")

    def load_correction(self, correction: nn.Module) -> None:
        """Load the weights into a correction that was fitted to the scene; raises as `load_weights` does."""
        self._load(self.correction, correction, "correction")

    def _load(self, state: dict[str, Tensor], module: nn.Module, name: str) -> None:
        with reading(self.path, OTHER_MODEL):
            try:
                module.load_state_dict(state)  # keys and shapes, which some parts take from the file
            except RuntimeError as error:
                first = re.search(r"size mismatch for [\w.]+|\w+ key\(s\) in state_dict: \"[^\"]+\"", str(error))
                where = f" ({first[0]})" if first else ""
                raise InputError(f"{self.path} holds the {name} of another model{where}. {OTHER_MODEL}") from error
            require_fit(state, module.state_dict(), name)


def read_checkpoint(path: str | Path, to_resume: bool = False) -> Checkpoint:
    """Read a checkpoint onto the CPU; of a run folder, the newest complete one.

    Args:
        path: the file, or a run folder.
        to_resume: keep the content for the training that is about to request it (`content_to_resume`).

    Raises:
        InputError: the file is missing, damaged, not a checkpoint of this program, or of another format.
    """
    path = Path(path)
    if path.is_dir():
        return _newest_of_run(path)
    content = read_content(path)
    if to_resume:
        _ResumeCache.content = _identity(path), content
    return checkpoint_of(content, path)


def checkpoint_of(content: dict[str, Any], path: Path) -> Checkpoint:
    """Return the `Checkpoint` for the content of the file at `path`."""
    record = content[KEY]
    with reading(path, _instead_of(path)):
        state = content["state_dict"] | (dequantized(record["quantized"], str(path)) if "quantized" in record else {})
    scene, refined = scene_of(record), Cameras(**record["refined"]) if "refined" in record else None
    return Checkpoint(
        path=path,
        config=record["config"],
        choices=record["choices"],
        scene=scene if refined is None else replace(scene, cameras=refined),
        given_cameras=None if refined is None else scene.cameras,
        weights=_part(state, "model."),
        correction=_part(state, "correction."),
        step=content["global_step"],
        precision=record["precision"],
        tile_points=record["tile_points"],
        good=record.get("bad_steps", [0, 0])[-1] == 0,
        record=record,
    )


def _part(state: dict[str, Tensor], prefix: str) -> dict[str, Tensor]:
    return {name[len(prefix) :]: value for name, value in state.items() if name.startswith(prefix)}


def read_content(path: Path) -> dict[str, Any]:
    """Return the raw content of a checkpoint file, checked against `checkpoints.format`.

    Raises:
        InputError: as `read_checkpoint`.
    """
    content = _load(path)
    require_our_format(content, path)
    with reading(path, _instead_of(path)):
        require_checkpoint(content, str(path))
    return content


class _ResumeCache:
    content: tuple[tuple[int, ...], dict[str, Any]] | None = None


def _identity(path: Path) -> tuple[int, ...]:
    state = os.stat(path)
    return state.st_dev, state.st_ino, state.st_mtime_ns, state.st_size


def content_to_resume(path: Path) -> dict[str, Any]:
    """Return the raw content of a checkpoint file, without reading it again if `to_resume` has kept it.

    Raises:
        InputError: as `read_checkpoint`.
    """
    kept, _ResumeCache.content = _ResumeCache.content, None
    return kept[1] if kept is not None and path.is_file() and kept[0] == _identity(path) else read_content(path)


def newest_checkpoint(folder: Path, to_resume: bool = False) -> Checkpoint | None:
    """Read `last.ckpt`, or `previous.ckpt` with a warning if it is damaged or missing; None if nothing was saved.

    See `read_checkpoint` for `to_resume`.

    Raises:
        InputError: neither can be read.
    """
    last, previous = folder / LAST, folder / PREVIOUS
    if not last.is_file() and not previous.is_file():
        return None
    try:
        return read_checkpoint(last, to_resume)
    except InputError as error:
        try:
            found = read_checkpoint(previous, to_resume)
        except InputError:
            raise error from None
    reason = "is damaged" if last.exists() else "is missing"
    log.warning("%s %s; the previous one is used instead: %s, of step %d.", last, reason, previous, found.step)
    return found


def _newest_of_run(folder: Path) -> Checkpoint:
    below = folder / "checkpoints"
    found = newest_checkpoint(below if below.is_dir() else folder)
    if found is None:
        raise InputError(
            f"There is no checkpoint in the folder {folder}: neither checkpoints/{LAST} nor checkpoints/{PREVIOUS}. "
            "Give a run folder, or a checkpoint."
        )
    return found


def last_good_checkpoint(folder: Path) -> Path | None:
    """Return the newest complete checkpoint of a run that was saved while everything was finite, if there is one."""
    for path in (folder / LAST, folder / PREVIOUS):
        with contextlib.suppress(InputError):
            if read_checkpoint(path).good:
                return path
    return None


def _load(path: Path) -> dict[str, Any]:
    with reading(path, _instead_of(path)):
        try:
            content = load_tensors(path)
        except AbsentError as error:
            raise InputError(
                f"There is no checkpoint at {path}. A run keeps its checkpoints in RUN_FOLDER/checkpoints/; "
                "look there for last.ckpt or best.ckpt."
            ) from error
    return content if isinstance(content, dict) else {}


def _instead_of(path: Path) -> str:
    """Return advice that names another checkpoint to use."""
    others = [path.with_name(name) for name in (LAST, PREVIOUS, BEST) if name != path.name]
    names = " or ".join(str(other) for other in others if other.is_file())
    return f"Use another checkpoint of the run ({names})." if names else "The run has no other one: train again."

"""The contract of an export: a model in, files out, in the user's own frame."""

from abc import ABC, abstractmethod
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from pathlib import Path
from types import ModuleType
from typing import Any

from jaxtyping import Float
from torch import Tensor

from nerf_lightning.messages.errors import InputError
from nerf_lightning.nerf.kernels.backends import backend, why_not
from nerf_lightning.nerf.models.base import Model
from nerf_lightning.nerf.types.scene import Scene, SceneRecord

Report = Callable[[str, float], None]
"""Takes the name of a stage, and how much of it is done, from 0 to 1."""
Neutral = Callable[[Float[Tensor, "height width 3"], str], Float[Tensor, "height width 3"] | None]
"""Takes the colors of a photograph and its name to the model's neutral colors, or to None where that is not known."""


@dataclass(frozen=True)
class RunContext:
    """What an exporter may need of a run beside its model: none of it is in the checkpoint."""

    photographs: Scene | None = None
    """The capture, in the frame of the checkpoint's record; None: it cannot be read, or is not asked for."""
    neutral: Neutral | None = None
    """Takes back what the model's correction learned of each photograph; None: there is none to take back."""
    facts: tuple[tuple[str, str], ...] = ()
    """What is known of the run: label and value, as texts that may come from anybody."""
    keyframes: tuple[dict[str, Any], ...] = ()
    """A camera path as a keyframe file has it, in the capture's own frame; each with all that a camera needs."""
    name: str = ""
    """What people call the scene; empty: as its record does."""


MODEL_ALONE = RunContext()
"""Nothing is known but the model."""


class Export(ABC):
    """Write what a model has learned as files for other programs."""

    needs_photographs: bool = False
    """Whether the photographs of the run are read again (`run.photographs`; None: they cannot be)."""
    plays_path: bool = False
    """Whether the camera path of the config is evaluated (`run.keyframes`)."""
    needs_density: bool = True
    """Whether it says where matter is, and not only what is seen."""
    kernels: tuple[str, ...] = ()
    """Full names of modules of compiled kernels that it uses, each with a `trial`: compiled at installation."""

    @abstractmethod
    def export(
        self, model: Model, record: SceneRecord, folder: Path, tile_points: int, run: RunContext = MODEL_ALONE
    ) -> list[Path]:
        """Write files into `folder`, which is there, and return where they are.

        Args:
            model: in evaluation mode.
            record: the scene that it was trained on.
            folder: where to.
            tile_points: most points that go through a field at once.
            run: what else is known of the run.

        Raises:
            InputError: a setting that makes no sense, or a model in which there is nothing to export.
        """


def require_setting(name: str, value: object, good: bool, rule: str) -> None:
    """Refuse a setting of an exporter that is not good: its name and value are said, and the rule."""
    if not good:
        raise InputError(f"what.{name}={value}: {rule}")


def require_kernels(module: str, asked_by: str, cure: str = "Reinstall numba.") -> ModuleType:
    """Return a module of compiled kernels, by its full name: without them the work would take hours."""
    found = backend(module)
    if found is None:
        raise InputError(f"{asked_by} needs numba, which cannot be used here: {why_not(module)}. {cure}")
    return found


def refuse_ndc(record: SceneRecord, what: str) -> None:
    """Refuse a scene whose field lives in normalized device coordinates."""
    if record.space == "ndc":
        raise InputError(
            f"what={what}: {record.name} was trained in normalized device coordinates (scene.space=ndc), where distant "
            "content has no box. Use what=points or what=images, or train again with scene.space=contracted."
        )


def require_free(files: Iterable[Path] = (), folders: Iterable[Path] = ()) -> None:
    """Refuse places for files where folders lie, and for folders where files lie: before the work, not after it."""
    taken = [f"{path} is a folder, but a file of that name is to be written" for path in files if path.is_dir()]
    filled = [path for path in folders if path.exists() and not path.is_dir()]
    taken += [f"{path} is a file, but a folder of that name is to be filled" for path in filled]
    for reason in taken:
        raise InputError(f"{reason}. Remove it, or give another place with paths.output_dir=DIR.")

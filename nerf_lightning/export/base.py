"""The contract of an exporter: write a model to files in the user's own frame."""

from abc import ABC, abstractmethod
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from pathlib import Path
from types import ModuleType
from typing import Any

from jaxtyping import Float
from torch import Tensor

from nerf_lightning.messages.errors import InputError
from nerf_lightning.nerf.geometry.clipping import CropBox
from nerf_lightning.nerf.kernels.backends import backend, why_not
from nerf_lightning.nerf.models.base import Model
from nerf_lightning.nerf.types.scene import Scene, SceneRecord

Report = Callable[[str, float], None]
"""Takes the name of a stage and its progress from 0 to 1."""
Neutral = Callable[[Float[Tensor, "height width 3"], str], Float[Tensor, "height width 3"] | None]
"""Maps the colors of a photograph and its name to the model's neutral colors, or to None if unknown."""


@dataclass(frozen=True)
class RunContext:
    """What an exporter may need from a run besides its model: none of it is in the checkpoint."""

    photographs: Scene | None = None
    """The capture, in the frame of the checkpoint's record; None: it cannot be read, or is not needed."""
    neutral: Neutral | None = None
    """Undoes the model's learned correction of each photograph; None: there is no correction."""
    facts: tuple[tuple[str, str], ...] = ()
    """What is known about the run: label and value, as untrusted texts."""
    keyframes: tuple[dict[str, Any], ...] = ()
    """A camera path as in a keyframe file, in the capture's own frame; each keyframe is a complete camera."""
    name: str = ""
    """Display name of the scene; empty: that of its record."""
    crop: CropBox | None = None
    """The part of the scene to export; None: all of it."""
    min_opacity: float = 0.5
    """Minimum opacity of a pixel that sees a surface; behind fainter matter, which is left out, there is nothing.

    `nerf export` has its own default in conf/export.yaml."""


MODEL_ALONE = RunContext()
"""Nothing is known but the model."""


class Export(ABC):
    """Write a trained model as files for other programs."""

    needs_photographs: bool = False
    """Whether it needs the run's photographs (`run.photographs`; None: they cannot be read)."""
    plays_path: bool = False
    """Whether it needs the camera path of the config (`run.keyframes`)."""
    needs_density: bool = True
    """Whether it needs the density, not only renders."""
    crops: bool = False
    """Whether it can export a part of the scene (`run.crop`)."""
    kernels: tuple[str, ...] = ()
    """Full names of the modules of compiled kernels that it uses, each with a `trial`: compiled at installation."""

    @abstractmethod
    def export(
        self, model: Model, record: SceneRecord, folder: Path, tile_points: int, run: RunContext = MODEL_ALONE
    ) -> list[Path]:
        """Write files into `folder`, which exists, and return their paths.

        Args:
            model: in evaluation mode.
            record: the scene that it was trained on.
            folder: destination.
            tile_points: maximum number of points that go through a field at once.
            run: what else is known about the run.

        Raises:
            InputError: a setting makes no sense, or the model contains nothing to export.
        """


def require_setting(name: str, value: object, good: bool, rule: str) -> None:
    """Refuse an invalid setting of an exporter with its name, its value and the rule."""
    if not good:
        raise InputError(f"what.{name}={value}: {rule}")


def require_kernels(module: str, asked_by: str, cure: str = "Reinstall numba.") -> ModuleType:
    """Return a module of compiled kernels by its full name: without them the work would take hours."""
    found = backend(module)
    if found is None:
        raise InputError(f"{asked_by} needs numba, which cannot be used here: {why_not(module)}. {cure}")
    return found


def refuse_ndc(record: SceneRecord, what: str) -> None:
    """Refuse a scene whose field is in normalized device coordinates."""
    if record.space == "ndc":
        raise InputError(
            f"what={what}: {record.name} was trained in normalized device coordinates (scene.space=ndc), where distant "
            "content has no box. Use what=points or what=images, or train again with scene.space=contracted."
        )


def require_free(files: Iterable[Path] = (), folders: Iterable[Path] = ()) -> None:
    """Refuse file paths that are folders, and folder paths that are files: before the work, not after it."""
    taken = [f"{path} is a folder, but a file of that name is to be written" for path in files if path.is_dir()]
    filled = [path for path in folders if path.exists() and not path.is_dir()]
    taken += [f"{path} is a file, but a folder of that name is to be filled" for path in filled]
    for reason in taken:
        raise InputError(f"{reason}. Remove it, or give another place with paths.output_dir=DIR.")

"""The `transforms_<split>.json` files of the Blender format: parsed and checked, no pixel read."""

import math
from dataclasses import dataclass
from pathlib import Path

from jaxtyping import Float
from torch import Tensor

from nerf_lightning.budgets import require_within
from nerf_lightning.data.checks import check_present, pose_from_matrix
from nerf_lightning.data.images import ENDINGS
from nerf_lightning.data.json_files import keys_of, read_json
from nerf_lightning.errors import InputError
from nerf_lightning.escaping import require_printable

FORMAT = "The Blender format"
LEAST_ANGLE = 1e-6
KEYS, FRAME_KEYS = ("camera_angle_x", "frames"), ("file_path", "transform_matrix")


@dataclass(frozen=True)
class Frame:
    """One view as the file names it."""

    image: Path
    label: str
    """`file_path` without a leading `./` and without its ending."""
    c2w: Float[Tensor, "3 4"]
    fov: float
    """Horizontal angle of view in radians."""


def read_frames(path: Path, step: int = 1) -> list[Frame]:
    """Return every `step`-th frame of a transforms file; its images lie relative to the file's folder.

    Raises:
        InputError: not json, lacks keys, has a matrix that is no pose, or names images that do not exist.
    """
    content = read_json(path)
    fov, entries = keys_of(content, KEYS, str(path), FORMAT)
    if isinstance(fov, bool) or not isinstance(fov, int | float) or not LEAST_ANGLE <= fov < math.pi:
        raise InputError(
            f"{path}: camera_angle_x is {fov!r}, but it must be an angle between 0 and pi radians "
            "(the horizontal angle of view)."
        )
    if not isinstance(entries, list):
        raise InputError(f"{path}: frames must be a list of views, but it is {type(entries).__name__}.")
    require_within("views", len(entries), str(path), "views")
    frames = [_frame(path, index, entries[index], float(fov)) for index in range(0, len(entries), step)]
    check_present((frame.image for frame in frames), path)
    return frames


def _frame(path: Path, index: int, entry: object, fov: float) -> Frame:
    """Return one checked frame."""
    where = f"{path}: frames[{index}]"
    name, matrix = keys_of(entry, FRAME_KEYS, where, FORMAT)
    if not isinstance(name, str) or not name:
        raise InputError(f"{where}: file_path is {name!r}, but it must be the image's path as text.")
    require_printable(name, where)
    # Only known endings count: the original files leave ".png" out, and a name may hold a dot of its own.
    image = Path(name) if name.lower().endswith(ENDINGS) else Path(name + ".png")
    return Frame(
        image=path.parent / image,
        label=image.with_suffix("").as_posix(),
        c2w=pose_from_matrix(matrix, f"{where} ({name}): transform_matrix"),
        fov=fov,
    )

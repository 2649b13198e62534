"""`cameras.json` of 3DGS, which SuperSplat and other splat programs also write, next to pictures."""

from pathlib import Path
from typing import Any

import torch

from nerf_lightning.data.captures.capture import Capture
from nerf_lightning.data.captures.find_pictures import first_with_pictures, pictures_below
from nerf_lightning.data.readers.json_frames import path_of
from nerf_lightning.extensions.other_formats.posed import (
    FOLDERS,
    Format,
    Intrinsics,
    Pose,
    Posed,
    PosedReader,
    Size,
    from_opencv,
    number,
    numbered,
    numbers,
)
from nerf_lightning.files.json_files import mapping, read_json
from nerf_lightning.messages.errors import InputError

OUTPUT = ("cfg_args", "point_cloud")
"""Files next to cameras.json in the output of 3DGS; pictures there are renderings with other names."""


def _read(reader: PosedReader, path: Path) -> Capture:
    """Read pinhole cameras, whose principal point is the picture's center: 3DGS has no other.

    A rotation is camera to world, in row-major order, with axes right, down, forward, with the camera's position.
    """
    root = reader.folder()
    photographs = first_with_pictures(root, FOLDERS)
    if photographs is None and (not pictures_below(root) or any((root / name).exists() for name in OUTPUT)):
        raise InputError(
            f"{root} holds cameras of 3DGS (Gaussian splats), but no photographs. If it is the output of a "
            "training, read the capture that it was made of: cfg_args names its folder as source_path."
        )
    content = read_json(path)
    if not isinstance(content, list):
        raise InputError(f"{path} must be a list of cameras, as 3DGS writes it. Export it again.")
    return reader.posed(path, numbered("camera", content), _posed, photographs, photographs)


def _suits(folder: Path) -> bool:
    """Return whether a folder has photographs, or is not an output of 3DGS."""
    return first_with_pictures(folder, FOLDERS) is not None or not any((folder / name).exists() for name in OUTPUT)


def _posed(content: object, where: str) -> Posed:
    said = mapping(content)

    def camera(_: Size) -> tuple[Pose, Intrinsics]:
        size = number(said, "width", where), number(said, "height", where)
        focal = number(said, "fx", where), number(said, "fy", where)
        return _pose(said, where), Intrinsics(focal, (size[0] / 2, size[1] / 2), size)

    return Posed(path_of(said.get("img_name"), "img_name", where), where, camera)


def _pose(said: dict[str, Any], where: str) -> Pose:
    rotation = torch.tensor(numbers(said.get("rotation"), 9, f"{where}: rotation"), dtype=torch.float64)
    position = torch.tensor(numbers(said.get("position"), 3, f"{where}: position"), dtype=torch.float64)
    return from_opencv(torch.cat([rotation.reshape(3, 3), position[:, None]], dim=1), where)


WORDS = r'\A\s*\[\s*\{[^{}]*"img_name"'
FORMAT = Format("3DGS", (("cameras.json", WORDS), ("*.json", WORDS)), _read, _suits)

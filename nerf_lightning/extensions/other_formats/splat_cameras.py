"""`cameras.json` of 3DGS, which SuperSplat and other programs of Gaussian splats write, too, beside pictures."""

from dataclasses import dataclass
from typing import Any

import torch

from nerf_lightning.data.captures.capture import Capture
from nerf_lightning.data.captures.pictures import pictures_below
from nerf_lightning.data.readers.frames import path_of
from nerf_lightning.extensions.other_formats.posed import (
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


@dataclass
class SplatCamerasReader(PosedReader):
    """Read pinhole cameras, whose principal point is the picture's middle: 3DGS has no other.

    A rotation is camera to world, by rows, with axes right, down, ahead, beside the camera's position.
    """

    program = "3DGS"
    signatures = tuple((name, r'\A\s*\[\s*\{[^{}]*"img_name"') for name in ("cameras.json", "*.json"))

    name: str = "splat_cameras"

    def capture(self) -> Capture:
        """Return all pictures, in the file's order."""
        path, root = self.source(), self.folder()
        if not pictures_below(root):
            raise InputError(
                f"{root} is the output of 3DGS (Gaussian splats), which holds cameras but no photographs. Read the "
                "capture that it was made of instead: cfg_args names its folder as source_path."
            )
        content = read_json(path)
        if not isinstance(content, list):
            raise InputError(f"{path} must be a list of cameras, as 3DGS writes it. Export it again.")
        return self.posed(path, numbered("camera", content), _posed)


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

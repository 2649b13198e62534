"""Export the cameras, in the user's frame, for other programs: `transforms.json` and a COLMAP model."""

import logging
import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from jaxtyping import Bool
from torch import Tensor

from nerf_lightning.export.base import MODEL_ALONE, Export, RunContext, require_free
from nerf_lightning.files.atomic import whole_file
from nerf_lightning.files.json_files import read_json_object, write_json
from nerf_lightning.files.made_folders import make_folder
from nerf_lightning.messages.errors import InputError
from nerf_lightning.messages.escaping import require_printable
from nerf_lightning.nerf.geometry.poses import flip_yz, quaternion_from_rotation
from nerf_lightning.nerf.geometry.world_frame import poses_from_user
from nerf_lightning.nerf.models.base import Model
from nerf_lightning.nerf.types.scene import Cameras, LensModel, SceneRecord

CAMERA_MODELS: dict[LensModel, str] = {
    "pinhole": "PINHOLE",
    "radial_tangential": "OPENCV",
    "fisheye": "OPENCV_FISHEYE",
    "equirectangular": "EQUIRECTANGULAR",
}
MADE_BY = {"made_by": "nerf export what=cameras"}
WHOLE = 1e-3  # Tolerance, relative to a panorama's size, within which it shows all directions.
COEFFICIENTS = ("k1", "k2", "k3", "k4", "p1", "p2")
COLMAP_TAKES = {"pinhole": [], "radial_tangential": [0, 1, 4, 5], "fisheye": [0, 1, 2, 3]}
"""The coefficients of each of COLMAP's models, in its order."""

log = logging.getLogger(__name__)


@dataclass
class CamerasExport(Export):
    """Write `transforms.json` (nerfstudio's) and `sparse/0` (COLMAP's, as text) for the training pictures.

    Args:
        images: folder of the photographs, relative to the JSON file, prefixed to each name; None: the recorded names.
    """

    needs_density = False

    images: str | None = None

    def export(
        self, model: Model, record: SceneRecord, folder: Path, tile_points: int, run: RunContext = MODEL_ALONE
    ) -> list[Path]:
        """Write the files."""
        cameras = in_user_frame(record)
        transforms, model_folder = folder / "transforms.json", folder / "sparse" / "0"
        require_free(files=[transforms], folders=[folder / "sparse", model_folder])
        _require_own(transforms, model_folder)
        write_json(transforms, self._transforms(record, cameras))
        if reason := beyond_colmap(cameras):
            log.warning("%s No COLMAP model is written, only transforms.json.", reason)
            return [transforms]
        sparse = make_folder(folder, "sparse", "0")
        for name, text in colmap_files(cameras, record.view_names).items():
            with whole_file(sparse / name) as part:
                part.write_text(text, encoding="utf-8")
        return [transforms, sparse]

    def _transforms(self, record: SceneRecord, cameras: Cameras) -> dict[str, Any]:
        prefix = f"{self.images.rstrip('/')}/" if self.images else ""
        names = [prefix + name for name in record.view_names]
        frames = [_frame(cameras, view, name) for view, name in enumerate(names)]
        content: dict[str, Any] = {**MADE_BY, "camera_model": CAMERA_MODELS[cameras.lens_model], "frames": frames}
        if record.splits.get("train") and (record.splits.get("val") or record.splits.get("test")):
            for split, views in record.splits.items():
                content[f"{split}_filenames"] = [names[view] for view in views]
        return content


def _require_own(transforms: Path, *others: Path) -> None:
    """Refuse to replace the cameras of a capture, whose files have the same names."""
    theirs = [path for path in (transforms, *others) if path.exists()]
    if theirs and not MADE_BY.items() <= read_json_object(transforms).items():
        raise InputError(
            f"{theirs[0]} was not written by nerf export, and would be lost. Move it away, or give another folder with "
            "paths.output_dir=DIR."
        )


def in_user_frame(record: SceneRecord) -> Cameras:
    """Return the cameras in the user's frame, in float64."""
    cameras = record.cameras.map(lambda tensor: tensor.double() if tensor.is_floating_point() else tensor)
    back = torch.linalg.inv(record.to_user.double())
    changed = dict(vars(cameras)) | {"c2w": poses_from_user(cameras.c2w, back), "ndc": None}
    return Cameras(**changed)


def _frame(cameras: Cameras, view: int, name: str) -> dict[str, Any]:
    (fx, fy), (cx, cy) = cameras.focal[view].tolist(), cameras.center[view].tolist()
    if cameras.lens_model == "equirectangular":
        fx, fy = math.pi * fx, math.pi * fy  # nerfstudio counts pixels per half turn
    plain = cameras.lens_model in ("pinhole", "equirectangular")
    return {
        "file_path": name,
        "w": int(cameras.width[view]),
        "h": int(cameras.height[view]),
        **{"fl_x": fx, "fl_y": fy, "cx": cx, "cy": cy},
        **({} if plain else dict(zip(COEFFICIENTS, cameras.lens[view].tolist(), strict=True))),
        "transform_matrix": [*cameras.c2w[view].tolist(), [0.0, 0.0, 0.0, 1.0]],
    }


def beyond_colmap(cameras: Cameras) -> str | None:
    """Return why COLMAP has no model for a lens; None if it has one."""
    if cameras.lens_model == "equirectangular" and not bool(_is_whole(cameras).all()):
        return "COLMAP has no model for panoramas of a part of the directions."
    if cameras.lens_model == "radial_tangential" and bool(cameras.lens[:, 2:4].any()):
        return "The lens has the coefficients k3 or k4, which COLMAP's model OPENCV lacks."
    return None


def colmap_files(cameras: Cameras, names: Sequence[str]) -> dict[str, str]:
    """Return the text of each file by name; views with the same intrinsics share a camera.

    Raises:
        InputError: a photograph's name would break its line.
    """
    numbers: dict[str, int] = {}
    images = ["# IMAGE_ID QW QX QY QZ TX TY TZ CAMERA_ID NAME, then a line of features (none)"]
    for view, name in enumerate(names):
        camera = numbers.setdefault(_camera(cameras, view), len(numbers) + 1)
        require_printable(name, f"photograph {view}")  # it is at the end of a line
        images += [f"{view + 1} {_pose(cameras, view)} {camera} {name}", ""]
    lines = ["# CAMERA_ID MODEL WIDTH HEIGHT PARAMS", *(f"{number} {text}" for text, number in numbers.items())]
    return {
        "cameras.txt": "\n".join(lines) + "\n",
        "images.txt": "\n".join(images) + "\n",
        "points3D.txt": "# POINT3D_ID X Y Z R G B ERROR TRACK (none)\n",
    }


def _is_whole(cameras: Cameras) -> Bool[Tensor, "views"]:
    """Return which panoramas show all directions, as COLMAP's EQUIRECTANGULAR camera (4.1 or later) does."""
    size = torch.stack([cameras.width, cameras.height], dim=-1).double()
    turns = torch.tensor([2.0, 1.0], dtype=torch.float64) * math.pi
    return ((cameras.focal.double() * turns - size).abs() < WHOLE * size).all(dim=-1)


def _camera(cameras: Cameras, view: int) -> str:
    if cameras.lens_model == "equirectangular":
        width, height = int(cameras.width[view]), int(cameras.height[view])
        return f"EQUIRECTANGULAR {width} {height} {width} {height}"
    lens = cameras.lens[view, COLMAP_TAKES[cameras.lens_model]]
    numbers = [*cameras.focal[view].tolist(), *cameras.center[view].tolist(), *lens.tolist()]
    size = f"{int(cameras.width[view])} {int(cameras.height[view])}"
    return f"{CAMERA_MODELS[cameras.lens_model]} {size} {' '.join(map(repr, numbers))}"


def _pose(cameras: Cameras, view: int) -> str:
    """Return world-to-camera with axes right, down, forward: a quaternion and a translation."""
    c2w = flip_yz(cameras.c2w[view])
    rotation = c2w[:, :3].mT
    translation = -rotation @ c2w[:, 3]
    return " ".join(map(repr, [*quaternion_from_rotation(rotation).tolist(), *translation.tolist()]))

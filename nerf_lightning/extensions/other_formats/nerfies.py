"""Captures of Nerfies and HyperNeRF (also DyCheck): `dataset.json`, `camera/` with a JSON file each, `rgb/1x`, ..."""

import logging
from pathlib import Path

import torch
from jaxtyping import Float
from torch import Tensor

from nerf_lightning.data.captures.capture import Capture
from nerf_lightning.data.captures.find_pictures import pictures_below
from nerf_lightning.extensions.other_formats.posed import (
    Format,
    Intrinsics,
    Pose,
    Posed,
    PosedReader,
    Size,
    entries,
    from_rotation_and_center,
    number,
    numbered,
    numbers,
)
from nerf_lightning.files.json_files import mapping, read_json, read_json_object
from nerf_lightning.files.made_folders import file_name
from nerf_lightning.messages.errors import InputError

FOLDERS = ("rgb/1x", "rgb/2x", "rgb/4x", "rgb/8x", "rgb/16x", "rgb")
"""Of pictures, the largest first."""
MOVING = ("warp_id", "time_id", "appearance_id")

log = logging.getLogger(__name__)


def _read(reader: PosedReader, path: Path) -> Capture:
    """Read the pictures of the largest size. An orientation is world to camera, row-major, with the position."""
    root = path.parent
    content = read_json(path)
    ids = [str(each) for each in entries(content, "ids", f"{path} of Nerfies or HyperNeRF")]
    wanted = [reader.images] if reader.images else FOLDERS
    folder = next((root / name for name in wanted if pictures_below(root / name)), None)
    if folder is None:
        raise InputError(f"{root} of Nerfies or HyperNeRF has no pictures in {' or '.join(wanted)}. Copy them there.")
    found = reader.posed(path, numbered("ids", ids), lambda name, where: _posed(root, name, where), folder, folder)
    _say_that_it_moves(root, ids)
    if (root / "depth").is_dir():
        log.info("%s: depth maps are not read", root)
    stems = [Path(view.name).stem for view in found.views]
    splits = {
        split: tuple(stems.index(each) for each in map(str, content.get(f"{split}_ids") or ()) if each in stems)
        for split in ("train", "val")
    }
    given = splits | {"test": splits["val"]} if splits["train"] and splits["val"] else None
    bounds = _bounds(root, len(stems))
    return Capture(found.views, path, found.lens_model, bounds=bounds, splits=given, left_out=found.left_out)


def _suits(folder: Path) -> bool:
    return (folder / "camera").is_dir()


def _posed(root: Path, name: str, where: str) -> Posed:
    path = root / "camera" / file_name(name, ".json")

    def camera(_: Size) -> tuple[Pose, Intrinsics]:
        said, at = mapping(read_json(path)), str(path)
        rotation = numbers(said.get("orientation"), 9, f"{at}: orientation")
        pose = from_rotation_and_center(rotation, numbers(said.get("position"), 3, f"{at}: position"), at)
        if abs(number(said, "skew", at, 0.0)) > 1e-6:
            raise InputError(f"{at} has a skew, which is not supported. Undistort the pictures.")
        focal = number(said, "focal_length", at)
        x, y = numbers(said.get("principal_point"), 2, f"{at}: principal_point")
        width, height = numbers(said.get("image_size"), 2, f"{at}: image_size")
        k1, k2, k3 = numbers(said.get("radial_distortion", [0.0] * 3), 3, f"{at}: radial_distortion")
        tangential = said.get("tangential_distortion", said.get("tangential", [0.0] * 2))
        p1, p2 = numbers(tangential, 2, f"{at}: tangential_distortion")
        lens = (k1, k2, k3, 0.0, p1, p2)
        focals = focal, focal * number(said, "pixel_aspect_ratio", at, 1.0)
        return pose, Intrinsics(focals, (x, y), (width, height), "radial_tangential", lens)

    return Posed(name, where, camera)


def _say_that_it_moves(root: Path, ids: list[str]) -> None:
    said = read_json_object(root / "metadata.json")
    if any(len({str(mapping(said.get(name)).get(key)) for name in ids}) > 1 for key in MOVING):
        log.warning(
            "%s: time differs between pictures, but the scene is treated as static: moving content is blurred", root
        )


def _bounds(root: Path, views: int) -> Float[Tensor, "views 2"] | None:
    """Return the nearest and farthest depth in `scene.json`, which are in units after its scale."""
    said = read_json_object(root / "scene.json")
    if not {"scale", "near", "far"} <= said.keys():
        return None
    scale, near, far = (number(said, key, str(root / "scene.json")) for key in ("scale", "near", "far"))
    return torch.tensor([[near / scale, far / scale]], dtype=torch.float64).expand(views, 2) if scale > 0 else None


FORMAT = Format("Nerfies or HyperNeRF", (("dataset.json", '"(ids|train_ids)"'),), _read, _suits)

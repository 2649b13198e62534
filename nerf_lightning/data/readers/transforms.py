"""`transforms.json` in the flavours of nerfstudio and instant-ngp: poses, intrinsics, lenses, masks, splits."""

import math
from dataclasses import dataclass
from pathlib import Path, PurePosixPath
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from nerf_lightning.data.captures.capture import Capture, View, common_lens_model
from nerf_lightning.data.captures.checks import contents, pose_from_matrix
from nerf_lightning.data.captures.reader import CaptureReader, picture_files
from nerf_lightning.data.pixels.decoding import Photograph
from nerf_lightning.data.pixels.images import ENDINGS, image_size
from nerf_lightning.data.readers.transforms_intrinsics import (
    focal_of,
    lens_of,
    number_of,
    panorama_focal_of,
    size_of,
)
from nerf_lightning.files.budgets import require_within
from nerf_lightning.files.json_files import keys_of, read_json
from nerf_lightning.files.links import is_absolute, is_there
from nerf_lightning.messages.errors import InputError
from nerf_lightning.messages.escaping import listed, require_printable
from nerf_lightning.nerf.geometry.frames import unit_of
from nerf_lightning.nerf.geometry.poses import is_rigid
from nerf_lightning.nerf.types.scene import LensModel

FORMAT = "A transforms.json of nerfstudio or instant-ngp"
NGP_SCALE = 0.33
SPLITS = ("train", "val", "test")


@dataclass
class TransformsReader(CaptureReader):
    """Read a transforms.json; intrinsics may stand at the top, for all views, or in a frame.

    Args:
        file: the json below root; the paths in it are relative to where it lies.
    """

    name: str = "transforms"
    file: str = "transforms.json"

    def capture(self) -> Capture:
        """Return all frames, in the file's order."""
        path = self.folder() / self.file
        if not is_there(path):
            raise InputError(_absent(path))
        self.require_inside(path, self.file)
        content = read_json(path)
        (frames,) = keys_of(content, ("frames",), str(path), FORMAT)
        if not isinstance(frames, list):
            raise InputError(f"{path}: frames must be a list of views, but it is {type(frames).__name__}.")
        require_within("views", len(frames), str(path), "views")
        views, lenses = [], set()
        for index, frame in enumerate(frames):
            view, lens_model = self._view(path, f"{path}: frames[{index}]", content, frame)
            views.append(view)
            lenses.add(lens_model)
        listed_names = {view.name for view in views}
        return Capture(
            views=tuple(views),
            source=path,
            lens_model=_one_lens(lenses, path),
            splits=_splits(content, frames, views, path),
            undo=_undo(content, path),
            box=_ngp_box(content, path),
            left_out=tuple(name for name in self._neighbours(views) if name not in listed_names),
        )

    def _neighbours(self, views: list[View]) -> list[str]:
        # The pictures beside those that are named: what is there and has no pose.
        folders = sorted({view.photograph.path.parent for view in views})
        root = self.folder()
        if len(folders) != 1 or folders[0] == root or not folders[0].is_relative_to(root):
            return []
        return [(folders[0].relative_to(root) / name).as_posix() for name in picture_files(folders[0])]

    def _view(self, path: Path, where: str, content: dict[str, Any], frame: Any) -> tuple[View, LensModel]:
        name, matrix = keys_of(frame, ("file_path", "transform_matrix"), where, FORMAT)
        picture = _picture(path, where, name)
        self.require_inside(picture)
        where = f"{where} ({name})"
        settings = content | frame
        lens_model, lens = lens_of(settings, where)
        width, height = size_of(settings, where) or tuple(map(float, image_size(picture)))
        focal = panorama_focal_of if lens_model == "equirectangular" else focal_of
        mask = None if self.masks else _mask(path, where, frame)
        if mask is not None:
            self.require_inside(mask)
        named = picture.relative_to(path.parent).as_posix() if picture.is_relative_to(path.parent) else picture.name
        view = View(
            name=named,
            photograph=Photograph(picture, self.mask_of(named) if self.masks else mask),
            c2w=pose_from_matrix(_four_rows(matrix), f"{where}: transform_matrix"),
            focal=focal(settings, width, height, where),
            center=(
                number_of(settings, "cx", where, width / 2),
                number_of(settings, "cy", where, height / 2),
            ),
            size=(width, height),
            lens=lens,
        )
        return view, lens_model


def _ngp_box(content: dict[str, Any], path: Path) -> Float[Tensor, "2 3"] | None:
    """Return the box of instant-ngp's `aabb_scale`: in its own units it is a cube of that size around 0.5.

    Its positions are `scale` times the file's, plus `offset`; 0.33 and 0.5 where the file does not say.
    """
    if "aabb_scale" not in content:
        return None
    size, scale = number_of(content, "aabb_scale", str(path)), number_of(content, "scale", str(path), NGP_SCALE)
    for key, value in (("aabb_scale", size), ("scale", scale)):
        if not 0 < value < math.inf:
            raise InputError(f"{path}: {key} is {value}, but must be a positive size. Remove it, or export again.")
    offset = content.get("offset", [0.5, 0.5, 0.5])
    if not isinstance(offset, list) or len(offset) != 3:
        raise InputError(f"{path}: offset is {offset!r}, but must be three numbers. Remove it, or export again.")
    numbers = [number_of({"offset": number}, "offset", str(path)) for number in offset]
    if not all(map(math.isfinite, numbers)):
        raise InputError(f"{path}: offset holds NaN or infinity. Remove it, or export again.")
    middle = (0.5 - torch.tensor(numbers, dtype=torch.float64)) / scale
    half = 0.5 * size / scale
    return torch.stack([middle - half, middle + half])


def _absent(path: Path) -> str:
    if is_there(path.parent / "transforms_train.json"):
        return (
            f"{path} does not exist, but transforms_train.json does: this is the Blender format. "
            f"Use scene=blender scene.root={path.parent}."
        )
    held = contents(path.parent)
    return f"{path} does not exist; the folder holds {held}. Point scene.root at the folder with {path.name}."


def _picture(path: Path, where: str, name: object) -> Path:
    if not isinstance(name, str) or not name:
        raise InputError(f"{where}: file_path is {name!r}, but it must be the image's path as text.")
    require_printable(name, where)
    # Windows writes backslashes; instant-ngp leaves endings out.
    named = path.parent / name.replace("\\", "/")
    found = [named] if named.suffix.lower() in ENDINGS else []
    found += [named.with_name(named.name + ending) for ending in ENDINGS]
    found += [named]  # of another format, which is named where it is opened
    there = [candidate for candidate in found if is_there(candidate)]
    if there:
        return there[0]
    if is_absolute(name):
        raise InputError(
            f"{where}: file_path is {name}, an absolute path of another machine. Make the paths in {path.name} "
            "relative to its own folder."
        )
    raise InputError(
        f"{where}: the image {named} does not exist (with none of the endings {', '.join(ENDINGS)} either). Copy it "
        "there, or remove its frame from the file."
    )


def _mask(path: Path, where: str, frame: dict[str, Any]) -> Path | None:
    name = frame.get("mask_path")
    if name is None or name == "":
        return None
    if not isinstance(name, str):
        raise InputError(f"{where}: mask_path is {name!r}, but it must be the mask's path as text.")
    mask = path.parent / name.replace("\\", "/")
    if not is_there(mask):
        raise InputError(f"{where}: the mask {mask} does not exist. Copy it there, or remove mask_path.")
    return mask


def _four_rows(matrix: object) -> object:
    # instant-ngp also takes three rows; the last one is always the same.
    return [*matrix, [0.0, 0.0, 0.0, 1.0]] if isinstance(matrix, list) and len(matrix) == 3 else matrix


def _one_lens(kinds: set[LensModel], path: Path) -> LensModel:
    lens_model = common_lens_model(kinds)
    if lens_model is None:
        mixed = "panoramas (EQUIRECTANGULAR)" if "equirectangular" in kinds else "fisheye lenses"
        raise InputError(
            f"{path} mixes {mixed} with others, and a scene has one kind. Split the capture: one file for each kind, "
            "whose frames may share the photographs' folder."
        )
    return lens_model


def _splits(
    content: dict[str, Any], frames: list[dict[str, Any]], views: list[View], path: Path
) -> dict[str, tuple[int, ...]] | None:
    """Return the splits that the file names, or that folders called train and test make."""
    lists = {split: content[f"{split}_filenames"] for split in SPLITS if f"{split}_filenames" in content}
    if not lists:
        folders = {split: [view.name for view in views if split in Path(view.name).parts[:-1]] for split in SPLITS}
        lists = folders if folders["train"] and (folders["val"] or folders["test"]) else {}
    if not lists:
        return None
    places = {view.name: number for number, view in enumerate(views)}
    # As the frames write them, too: without an ending, say.
    places |= {_plain(frame["file_path"]): number for number, frame in enumerate(frames)}
    splits = {}
    for split in SPLITS:
        names = lists.get(split, [])
        if not isinstance(names, list) or not all(isinstance(name, str) for name in names):
            raise InputError(f"{path}: {split}_filenames must be a list of file names. Mend it, or remove it.")
        lost = [name for name in names if _plain(name) not in places]
        if lost:
            raise InputError(f"{path}: {split}_filenames lists {listed(lost)}, which no frame has. Mend the list.")
        splits[split] = tuple(dict.fromkeys(places[_plain(name)] for name in names))
    return splits


def _plain(name: str) -> str:
    return PurePosixPath(name.replace("\\", "/")).as_posix()


def _undo(content: dict[str, Any], path: Path) -> Float[Tensor, "4 4"]:
    """Invert nerfstudio's `applied_transform` and `applied_scale`: results line up with what the poses came from.

    In the file's poses the transform was applied to the camera, and then the scale to its centre.
    """
    applied = torch.eye(4, dtype=torch.float64)
    if "applied_transform" in content:
        try:
            applied = torch.as_tensor(_four_rows(content["applied_transform"]), dtype=torch.float64)
        except (TypeError, ValueError, RuntimeError, OverflowError):
            applied = torch.zeros(0)
        if not _is_similarity(applied):
            raise InputError(
                f"{path}: applied_transform must be a matrix of 3 x 4 numbers that turns, moves and scales alike along "
                "all axes. Mend it, or remove it."
            )
    scale = number_of(content, "applied_scale", str(path), 1.0)
    if not 0.0 < scale < math.inf:
        raise InputError(f"{path}: applied_scale is {scale:g}, but it must be above 0. Mend it, or remove it.")
    applied = torch.cat([scale * applied[:3], applied[3:]])
    return torch.linalg.inv(applied)


def _is_similarity(matrix: Tensor) -> bool:
    if matrix.shape != (4, 4) or not bool(torch.isfinite(matrix).all()):
        return False
    if not float(torch.linalg.det(matrix[:3, :3])) > 0 or matrix[3].tolist() != [0.0, 0.0, 0.0, 1.0]:
        return False
    return bool(is_rigid(matrix[:3] / unit_of(matrix)))

"""`transforms.json` in the flavours of nerfstudio and instant-ngp: poses, intrinsics, lenses, masks, splits."""

import math
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from nerf_lightning.data.capture import Capture, View
from nerf_lightning.data.capture_reader import CaptureReader, picture_files
from nerf_lightning.data.checks import listed, pose_from_matrix
from nerf_lightning.data.images import ENDINGS, image_size
from nerf_lightning.data.json_files import keys_of, read_json
from nerf_lightning.data.photographs import Photograph
from nerf_lightning.errors import InputError
from nerf_lightning.geometry.cameras import focal_from_fov
from nerf_lightning.types import LensModel

LENSES: dict[str, LensModel] = {
    "PINHOLE": "pinhole",
    "SIMPLE_PINHOLE": "pinhole",
    "SIMPLE_RADIAL": "radial_tangential",
    "RADIAL": "radial_tangential",
    "OPENCV": "radial_tangential",
    "OPENCV_FISHEYE": "fisheye",
}
FORMAT = "A transforms.json"
COEFFICIENTS = ("k1", "k2", "k3", "k4", "p1", "p2")
SPLITS = ("train", "val", "test")


@dataclass
class TransformsReader(CaptureReader):
    """Read a transforms.json; intrinsics may stand at the top, for all views, or in a frame.

    Args:
        file: the json below root.
    """

    name: str = "transforms"
    file: str = "transforms.json"

    def capture(self) -> Capture:
        """Return all frames, in the file's order."""
        path = self.folder() / self.file
        if not path.is_file():
            raise InputError(_absent(path))
        content = read_json(path)
        (frames,) = keys_of(content, ("frames",), str(path), FORMAT)
        if not isinstance(frames, list):
            raise InputError(f"{path}: frames must be a list of views, but it is {type(frames).__name__}.")
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
            splits=_splits(content, views, path),
            undo=_undo(content, path),
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
        where = f"{where} ({name})"
        settings = content | frame
        lens_model, lens = _lens(settings, where)
        mask = frame.get("mask_path")
        if mask is not None and not isinstance(mask, str):
            raise InputError(f"{where}: mask_path is {mask!r}, but it must be the mask's path as text.")
        width, height = _size(settings, where) or tuple(map(float, image_size(picture)))
        named = picture.relative_to(path.parent).as_posix() if picture.is_relative_to(path.parent) else picture.name
        view = View(
            name=named,
            photograph=Photograph(picture, path.parent / mask if mask else self.mask_of(named)),
            c2w=pose_from_matrix(_four_rows(matrix), f"{where}: transform_matrix"),
            focal=_focal(settings, width, height, where),
            center=(
                _number(settings, "cx", where, width / 2),
                _number(settings, "cy", where, height / 2),
            ),
            size=(width, height),
            lens=lens,
        )
        return view, lens_model


def _absent(path: Path) -> str:
    if (path.parent / "transforms_train.json").is_file():
        return (
            f"{path} does not exist, but transforms_train.json does: this is the Blender format. "
            f"Use scene=blender scene.root={path.parent}."
        )
    present = listed(sorted(p.name for p in path.parent.iterdir())) or "nothing"
    return f"{path} does not exist; the folder holds {present}. Point scene.root at the folder with {path.name}."


def _picture(path: Path, where: str, name: object) -> Path:
    if not isinstance(name, str) or not name:
        raise InputError(f"{where}: file_path is {name!r}, but it must be the image's path as text.")
    # Windows writes backslashes; instant-ngp leaves endings out.
    named = path.parent / name.replace("\\", "/")
    found = [named] if named.suffix.lower() in ENDINGS else []
    found += [named.with_name(named.name + ending) for ending in ENDINGS]
    there = [candidate for candidate in found if candidate.is_file()]
    if there:
        return there[0]
    if Path(name).is_absolute() or name[1:3] in (":\\", ":/"):
        raise InputError(
            f"{where}: file_path is {name}, an absolute path of another machine. Make the paths in {path.name} "
            "relative to its own folder."
        )
    raise InputError(
        f"{where}: the image {named} does not exist (with none of the endings {', '.join(ENDINGS)} either). Copy it "
        "there, or remove its frame from the file."
    )


def _four_rows(matrix: object) -> object:
    # instant-ngp also takes three rows; the last one is always the same.
    return [*matrix, [0.0, 0.0, 0.0, 1.0]] if isinstance(matrix, list) and len(matrix) == 3 else matrix


def _number(settings: dict[str, Any], key: str, where: str, default: float | None = None) -> float:
    value = settings.get(key, default)
    if isinstance(value, bool) or not isinstance(value, int | float):
        raise InputError(f"{where}: {key} is {value!r}, but it must be a number. Export the file again.")
    return float(value)


def _size(settings: dict[str, Any], where: str) -> tuple[float, float] | None:
    if "w" not in settings or "h" not in settings:
        return None
    return _number(settings, "w", where), _number(settings, "h", where)


def _focal(settings: dict[str, Any], width: float, height: float, where: str) -> tuple[float, float]:
    def along(side: str, length: float) -> float | None:
        if f"fl_{side}" in settings:
            return _number(settings, f"fl_{side}", where)
        if f"camera_angle_{side}" not in settings:
            return None
        angle = _number(settings, f"camera_angle_{side}", where)
        if not 0.0 < angle < math.pi:
            raise InputError(f"{where}: camera_angle_{side} is {angle}, but it must lie between 0 and pi radians.")
        return focal_from_fov(length, angle)

    x, y = along("x", width), along("y", height)
    if x is None and y is None:
        raise InputError(
            f"{where} has no focal length: neither fl_x (pixels) nor camera_angle_x (radians) stands in it or at the "
            "file's top. If the file comes from another tool, export it in nerfstudio's or instant-ngp's format."
        )
    return (x or y or 0.0), (y or x or 0.0)


def _lens(settings: dict[str, Any], where: str) -> tuple[LensModel, tuple[float, float, float, float, float, float]]:
    k1, k2, k3, k4, p1, p2 = (_number(settings, key, where, 0.0) for key in COEFFICIENTS)
    lens = (k1, k2, k3, k4, p1, p2)
    bent = any(lens)
    model = settings.get("camera_model", "OPENCV_FISHEYE" if settings.get("is_fisheye") else "OPENCV")
    if model not in LENSES:
        raise InputError(
            f"{where} has the camera_model {model!r}; known are {listed(LENSES)}. Undistort the photographs first, or "
            "export them as perspective pictures."
        )
    kind = LENSES[model]
    if kind == "pinhole" and bent:
        raise InputError(
            f"{where} has the camera_model {model} and distortion coefficients. Remove the one or the other."
        )
    return ("pinhole" if kind == "radial_tangential" and not bent else kind), lens


def _one_lens(kinds: set[LensModel], path: Path) -> LensModel:
    if "fisheye" in kinds and len(kinds) > 1:
        raise InputError(f"{path} mixes fisheye lenses with others, and a scene has one kind. Split the capture.")
    return "fisheye" if "fisheye" in kinds else "radial_tangential" if "radial_tangential" in kinds else "pinhole"


def _splits(content: dict[str, Any], views: list[View], path: Path) -> dict[str, tuple[int, ...]] | None:
    """Return the splits that the file names, or that folders called train and test make."""
    places = {view.name: number for number, view in enumerate(views)}
    lists = {split: content[f"{split}_filenames"] for split in SPLITS if f"{split}_filenames" in content}
    if not lists:
        folders = {split: [view.name for view in views if split in Path(view.name).parts[:-1]] for split in SPLITS}
        lists = folders if folders["train"] and (folders["val"] or folders["test"]) else {}
    if not lists:
        return None
    splits = {}
    for split in SPLITS:
        names = [str(name).removeprefix("./") for name in lists.get(split, [])]
        lost = [name for name in names if name not in places]
        if lost:
            raise InputError(f"{path}: {split}_filenames lists {listed(lost)}, which no frame has. Mend the list.")
        splits[split] = tuple(places[name] for name in names)
    return splits


def _undo(content: dict[str, Any], path: Path) -> Float[Tensor, "4 4"]:
    """Invert nerfstudio's `applied_transform`, so that results line up with what the poses were made from."""
    if "applied_transform" not in content:
        return torch.eye(4, dtype=torch.float64)
    where = f"{path}: applied_transform"
    matrix = _four_rows(content["applied_transform"])
    try:
        applied = torch.as_tensor(matrix, dtype=torch.float64)
        if applied.shape != (4, 4) or not float(torch.linalg.det(applied)) > 0:
            raise ValueError
    except (TypeError, ValueError, RuntimeError):
        raise InputError(
            f"{where} must be a matrix of 3 x 4 numbers that turns, moves and scales. Remove it."
        ) from None
    return torch.linalg.inv(applied)

"""`transforms.json` in the flavours of nerfstudio and instant-ngp: poses, intrinsics, lenses, masks, splits."""

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
from nerf_lightning.data.readers.frames import (
    focal_of,
    lens_of,
    list_of_frames,
    number_of,
    panorama_focal_of,
    path_of,
    positive_of,
)
from nerf_lightning.files.json_files import keys_of, read_json
from nerf_lightning.files.links import is_absolute, is_there
from nerf_lightning.messages.errors import InputError
from nerf_lightning.messages.escaping import listed
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
        depth_unit: length of a level of the 16-bit pictures that `depth_file_path` names, in the capture's units.
    """

    name: str = "transforms"
    file: str = "transforms.json"
    depth_unit: float = 1e-3

    def capture(self) -> Capture:
        """Return all frames, in the file's order."""
        path = self.folder() / self.file
        if not is_there(path):
            raise InputError(_absent(path))
        self.require_inside(path, self.file)
        content = read_json(path)
        (frames,) = keys_of(content, ("frames",), str(path), FORMAT)
        views, lenses = [], set[LensModel]()
        for index, frame in enumerate(list_of_frames(frames, path)):
            view, lens = self._view(path, f"{path}: frames[{index}]", content, frame)
            views.append(view)
            lenses.add(lens)
        lens_model = common_lens_model(lenses)
        if lens_model is None:
            mixed = "panoramas (EQUIRECTANGULAR)" if "equirectangular" in lenses else "fisheye lenses"
            raise InputError(
                f"{path} mixes {mixed} with others, and a scene has one kind. Split the capture: one file for each "
                "kind, whose frames may share the photographs' folder."
            )
        return Capture(
            views=tuple(views),
            source=path,
            lens_model=lens_model,
            splits=_splits(content, frames, views, path),
            undo=_undo(content, str(path)),
            box=_ngp_box(content, str(path)),
            left_out=self._without_pose(views),
            depth_unit=self.depth_unit,
        )

    def _without_pose(self, views: list[View]) -> tuple[str, ...]:
        """Return the pictures that lie beside those that are named, where these lie in one folder of their own."""
        folders, root = {view.photograph.path.parent for view in views}, self.folder()
        folder = folders.pop() if len(folders) == 1 else root
        if folder == root or not folder.is_relative_to(root):
            return ()
        named, base = {view.name for view in views}, folder.relative_to(root)
        return tuple(path for name in picture_files(folder) if (path := (base / name).as_posix()) not in named)

    def _view(self, path: Path, where: str, content: dict[str, Any], frame: Any) -> tuple[View, LensModel]:
        name, matrix = keys_of(frame, ("file_path", "transform_matrix"), where, FORMAT)
        picture = _picture(path, where, path_of(name, "file_path", where))
        self.require_inside(picture)
        where = f"{where} ({name})"
        settings = content | frame
        lens_model, lens = lens_of(settings, where)
        width, height = map(float, image_size(picture))
        if "w" in settings or "h" in settings:  # the intrinsics may be those of another size
            width, height = number_of(settings, "w", where), number_of(settings, "h", where)
        focal = panorama_focal_of if lens_model == "equirectangular" else focal_of
        named = picture.relative_to(path.parent).as_posix() if picture.is_relative_to(path.parent) else picture.name
        view = View(
            name=named,
            photograph=Photograph(picture, self.mask_of(named) if self.masks else self._own_mask(path, where, frame)),
            c2w=pose_from_matrix(matrix, f"{where}: transform_matrix"),
            focal=focal(settings, width, height, where),
            center=(number_of(settings, "cx", where, width / 2), number_of(settings, "cy", where, height / 2)),
            size=(width, height),
            lens=lens,
            depth=self._depth(path, where, frame),
        )
        return view, lens_model

    def _depth(self, path: Path, where: str, frame: dict[str, Any]) -> Path | None:
        name = frame.get("depth_file_path")
        if name in (None, ""):
            return None
        depth = path.parent / path_of(name, "depth_file_path", where).replace("\\", "/")
        self.require_inside(depth)
        return depth  # one that is not there is left out and named with others that cannot be used

    def _own_mask(self, path: Path, where: str, frame: dict[str, Any]) -> Path | None:
        name = frame.get("mask_path")
        if name in (None, ""):
            return None
        mask = path.parent / path_of(name, "mask_path", where).replace("\\", "/")
        if not is_there(mask):
            raise InputError(f"{where}: the mask {mask} does not exist. Copy it there, or remove mask_path.")
        self.require_inside(mask)
        return mask


def _absent(path: Path) -> str:
    if is_there(path.parent / "transforms_train.json"):
        return (
            f"{path} does not exist, but transforms_train.json does: this is the Blender format. "
            f"Use scene=blender scene.root={path.parent}."
        )
    held = contents(path.parent)
    return f"{path} does not exist; the folder holds {held}. Point scene.root at the folder with {path.name}."


def _picture(path: Path, where: str, name: str) -> Path:
    # Windows writes backslashes; instant-ngp leaves endings out.
    named = path.parent / name.replace("\\", "/")
    found = [named] if named.suffix.lower() in ENDINGS else []
    found += [named.with_name(named.name + ending) for ending in ENDINGS]
    found += [named]  # of another format, which is named where it is opened
    there = next(filter(is_there, found), None)
    if there is not None:
        return there
    if is_absolute(name):
        raise InputError(
            f"{where}: file_path is {name}, an absolute path of another machine. Make the paths in {path.name} "
            "relative to its own folder."
        )
    raise InputError(
        f"{where}: the image {named} does not exist (with none of the endings {', '.join(ENDINGS)} either). Copy it "
        "there, or remove its frame from the file."
    )


def _splits(
    content: dict[str, Any], frames: list[dict[str, Any]], views: list[View], path: Path
) -> dict[str, tuple[int, ...]] | None:
    """Return the splits that the file names, or that folders called train and test make."""
    lists = {split: content[f"{split}_filenames"] for split in SPLITS if f"{split}_filenames" in content}
    if not lists:
        lists = {split: [view.name for view in views if split in Path(view.name).parts[:-1]] for split in SPLITS}
        if not lists["train"] or not (lists["val"] or lists["test"]):
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


def _ngp_box(content: dict[str, Any], where: str) -> Float[Tensor, "2 3"] | None:
    """Return the box of instant-ngp's `aabb_scale`: in its own units it is a cube of that size around 0.5.

    Its positions are `scale` times the file's, plus `offset`; 0.33 and 0.5 where the file does not say.
    """
    if "aabb_scale" not in content:
        return None
    size, scale = positive_of(content, "aabb_scale", where), positive_of(content, "scale", where, NGP_SCALE)
    offset = content.get("offset", [0.5, 0.5, 0.5])
    if not isinstance(offset, list) or len(offset) != 3:
        raise InputError(f"{where}: offset is {offset!r}, but must be three numbers. Remove it, or export again.")
    numbers = [number_of({"offset": number}, "offset", where) for number in offset]
    middle, half = (0.5 - torch.tensor(numbers, dtype=torch.float64)) / scale, 0.5 * size / scale
    return torch.stack([middle - half, middle + half])


def _undo(content: dict[str, Any], where: str) -> Float[Tensor, "4 4"]:
    """Invert nerfstudio's `applied_transform` and `applied_scale`: results line up with what the poses came from.

    In the file's poses the transform was applied to the camera, and then the scale to its centre.
    """
    applied = torch.eye(4, dtype=torch.float64)
    if "applied_transform" in content:
        applied[:3] = pose_from_matrix(content["applied_transform"], f"{where}: applied_transform")
        if not is_rigid(applied[:3] / unit_of(applied)):
            raise InputError(
                f"{where}: applied_transform must turn, move and scale alike along all axes. Mend it, or remove it."
            )
    applied[:3] *= positive_of(content, "applied_scale", where, 1.0)
    return torch.linalg.inv(applied)

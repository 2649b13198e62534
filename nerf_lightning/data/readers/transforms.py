"""`transforms.json` in the flavors of nerfstudio and instant-ngp: poses, intrinsics, lenses, masks, splits.

Without splits, `hold_every` in conf/scene_defaults.yaml holds views out. Intrinsics, lens
models (`camera_model`, `k1`, ...) and keys of frames: `json_frames.py`.
"""

import logging
import os
from dataclasses import dataclass, replace
from pathlib import Path, PurePosixPath
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from nerf_lightning.data.captures.capture import Capture, View, of_one_lens
from nerf_lightning.data.captures.checks import pose_from_matrix
from nerf_lightning.data.captures.find_pictures import find_pictures, pictures_below
from nerf_lightning.data.captures.folders import named_folder
from nerf_lightning.data.captures.left_out import LeftOut
from nerf_lightning.data.captures.reader import CaptureReader
from nerf_lightning.data.readers.json_frames import (
    FoundFrame,
    FrameFile,
    length_of,
    number_of,
    path_of,
    positive_of,
    say_of_files,
    views_of,
)
from nerf_lightning.data.readers.ply_points import read_ply_points
from nerf_lightning.messages.errors import InputError
from nerf_lightning.messages.escaping import listed
from nerf_lightning.nerf.geometry.poses import is_rigid
from nerf_lightning.nerf.geometry.world_frame import unit_of

NGP_SCALE = 0.33
SPLITS = ("train", "val", "test")
DEPTH_UNITS = ("depth_unit_scale_factor", "integer_depth_scale")

log = logging.getLogger(__name__)


@dataclass
class TransformsReader(CaptureReader):
    """Read a transforms.json; intrinsics may be at the top level, for all views, or in a frame.

    Args:
        file: the JSON file below root; paths in it are relative to its folder. null: transforms.json, or all
            transforms_*.json as one capture, whose splits are train, val and test.
        depth_unit: length of a unit of the depth maps (`depth_file_path`, `depth_path`), in the capture's units. null:
            from the file (`depth_unit_scale_factor`, `integer_depth_scale`), or else 0.001 for integers and 1 for
            others.
    """

    named_by = (".json",)

    name: str = "transforms"
    file: str | None = None
    depth_unit: float | None = None

    @classmethod
    def found_in(cls, folder: Path) -> str | None:
        """Return the file by which this format is recognized, if a folder has it."""
        return next((path.name for path in _files_in(folder)), None)

    def capture(self) -> Capture:
        """Return all frames, in the files' order."""
        paths = self._paths()
        left_out, files = LeftOut(str(paths[0])), [FrameFile.read(path) for path in paths]
        if self.file is None:
            say_of_files(files)
        each = [views_of(file, self.top(), self.allow_outside, left_out) for file in files]
        found = [frame for frames in each for frame in frames]
        left_out.require_enough(len(found))
        undo = _undo_of(files)
        views = self._with_masks_and_depths(paths[0], found, 1.0 / unit_of(undo))
        left_out.without_pose = self._without_pose(views, left_out)
        capture = Capture(
            views=tuple(views),
            source=paths[0],
            points=_points(files, self.top(), self.allow_outside),
            splits=_splits(files[0], found)
            if len(files) == 1
            else _splits_of_files(paths, [len(each_) for each_ in each]),
            undo=undo,
            box=next((box for file in files if (box := _ngp_box(file.content, str(file.path))) is not None), None),
            left_out=left_out,
            depth_unit=1e-3 / unit_of(undo),
        )
        return of_one_lens(capture, [frame.lens_model for frame in found])

    def _paths(self) -> list[Path]:
        root = Path(self.root).expanduser()
        if self.file is not None:  # it may be in a folder that is itself a capture
            places = [folder / self.file for folder in (named_folder(self.root), self.folder())]
            return [next(filter(os.path.isfile, places), places[0])]
        if os.path.isfile(root):
            return [root]
        paths = _files_in(self.folder()) or [self.folder() / "transforms.json"]
        if len(paths) > 1:
            log.info("%s: read as one capture: %s", self.folder(), listed((path.name for path in paths), 5))
        return paths

    def _without_pose(self, views: list[View], left_out: LeftOut) -> tuple[str, ...]:
        """Return the unnamed pictures next to the named ones, if these have a folder of their own."""
        folders, root = {view.photograph.path.parent for view in views}, self.folder()
        folder = folders.pop() if len(folders) == 1 else root
        if folder == root or not folder.is_relative_to(root):
            return ()
        named = {view.photograph.path for view in views} | {folder / Path(name).name for name in left_out.faults}
        return tuple(path.relative_to(root).as_posix() for path in pictures_below(folder) if path not in named)

    def _with_masks_and_depths(self, path: Path, frames: list[FoundFrame], scale: float) -> list[View]:
        """Return the views with the files that frames name in addition to their pictures.

        Depth maps are in units before applied_scale, for which `scale` compensates.
        """
        masks, depths, others = (
            self._files_of(path, frames, key) for key in ("mask_path", "depth_file_path", "depth_path")
        )
        views, fault = [], ""
        for each, mask, depth, other in zip(frames, masks, depths, others, strict=True):
            photograph, depth = each.view.photograph, depth or other
            if mask is not None:
                photograph = replace(photograph, mask=mask, mask_keeps=None)
            unit = None
            try:
                unit = None if depth is None else self._depth_unit(each, path)
            except InputError as error:
                depth, fault = None, str(error)
            unit = None if unit is None else scale * unit
            views.append(replace(each.view, photograph=photograph, depth=depth, depth_unit=unit))
        if fault:
            log.warning("Depth maps are left out: %s", fault)
        return views

    def _depth_unit(self, frame: FoundFrame, path: Path) -> float | None:
        """Return the length of a unit of a frame's depth map, from the user or the file; None if neither gives one."""
        if self.depth_unit is not None:
            return self.depth_unit
        key = next((key for key in DEPTH_UNITS if key in frame.settings), None)
        return None if key is None else length_of(frame.settings, key, str(path))

    def _files_of(self, path: Path, frames: list[FoundFrame], key: str) -> list[Path | None]:
        """Return the file that each frame names under a key; missing files are logged, and their frames stay."""
        names = [str(each.settings[key]) if each.settings.get(key) else None for each in frames]
        wanted = [name for name in names if name is not None]
        photographs = {each.view.photograph.path for each in frames}
        files = find_pictures(wanted, path.parent, self.top(), path, self.allow_outside, photographs=photographs)
        if key != "mask_path":
            files |= _arrays(
                [name for name in wanted if name not in files], path.parent, self.top(), self.allow_outside
            )
        absent = [name for name in wanted if name not in files]
        if absent:
            log.warning(
                "%s: of %d files (%s) %d are missing or are not pictures: %s",
                path,
                len(wanted),
                key,
                len(absent),
                listed(absent, 3),
            )
        return [None if name is None else files.get(name) for name in names]


def _arrays(names: list[str], folder: Path, root: Path, outside: bool) -> dict[str, Path]:
    """Return the NumPy files that may be depth maps."""
    paths = {name: folder / name.replace("\\", "/") for name in names if name.lower().endswith(".npy")}
    return {
        name: path
        for name, path in paths.items()
        if os.path.isfile(path) and (outside or Path(os.path.abspath(path)).is_relative_to(os.path.abspath(root)))
    }


def _files_in(folder: Path) -> list[Path]:
    """Return transforms.json, or else all files that form one capture: its splits or its parts."""
    for name in ("transforms.json", "transform.json"):
        if os.path.isfile(folder / name):
            return [folder / name]
    found = [path for path in sorted(folder.glob("transform*_*.json")) if os.path.isfile(path)]
    order = {name: number for number, name in enumerate(SPLITS)}
    return sorted(found, key=lambda path: (order.get(_split_of(path), len(order)), path.name))


def _split_of(path: Path) -> str:
    return path.stem.rpartition("_")[2]


def _points(files: list[FrameFile], root: Path, outside: bool) -> Float[Tensor, "points 3"]:
    """Return the points of `ply_file_path` (nerfstudio), or none."""
    none = torch.zeros(0, 3, dtype=torch.float64)
    file = next((file for file in files if file.content.get("ply_file_path")), None)
    if file is None:
        return none
    name = file.content["ply_file_path"]
    path = file.path.parent / path_of(name, "ply_file_path", str(file.path)).replace("\\", "/")
    if not os.path.isfile(path) or not (outside or Path(os.path.abspath(path)).is_relative_to(os.path.abspath(root))):
        path = root / path.name
    if not os.path.isfile(path):
        log.warning("%s: the points of ply_file_path=%s are missing, and are left out", file.path, name)
        return none
    try:
        return torch.from_numpy(read_ply_points(path).positions)
    except InputError as error:
        log.warning("%s: the points of ply_file_path are left out. %s", file.path, error)
        return none


def _splits_of_files(paths: list[Path], counts: list[int]) -> dict[str, tuple[int, ...]] | None:
    """Return the splits by the files' names; other files are for training."""
    splits: dict[str, tuple[int, ...]] = {split: () for split in SPLITS}
    start = 0
    for path, count in zip(paths, counts, strict=True):
        split = _split_of(path) if _split_of(path) in SPLITS else "train"
        splits[split] += tuple(range(start, start + count))
        start += count
    return splits if splits["val"] or splits["test"] else None


def _splits(file: FrameFile, frames: list[FoundFrame]) -> dict[str, tuple[int, ...]] | None:
    """Return the splits that the file names, or those of folders called train and test."""
    content, path = file.content, file.path
    lists = {split: content[f"{split}_filenames"] for split in SPLITS if f"{split}_filenames" in content}
    if not lists:
        lists = {
            split: [each.view.name for each in frames if split in PurePosixPath(_plain(each.name)).parts[:-1]]
            for split in SPLITS
        }
        if not lists["train"] or not (lists["val"] or lists["test"]):
            return None
    # As written in the frames, too: without an extension, say.
    numbers = {name: n for n, each in enumerate(frames) for name in (each.view.name, _plain(each.name))}
    listed_at_all = {_plain(frame.get("file_path")) for frame in file.frames if isinstance(frame, dict)}
    splits: dict[str, tuple[int, ...]] = {}
    for split in SPLITS:
        names = lists.get(split, [])
        if not isinstance(names, list) or not all(isinstance(name, str) for name in names):
            raise InputError(f"{path}: {split}_filenames must be a list of file names. Fix it, or remove it.")
        lost = [name for name in names if _plain(name) not in numbers and _plain(name) not in listed_at_all]
        if lost:
            log.warning("%s: %s_filenames lists %s, which no frame has; these are ignored", path, split, listed(lost))
        splits[split] = tuple(dict.fromkeys(numbers[_plain(name)] for name in names if _plain(name) in numbers))
    if "train" not in lists:
        held = {*splits["val"], *splits["test"]}
        splits["train"] = tuple(number for number in range(len(frames)) if number not in held)
    unused = [each.view.name for number, each in enumerate(frames) if all(number not in splits[key] for key in SPLITS)]
    if unused:
        log.warning(
            "%s: %d of %d views are in no split, and are not used: %s",
            path,
            len(unused),
            len(frames),
            listed(unused, 3),
        )
    return splits


def _plain(name: object) -> str:
    return PurePosixPath(str(name).replace("\\", "/")).as_posix()


def _ngp_box(content: dict[str, Any], where: str) -> Float[Tensor, "2 3"] | None:
    """Return the box of instant-ngp's `aabb_scale`: in its own units, a cube of that size around 0.5.

    Its positions are `scale` times the file's, plus `offset`; the defaults are 0.33 and 0.5.
    """
    if "aabb_scale" not in content:
        return None
    size, scale = positive_of(content, "aabb_scale", where), positive_of(content, "scale", where, NGP_SCALE)
    offset = content.get("offset", 0.5)
    offset = offset if isinstance(offset, list) else [offset] * 3
    if len(offset) != 3:
        raise InputError(f"{where}: offset is {offset!r}, but must be three numbers. Remove it, or export again.")
    numbers = [number_of({"offset": number}, "offset", where) for number in offset]
    middle, half = (0.5 - torch.tensor(numbers, dtype=torch.float64)) / scale, 0.5 * size / scale
    return torch.stack([middle - half, middle + half])


def _undo_of(files: list[FrameFile]) -> Float[Tensor, "4 4"]:
    """Return the transform of all files' poses into their original frame, which must be the same."""
    undo, *others = (_undo(file.content, str(file.path)) for file in files)
    for file, other in zip(files[1:], others, strict=True):
        if not torch.allclose(undo, other):
            raise InputError(
                f"{files[0].path} and {file.path} differ in applied_transform or applied_scale, so their poses are in "
                "two frames. Read one of them with scene.file=NAME, or export both together."
            )
    return undo


def _undo(content: dict[str, Any], where: str) -> Float[Tensor, "4 4"]:
    """Invert nerfstudio's `applied_transform` and `applied_scale`: results align with the poses' source.

    In the file's poses, the transform was applied to the camera, and then the scale to its center.
    """
    applied = torch.eye(4, dtype=torch.float64)
    if "applied_transform" in content:
        applied[:3] = pose_from_matrix(content["applied_transform"], f"{where}: applied_transform")
        if not is_rigid(applied[:3] / unit_of(applied)):
            raise InputError(
                f"{where}: applied_transform must be a rotation, a shift and the same scale along all axes. Fix it, or "
                "remove it."
            )
    applied[:3] *= length_of(content, "applied_scale", where, 1.0)
    return torch.linalg.inv(applied)

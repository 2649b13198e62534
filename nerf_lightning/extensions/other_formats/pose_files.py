"""Captures with one file per pose: ScanNet, 7-Scenes, 12-Scenes, BundleFusion, MVSNet, 3D Scanner App.

Each has a function that reads such a file, and a row in `LAYOUTS`.
"""

import logging
import re
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from pathlib import Path

from nerf_lightning.data.captures.capture import Capture
from nerf_lightning.data.captures.checks import pose_from_matrix
from nerf_lightning.data.captures.find_pictures import pictures_below, pictures_by_stem
from nerf_lightning.extensions.other_formats.posed import (
    Format,
    Intrinsics,
    Pose,
    Posed,
    PosedReader,
    Size,
    from_opencv,
    from_world_to_camera,
    numbers,
)
from nerf_lightning.extensions.other_formats.text_poses import first_numbers, intrinsics_of
from nerf_lightning.files.json_files import mapping, read_json
from nerf_lightning.files.regular import read_text
from nerf_lightning.files.signatures import Signature
from nerf_lightning.messages.errors import InputError

CURE = "Copy it again."
MVSNET = re.compile(r"\s*extrinsic\s+((?:\S+\s+){16})intrinsic\s+((?:\S+\s+){8}\S+)")
INFO = r"m_%s\s*=\s*([-+.\deE \t]+)"
"""Matches values of the color camera in info.txt."""

log = logging.getLogger(__name__)


@dataclass(frozen=True)
class Layout:
    """Where a program stores its poses and pictures, as patterns below a folder."""

    program: str
    signature: Signature
    poses: str
    """Of the files of poses; * is their name."""
    pictures: tuple[str, ...]
    """Of a picture without extension, where {} is its pose's name; the first one whose folder has pictures is used."""
    camera: Callable[[PosedReader, Path, Size], tuple[Pose, Intrinsics]]
    """Reads the file of a pose, whose picture has (width, height) pixels."""
    depth: str | None = None
    """Of the depth maps that belong to the poses, in millimeters."""
    more_poses: bool = False
    """Whether there are poses whose picture was not kept."""


def _scannet(reader: PosedReader, path: Path, size: Size) -> tuple[Pose, Intrinsics]:
    """Read camera to world; all share the color camera's matrix."""
    matrix = first_numbers(path.parent.parent / "intrinsic" / "intrinsic_color.txt")
    (fx, fy, cx, cy), size = intrinsics_of(matrix, (int(size[0]), int(size[1])))
    return from_opencv(first_numbers(path)[:16], str(path)), Intrinsics((fx, fy), (cx, cy), size)


def _seven_scenes(reader: PosedReader, path: Path, size: Size) -> tuple[Pose, Intrinsics]:
    """Read camera to world; 12-Scenes and BundleFusion have the intrinsics in info.txt."""
    pose = from_opencv(first_numbers(path)[:16], str(path))
    info = next((file for folder in path.parents[:2] if (file := folder / "info.txt").is_file()), None)
    if info is None:
        return pose, reader.user_intrinsics("7-Scenes", size)
    text, found = read_text(info, "text", CURE), list[list[float]]()
    for key, counts in (("calibrationColorIntrinsic", 16), ("colorWidth", 1), ("colorHeight", 1)):
        match = re.search(INFO % key, text)
        found.append(numbers(match[1].split() if match else None, counts, f"{info}: m_{key}"))
    matrix, (width,), (height,) = found
    return pose, Intrinsics((matrix[0], matrix[5]), (matrix[2], matrix[6]), (width, height))


def _mvsnet(reader: PosedReader, path: Path, size: Size) -> tuple[Pose, Intrinsics]:
    """Read world to camera, and the camera's matrix."""
    match = MVSNET.match(read_text(path, "text", CURE))
    if match is None:
        raise InputError(f"{path} does not hold the matrices extrinsic and intrinsic, as MVSNet has them. {CURE}")
    pose, matrix = numbers(match[1].split(), 16, str(path)), numbers(match[2].split(), 9, str(path))
    return from_world_to_camera(pose, str(path)), Intrinsics((matrix[0], matrix[4]), (matrix[2], matrix[5]), size)


def _scanner_app(reader: PosedReader, path: Path, size: Size) -> tuple[Pose, Intrinsics]:
    """Read ARKit's camera to world, with axes right, up, back like ours, and the camera's matrix."""
    said = mapping(read_json(path))
    pose = numbers(said.get("cameraPoseARFrame"), 16, f"{path}: cameraPoseARFrame")
    matrix = numbers(said.get("intrinsics"), 9, f"{path}: intrinsics")
    intrinsics = Intrinsics((matrix[0], matrix[4]), (matrix[2], matrix[5]), size)
    return pose_from_matrix(pose, str(path)), intrinsics


LAYOUTS = (
    Layout("ScanNet", ("intrinsic/intrinsic_color.txt", ""), "pose/*.txt", ("color/{}",), _scannet),
    Layout("7-Scenes or BundleFusion", ("*.pose.txt", ""), "*.pose.txt", ("{}.color",), _seven_scenes),
    Layout(
        "MVSNet",
        ("cams/*_cam.txt", r"\A\s*extrinsic"),
        "cams/*_cam.txt",
        ("images/{}", "blended_images/{}"),
        _mvsnet,
    ),
    Layout(
        "3D Scanner App",
        ("frame_*.json", '"cameraPoseARFrame"'),
        "frame_*.json",
        ("frame_{}",),
        _scanner_app,
        depth="depth_{}.png",
        more_poses=True,
    ),
)


def _read(layout: Layout, reader: PosedReader, first: Path) -> Capture:
    """Return the photographs, sorted by the names of their poses."""
    root = reader.folder()
    if not layout.depth:
        log.info("%s: depth maps are not read", root)
    pictures = next((each for each in layout.pictures if pictures_below((root / each).parent)), layout.pictures[0])
    before, _, behind = layout.poses.rpartition("/")[2].partition("*")
    paths = sorted(path for path in root.glob(layout.poses) if not path.name.startswith("."))
    names = {path: pictures.format(path.name.removeprefix(before).removesuffix(behind)) for path in paths}
    if layout.more_poses:
        there = pictures_by_stem((root / pictures).parent)
        paths = [path for path in paths if Path(names[path]).name in there]

    def posed(path: Path, _: str) -> Posed:
        depth = path.with_name(layout.depth.format(path.stem.removeprefix(before))) if layout.depth else None
        return Posed(names[path], str(path), lambda size: layout.camera(reader, path, size), depth)

    items = {path.relative_to(root).as_posix(): path for path in paths}
    return reader.posed(root / Path(layout.poses).parent, items, posed, root)


FORMATS = tuple(
    Format(layout.program, (layout.signature,), partial(_read, layout), one_each=True) for layout in LAYOUTS
)

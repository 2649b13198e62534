"""Captures with all poses in one text file: TUM, Replica, Tanks and Temples, RealEstate10K, Stray Scanner.

Each has a function that reads its lines, and a row in `FORMATS`. Poses are camera to world with axes right, down,
forward, except RealEstate10K's.
"""

import logging
from bisect import bisect_left
from pathlib import Path

import torch

from nerf_lightning.data.captures.capture import Capture
from nerf_lightning.data.captures.find_pictures import numeric_order, pictures_below
from nerf_lightning.extensions.other_formats.posed import (
    Format,
    Intrinsics,
    Pose,
    Posed,
    PosedReader,
    Size,
    from_opencv,
    from_world_to_camera,
    number,
    numbers,
)
from nerf_lightning.files.json_files import mapping, read_json
from nerf_lightning.files.made_folders import file_name
from nerf_lightning.files.regular import read_text
from nerf_lightning.messages.errors import InputError
from nerf_lightning.messages.escaping import listed
from nerf_lightning.nerf.geometry.poses import rotation_from_quaternion

CURE = "Copy it again."
NUMBER = r"[-+]?[\d.]+(?:[eE][-+]?\d+)?"
LINE_OF = rf"[ \t]*{NUMBER}(?:[ \t]+{NUMBER}){{%d}}[ \t]*\r?(?:\n|\Z)"
"""A regular expression of a line of one number and %d more."""
NEAR_IN_TIME = 0.02
"""Maximum seconds between a picture and its pose, as in TUM's own tool."""
log = logging.getLogger(__name__)


def _tum(reader: PosedReader, path: Path) -> Capture:
    """Read time, position and quaternion x y z w per line, for the pictures of rgb.txt (time, name)."""
    reader.user_intrinsics("TUM")
    poses = sorted((row[0], row) for words in _lines(path).values() if len(row := _floats(words)) == 8)
    times = [time for time, _ in poses]

    def posed(words: list[str], where: str) -> Posed:
        if len(words) < 2:
            raise InputError(f"{where} must be a time and a picture. {CURE}")
        (time,) = numbers(words[0], 1, where)
        after = bisect_left(times, time)
        near = min(poses[max(after - 1, 0) : after + 1], key=lambda pose: abs(pose[0] - time), default=None)

        def camera(size: Size) -> tuple[Pose, Intrinsics]:
            if near is None or abs(near[0] - time) > NEAR_IN_TIME:
                raise InputError(f"{where} has no pose within {NEAR_IN_TIME:g} s. Remove it, or record its pose.")
            return _from_quaternion(near[1][1:4], near[1][4:], where), reader.user_intrinsics("TUM", size)

        return Posed(words[1], where, camera)

    pictures = path.parent / "rgb.txt"
    return reader.posed(pictures, _lines(pictures), posed, path.parent)


def _replica(reader: PosedReader, path: Path) -> Capture:
    """Read a matrix per line; the number in a picture's name is its line, from 0."""
    params = next((file for folder in path.parents[:2] if (file := folder / "cam_params.json").is_file()), None)
    said = None if params is None else mapping(mapping(read_json(params)).get("camera"))
    lines = list(_lines(path).values())

    def posed(picture: Path, where: str) -> Posed:
        index = int("".join(filter(str.isdecimal, picture.stem)) or -1)

        def camera(size: Size) -> tuple[Pose, Intrinsics]:
            if not 0 <= index < len(lines):
                raise InputError(f"{where}: {picture.name} has no line in {path.name}, which has {len(lines)}. {CURE}")
            pose = from_opencv(numbers(lines[index], 16, f"{where}, line {index + 1}"), f"{where}, line {index + 1}")
            if said is None:
                return pose, reader.user_intrinsics("Replica without cam_params.json", size)
            w, h, fx, fy, cx, cy = (number(said, key, str(params)) for key in ("w", "h", "fx", "fy", "cx", "cy"))
            return pose, Intrinsics((fx, fy), (cx, cy), (w, h))

        depth = picture.with_name(picture.name.replace("frame", "depth")).with_suffix(".png")
        return Posed(picture.name, where, camera, depth if "frame" in picture.name else None)

    folder = reader.pictures()
    pictures = {path.name: path for path in pictures_below(folder) if not path.name.startswith("depth")}
    scale = number(said, "scale", str(params), 1000.0) if said is not None else 1000.0
    if not scale > 0:
        raise InputError(f"{params}: scale is {scale:g}, but it must be above 0. {CURE}")
    return reader.posed(path, pictures, posed, folder, depth_unit=1.0 / scale)


def _tanks(reader: PosedReader, path: Path) -> Capture:
    """Read blocks of three numbers and a matrix, one per picture, in order."""
    lines, names = list(_lines(path).values()), _in_order(reader.pictures())
    reader.user_intrinsics("Tanks and Temples")
    if len(lines) != 5 * len(names):
        raise InputError(
            f"{path} of Tanks and Temples has {len(lines) / 5:g} poses, but {reader.pictures()} has {len(names)} "
            "pictures, and both belong together in order. Copy those that are missing."
        )

    def posed(index: int, where: str) -> Posed:
        rows = lines[5 * index + 1 : 5 * index + 5]
        return Posed(
            names[index],
            where,
            lambda size: (
                from_opencv(numbers(rows, 16, where), where),
                reader.user_intrinsics("Tanks and Temples", size),
            ),
        )

    return reader.posed(path, {f"pose {index}": index for index in range(len(names))}, posed, reader.pictures())


def _real_estate(reader: PosedReader, path: Path) -> Capture:
    """Read time, fx, fy, cx, cy as shares of width and height, two zeros, and a world to camera matrix per line."""

    def posed(words: list[str], where: str) -> Posed:
        def camera(size: Size) -> tuple[Pose, Intrinsics]:
            _, fx, fy, cx, cy, k1, k2, *matrix = numbers(words, 19, where)
            width, height = size
            focal, center = (fx * width, fy * height), (cx * width, cy * height)
            return from_world_to_camera(matrix, where), Intrinsics(
                focal, center, size, "radial_tangential", (k1, k2, 0.0, 0.0, 0.0, 0.0)
            )

        return Posed(words[0], where, camera)

    lines = {place: words for place, words in _lines(path).items() if "://" not in words[0]}
    return reader.posed(path, lines, posed, reader.pictures(path.stem))


def _stray(reader: PosedReader, path: Path) -> Capture:
    """Read a CSV of frames with position, quaternion and, in later versions, intrinsics; depths are in millimeters."""
    root, folder = path.parent, reader.pictures()
    if not pictures_below(folder) or folder == root:
        raise InputError(
            f"{root} of Stray Scanner holds a video and no pictures. Take them out of it in this folder: mkdir rgb && "
            "ffmpeg -i rgb.mp4 -fps_mode passthrough -start_number 0 -q:v 2 rgb/%06d.jpg"
        )
    header, *rows = (line.split(",") for line in read_text(path, "text", CURE).splitlines())
    keys = [key.strip() for key in header]
    matrix = root / "camera_matrix.csv"
    shared = numbers(_floats(" ".join(" ".join(words) for words in _lines(matrix).values()).split()), 9, str(matrix))
    if (root / "confidence").is_dir():
        log.info("%s: the confidence of depths is not used", root)

    def posed(cells: list[str], where: str) -> Posed:
        said = {key: cell.strip() for key, cell in zip(keys, cells, strict=False) if cell.strip()}

        def camera(size: Size) -> tuple[Pose, Intrinsics]:
            position = [number(said, key, where) for key in ("x", "y", "z")]
            pose = _from_quaternion(position, [number(said, key, where) for key in ("qx", "qy", "qz", "qw")], where)
            defaults = {"fx": shared[0], "fy": shared[4], "cx": shared[2], "cy": shared[5]}
            fx, fy, cx, cy = (number(said, key, where, value) for key, value in defaults.items())
            return pose, Intrinsics((fx, fy), (cx, cy), size)

        return Posed(str(said.get("frame")), where, camera, root / "depth" / file_name(str(said.get("frame")), ".png"))

    found = {f"line {index}": cells for index, cells in enumerate(rows, start=2) if "".join(cells).strip()}
    return reader.posed(path, found, posed, folder)


def _from_quaternion(position: list[float], xyzw: list[float], where: str) -> Pose:
    """Return the pose from a position and a camera-to-world quaternion x, y, z, w."""
    x, y, z, w = xyzw
    rotation = rotation_from_quaternion(torch.tensor([w, x, y, z], dtype=torch.float64))
    return from_opencv(torch.cat([rotation, torch.tensor(position, dtype=torch.float64)[:, None]], dim=1), where)


def _lines(path: Path) -> dict[str, list[str]]:
    """Return the words of each non-empty line, by its place; lines that begin with # are skipped."""
    lines = enumerate(read_text(path, "text", CURE).splitlines(), start=1)
    found = {f"line {index}": line.replace(",", " ").split() for index, line in lines if not line.startswith("#")}
    return {place: words for place, words in found.items() if words}


def _floats(words: list[str]) -> list[float]:
    try:
        return [float(word) for word in words]
    except ValueError:
        return []


def _in_order(folder: Path) -> list[str]:
    """Return the pictures sorted by name, relative to their folder."""
    names = [path.relative_to(folder).as_posix() for path in pictures_below(folder)]
    if numeric_order(names) != names:
        raise InputError(
            f"{folder}: the order of the pictures as text ({listed(names, 3)}) is not that of their numbers, and "
            "poses belong to them in order. Call them 001, 002, ..."
        )
    return names


FORMATS = (
    Format("Stray Scanner", (("odometry.csv", r"\A\s*timestamp\s*,\s*frame\b"),), _stray),
    Format("Replica", (("traj.txt", r"\A" + LINE_OF % 15),), _replica),
    Format("Replica (Semantic-NeRF)", (("traj_w_c.txt", r"\A" + LINE_OF % 15),), _replica),
    Format("TUM", (("groundtruth.txt", r"(?m)^" + LINE_OF % 7),), _tum),
    Format("Tanks and Temples", (("*.log", r"\A" + LINE_OF % 2 + f"(?:{LINE_OF % 3}){{4}}"),), _tanks),
    Format("RealEstate10K", (("*.txt", r"\A\s*https?://\S+\s*\n" + LINE_OF % 18),), _real_estate),
)

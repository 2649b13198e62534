"""sdfstudio's `meta_data.json`: a matrix and intrinsics for each frame."""

import logging
from functools import partial
from pathlib import Path

import torch

from nerf_lightning.data.captures.capture import Capture
from nerf_lightning.data.readers.json_frames import path_of
from nerf_lightning.extensions.other_formats.posed import (
    Format,
    Intrinsics,
    Pose,
    Posed,
    PosedReader,
    Size,
    entries,
    from_opencv,
    number,
    numbered,
    numbers,
    similarity,
)
from nerf_lightning.files.json_files import keys_of, read_json
from nerf_lightning.messages.errors import InputError
from nerf_lightning.messages.escaping import listed

KEYS = ("rgb_path", "camtoworld", "intrinsics")
NOT_READ = ("mono_depth_path", "mono_normal_path", "sensor_depth_path", "foreground_mask")

log = logging.getLogger(__name__)


def _read(reader: PosedReader, path: Path) -> Capture:
    """Read sdfstudio's frames. `worldtogt` transforms their frame into the one of the capture's author."""
    content = read_json(path)
    frames = entries(content, "frames", f"{path} of sdfstudio")
    beside = sorted({key for frame in frames if isinstance(frame, dict) for key in NOT_READ if frame.get(key)})
    if beside:
        log.warning("%s: %s of the frames are not read", path, listed(beside))
    undo = similarity(content.get("worldtogt", torch.eye(4).tolist()), f"{path}: worldtogt")
    whole = [number(content, side, str(path), 0) for side in ("width", "height")]
    size = (whole[0], whole[1]) if min(whole) > 0 else None
    return reader.posed(path, numbered("frames", frames), partial(_posed, size), path.parent, undo=undo)


def _posed(size: Size | None, frame: object, where: str) -> Posed:
    name, matrix, intrinsics = keys_of(frame, KEYS, where, "sdfstudio")

    def camera(picture: Size) -> tuple[Pose, Intrinsics]:
        if not isinstance(intrinsics, list) or len(intrinsics) not in (3, 4):
            raise InputError(f"{where}: intrinsics must be a 3 x 3 or 4 x 4 matrix. Export the file again.")
        rows = numbers(intrinsics, len(intrinsics) ** 2, f"{where}: intrinsics")
        across = len(intrinsics)
        focal, center = (rows[0], rows[across + 1]), (rows[2], rows[across + 2])
        return from_opencv(matrix, f"{where}: camtoworld"), Intrinsics(focal, center, size or picture)

    return Posed(path_of(name, "rgb_path", where), where, camera)


FORMAT = Format("sdfstudio", (("meta_data.json", '"(camtoworld|worldtogt|has_mono_prior|rgb_path)"'),), _read)

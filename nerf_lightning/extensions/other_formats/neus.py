"""Captures of NeuS and IDR (DTU, BlendedMVS): `cameras_sphere.npz` next to `image/` and `mask/`."""

import logging
import re
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float
from numpy import ndarray
from torch import Tensor

from nerf_lightning.data.captures.capture import Capture, View
from nerf_lightning.data.captures.find_pictures import (
    PICTURE_FOLDERS,
    first_with_pictures,
    numeric_order,
    pictures_below,
)
from nerf_lightning.data.captures.left_out import LeftOut
from nerf_lightning.data.captures.reader import CaptureReader
from nerf_lightning.data.pixels.decoded_photographs import Photograph
from nerf_lightning.data.pixels.picture_files import read_header
from nerf_lightning.files.budgets import require_within
from nerf_lightning.files.numpy_files import open_npz
from nerf_lightning.messages.errors import InputError
from nerf_lightning.messages.escaping import listed
from nerf_lightning.nerf.geometry.poses import flip_yz

FILES = ("cameras_sphere.npz", "cameras.npz", "cameras_large.npz")
CURE = "Copy the file again."

log = logging.getLogger(__name__)


@dataclass
class NeusReader(CaptureReader):
    """Read projection matrices `world_mat_N`; `scale_mat_N` maps the unit cube to the content's bounding box.

    The photographs, sorted by name, correspond to the matrices. `scene.masks=mask` uses the masks.

    Args:
        images: the folder of the photographs below root; null: image, images or rgb.
    """

    name: str = "neus"
    images: str | None = None

    @classmethod
    def found_in(cls, folder: Path) -> str | None:
        """Return the file by which this format is recognized, if a folder has it."""
        return next((name for name in FILES if (folder / name).is_file()), None)

    def capture(self) -> Capture:
        """Return the photographs, sorted by name."""
        root = self.folder()
        path = root / (self.found_in(root) or FILES[0])
        world, scale = _matrices(path)
        folder = first_with_pictures(root, [self.images] if self.images else PICTURE_FOLDERS) or root
        names = [path.relative_to(folder).as_posix() for path in pictures_below(folder)]
        if len(names) != len(world):
            raise InputError(
                f"{path} has {len(world)} cameras, but {folder} has {len(names)} photographs, and both are paired in "
                "the order of their names. Copy those that are missing, or set scene.images to their folder."
            )
        if numeric_order(names) != names:
            log.warning(
                "%s: the names of the photographs in text order (%s), in which NeuS reads them, are not in order of "
                "their numbers. If renderings are blurred, call them 001, 002, ...",
                *(path, listed(names, 3)),
            )
        left_out, views = LeftOut(str(path)), []
        for name, number in zip(names, sorted(world), strict=True):
            with left_out.unless_usable(name):
                views.append(_view(folder / name, name, world[number][:3], f"{path}: world_mat_{number}"))
        left_out.require_enough(len(views))
        return Capture(tuple(views), path, box=_box(scale), left_out=left_out)


def _matrices(path: Path) -> tuple[dict[int, Float[ndarray, "4 4"]], dict[int, Float[ndarray, "4 4"]]]:
    """Return the world and the scale matrices by number."""
    with open_npz(path, CURE) as archive:
        found: dict[str, dict[int, ndarray]] = {"world": {}, "scale": {}}
        wanted = [match for key in archive if (match := re.fullmatch(r"(world|scale)_mat_(\d{1,9})", key))]
        require_within("views", len(wanted) // 2, path, "views")
        for match in wanted:
            if np.shape(matrix := archive[match[0]]) == (4, 4):
                found[match[1]][int(match[2])] = np.asarray(matrix, np.float64)
    if not found["world"]:
        raise InputError(
            f"{path} holds no world_mat_0, world_mat_1, ... of 4 x 4 numbers, as NeuS and IDR have. {CURE}"
        )
    return found["world"], found["scale"]


def _view(picture: Path, name: str, projection: Float[ndarray, "3 4"], where: str) -> View:
    intrinsics, rotation, center = _decomposed(projection, where)
    header = read_header(picture)
    width, height = header.size
    c2w = torch.from_numpy(np.concatenate([rotation.T, center[:, None]], axis=1))
    return View(
        name=name,
        photograph=Photograph(picture, header=header),
        c2w=flip_yz(c2w),
        focal=(float(intrinsics[0, 0]), float(intrinsics[1, 1])),
        center=(float(intrinsics[0, 2]), float(intrinsics[1, 2])),
        size=(float(width), float(height)),
    )


def _decomposed(
    projection: Float[ndarray, "3 4"], where: str
) -> tuple[Float[ndarray, "3 3"], Float[ndarray, "3 3"], Float[ndarray, "3"]]:
    """Return K, R (world to camera) and the center of P = K [R | -R c], by an RQ decomposition."""
    flipped = np.flipud(projection[:, :3]).T
    if not np.isfinite(projection).all() or abs(np.linalg.det(flipped)) < 1e-12:
        raise InputError(f"{where} is not a projection: it holds NaN or infinity, or is singular. {CURE}")
    q, r = np.linalg.qr(flipped)
    k, rotation = np.flipud(np.fliplr(r.T)), np.flipud(q.T)
    signs = np.sign(np.diag(k))
    k, rotation = k * signs, signs[:, None] * rotation
    if np.linalg.det(rotation) < 0:  # P and -P are the same projection
        rotation = -rotation
    return k / k[2, 2], rotation, -np.linalg.solve(projection[:, :3], projection[:, 3])


def _box(scale: dict[int, Float[ndarray, "4 4"]]) -> Float[Tensor, "2 3"] | None:
    """Return the corners of the box around the unit ball that contains the content; they are the same in all views."""
    if not scale:
        return None
    first = torch.from_numpy(scale[min(scale)])
    half, center = first[:3, :3].abs().amax(), first[:3, 3]
    return torch.stack([center - half, center + half]) if bool(torch.isfinite(first).all() and half > 0) else None

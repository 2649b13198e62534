"""The LLFF format: `poses_bounds.npy` next to folders of photographs (images, or shrunk ones such as images_4).

Its bounds become near and far in `captures/frame_and_extent.py`.

Which views are held out: `hold_every` in conf/scene_defaults.yaml.
"""

import logging
import os
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np
import torch
from jaxtyping import Float
from numpy import ndarray

from nerf_lightning.data.captures.capture import Capture, View
from nerf_lightning.data.captures.find_pictures import PICTURE_FOLDERS, numeric_order, pictures_by_stem
from nerf_lightning.data.captures.left_out import LeftOut
from nerf_lightning.data.captures.reader import CaptureReader
from nerf_lightning.data.pixels.decoded_photographs import Photograph
from nerf_lightning.data.pixels.picture_files import ENDINGS
from nerf_lightning.files.budgets import require_within
from nerf_lightning.files.numpy_files import read_npy
from nerf_lightning.files.regular import read_text
from nerf_lightning.messages.errors import InputError, require_one_of
from nerf_lightning.messages.escaping import listed

FILE = "poses_bounds.npy"
COLUMNS = 17
CURE = "Make it again with LLFF's imgs2poses, or read the COLMAP model instead (scene=colmap)."

log = logging.getLogger(__name__)


@dataclass
class LlffReader(CaptureReader):
    """Read an LLFF capture. Rows belong to the photographs in order of their names, sorted as text.

    Args:
        images: the folder of photographs below root; null: the first of images, image, rgb, input, root itself and the
            downscaled images_2, images_4 and images_8 that has images.
        order: how names are sorted: as text, like imgs2poses, or by the numbers in them.
    """

    name: str = "llff"
    images: str | None = None
    order: Literal["text", "numbers"] = "text"

    @classmethod
    def found_in(cls, folder: Path) -> str | None:
        """Return the file by which this format is recognized, if a folder has it."""
        return FILE if (folder / FILE).is_file() else None

    def capture(self) -> Capture:
        """Return all views with their bounds."""
        root = self.folder()
        path = root / FILE
        rows = _rows(path)
        asked = [self.images] if self.images else PICTURE_FOLDERS
        folder = next((root / name for name in asked if _pictures_in(root / name)), None)
        if folder is None:
            places = listed((name or "the folder itself" for name in asked), 9)
            raise InputError(f"{root} has no photographs in {places}. Set scene.images to their folder.")
        by_stem = pictures_by_stem(folder)
        names, left_out = [path.name for path in by_stem.values() if path.parent == folder], LeftOut(str(path))
        registered = _registered(root, names)
        if registered and len(registered) == len(rows):
            left_out.without_pose = tuple(name for name in names if name not in registered)
            names = registered
        if len(names) != len(rows):
            raise InputError(
                f"{path} has {len(rows)} poses, but {folder} has {len(names)} photographs, and both are paired in the "
                "order of their names. Remove the photographs that were not registered (or list those that were in "
                "view_imgs.txt, one per line), or add those that are missing."
            )
        names = self._sorted(names, path)
        views = []
        for name, row in zip(names, rows, strict=True):
            matrix = torch.from_numpy(row[:15].reshape(3, 5).copy())
            down, right, back, center = matrix[:, :4].unbind(dim=-1)
            height, width, focal = matrix[:, 4].tolist()
            views.append(
                View(
                    name=name,
                    photograph=Photograph(folder / name),
                    c2w=torch.stack([right, -down, back, center], dim=-1),
                    focal=(focal, focal),
                    center=(width / 2, height / 2),
                    size=(width, height),
                )
            )
        return Capture(views=tuple(views), source=path, bounds=torch.from_numpy(rows[:, 15:]), left_out=left_out)

    def _sorted(self, names: list[str], path: Path) -> list[str]:
        """Return the names in the order of the poses; log if the orders by text and by number differ."""
        require_one_of(("text", "numbers"), **{"scene.order": self.order})
        by_text, by_numbers = sorted(names), numeric_order(names)
        if by_text != by_numbers:
            log.warning(
                "%s: the names of the photographs in text order (%s) and in numeric order (%s) differ, and the poses "
                "do not show which was meant. Reading in %s order; if renderings are blurred, try scene.order=%s",
                *(path, listed(by_text, 3), listed(by_numbers, 3)),
                *(("text", "numbers") if self.order == "text" else ("numeric", "text")),
            )
        return by_text if self.order == "text" else by_numbers


def _pictures_in(folder: Path) -> list[str]:
    """Return the pictures directly in a folder."""
    if not os.path.isdir(folder):
        return []
    return [path.name for path in folder.iterdir() if path.name.lower().endswith(ENDINGS) and path.name[0] != "."]


def _registered(root: Path, names: list[str]) -> list[str]:
    """Return the photographs with poses according to LLFF's view_imgs.txt, or none."""
    path = root / "view_imgs.txt"
    if not path.is_file():
        return []
    wanted = {Path(line.strip()).stem for line in read_text(path, "text", CURE).splitlines()}
    return [name for name in names if Path(name).stem in wanted]


def _rows(path: Path) -> Float[ndarray, "views 17"]:
    """Return a row for each view: a 3 x 5 matrix (down, right, back, center; height, width, focal) and two depths."""
    rows = read_npy(path, CURE)
    if rows.ndim != 2 or rows.shape[1] != COLUMNS or rows.dtype.kind not in "iuf":
        shape = " x ".join(map(str, rows.shape)) or "a single number"
        raise InputError(
            f"{path} is {shape} of {rows.dtype}, but each view needs one row of {COLUMNS} numbers: a 3 x 5 matrix and "
            f"two depths. {CURE}"
        )
    require_within("views", len(rows), path, "views")
    return np.asarray(rows, dtype=np.float64)

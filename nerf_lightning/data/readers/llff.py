"""The LLFF format: `poses_bounds.npy` beside folders of photographs (images, images_2, images_4, images_8)."""

import os
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float
from numpy import ndarray

from nerf_lightning.data.captures.capture import Capture, View
from nerf_lightning.data.captures.checks import contents
from nerf_lightning.data.captures.reader import CaptureReader, picture_files
from nerf_lightning.data.pixels.decoding import Photograph
from nerf_lightning.files.budgets import require_within
from nerf_lightning.files.numpy_files import HEADER_BYTES, array_header
from nerf_lightning.files.regular import open_regular
from nerf_lightning.messages.errors import InputError

COLUMNS = 17
MOST_BYTES = 1 << 28
"""A hundred thousand views take a twentieth."""
CURE = "Make it again with LLFF's imgs2poses, or read the COLMAP model instead (scene=colmap)."


@dataclass
class LlffReader(CaptureReader):
    """Read an LLFF capture. Rows belong to the photographs in order of their names, sorted as text.

    Args:
        images: the folder of photographs below root; null takes the least shrunk of images, images_2, images_4 and
            images_8 that is there.
    """

    name: str = "llff"
    images: str | None = None

    def capture(self) -> Capture:
        """Return all views with their bounds."""
        root = self.folder()
        path = root / "poses_bounds.npy"
        self.require_inside(path)
        rows = _rows(path)
        asked = [self.images] if self.images else ["images", "images_2", "images_4", "images_8"]
        pictures = next((root / name for name in asked if os.path.isdir(root / name)), None)
        if pictures is None:
            raise InputError(f"{root} has no folder {' or '.join(asked)} with the photographs. Set scene.images to it.")
        self.require_inside(pictures, self.images)
        names = picture_files(pictures)
        if len(names) != len(rows):
            raise InputError(
                f"{path} has {len(rows)} poses, but {pictures} has {len(names)} photographs, and they belong together "
                "in order of names. Remove the photographs that were not registered, or add those that are missing."
            )
        views = []
        for name, row in zip(names, rows, strict=True):
            self.require_inside(pictures / name, self.images)
            matrix = torch.from_numpy(row[:15].reshape(3, 5).copy())
            down, right, back, center = matrix[:, :4].unbind(dim=-1)
            height, width, focal = matrix[:, 4].tolist()
            views.append(
                View(
                    name=name,
                    photograph=Photograph(pictures / name, self.mask_of(name)),
                    c2w=torch.stack([right, -down, back, center], dim=-1),
                    focal=(focal, focal),
                    center=(width / 2, height / 2),
                    size=(width, height),
                )
            )
        return Capture(views=tuple(views), source=path, bounds=torch.from_numpy(rows[:, 15:]))


def _rows(path: Path) -> Float[ndarray, "views 17"]:
    """Return a row for each view: a 3 x 5 matrix (down, right, back, centre; height, width, focal) and two depths."""
    if not path.is_file():
        raise InputError(
            f"{path} does not exist; the folder holds {contents(path.parent)}. "
            "Point scene.root at the folder that has it."
        )
    try:
        # Read by its own format: np.load would open archives too, and unpickle what is neither.
        with open_regular(path, MOST_BYTES, CURE) as file:
            # Its size is known before memory is taken, and its header is short.
            array_header(file.read(HEADER_BYTES), os.fstat(file.fileno()).st_size)
            file.seek(0)
            rows = np.lib.format.read_array(file, allow_pickle=False)
    except (OSError, ValueError, EOFError) as error:
        raise InputError(f"{path} is not an array of numbers as numpy saves it ({error}). {CURE}") from error
    if rows.ndim != 2 or rows.shape[1] != COLUMNS or rows.dtype.kind not in "iuf":
        shape = " x ".join(map(str, rows.shape)) or "a single number"
        raise InputError(
            f"{path} is {shape} of {rows.dtype}, but each view needs one row of {COLUMNS} numbers: a 3 x 5 matrix and "
            f"two depths. {CURE}"
        )
    require_within("views", len(rows), str(path), "views")
    return np.asarray(rows, dtype=np.float64)

"""The one-file layout of the tiny Lego scene: `images`, `poses` and `focal` in a NumPy archive.

Near, far, the box and the split: `conf/scene/npz.yaml` and `conf/scene/lego_tiny.yaml`.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Shaped, UInt8

from nerf_lightning.data.captures.capture import Capture, View
from nerf_lightning.data.captures.checks import pose_from_matrix
from nerf_lightning.data.captures.folders import named_folder
from nerf_lightning.data.captures.left_out import LeftOut
from nerf_lightning.data.captures.reader import CaptureReader
from nerf_lightning.data.captures.scene import Coordinates
from nerf_lightning.data.captures.splits import in_order
from nerf_lightning.data.pixels.decoded_photographs import Photograph
from nerf_lightning.data.pixels.picture_files import PictureHeader
from nerf_lightning.files.budgets import require_within
from nerf_lightning.files.download import fetch
from nerf_lightning.files.numpy_files import open_npz
from nerf_lightning.messages.errors import InputError
from nerf_lightning.messages.escaping import listed

KEYS = ("images", "poses", "focal")
LAYOUT = "It needs images (n, height, width, 3), poses (n, 4, 4) camera-to-world and one focal length in pixels."
CURE = f"Remove it, and copy or download it again. {LAYOUT}"


@dataclass(frozen=True, kw_only=True)
class StoredImage(Photograph):
    """One of the images in an archive."""

    image: Shaped[np.ndarray, "height width 3"] = field(compare=False, repr=False)

    def rgba(self) -> UInt8[np.ndarray, "height width 4"]:
        """Return the pixels as opaque 8-bit colors, round(255 x); raise `InputError` for values outside 0..1."""
        image = self.image
        if image.dtype != np.uint8:
            # Written so that NaN fails, too.
            if not ((image >= 0) & (image <= 1)).all():
                raise InputError(
                    f"{self.path}: images[{self.number}] has values outside 0..1 or NaN. Divide 0..255 colors by 255, "
                    "or store them as uint8."
                )
            image = np.rint(image.astype(np.float32) * 255).astype(np.uint8)
        return np.concatenate([image, np.full((*image.shape[:2], 1), 255, np.uint8)], axis=2)


@dataclass
class NpzReader(CaptureReader):
    """Read `images` (n h w 3), `poses` (n 4 4, camera-to-world) and `focal` (pixels) from one file.

    Colors are floating point in 0..1 or uint8. The held-out views are both val and test.

    Args:
        root: the .npz file, if `path` does not name it.
        path: the .npz file.
        hold_every: hold out the first and every k-th view after it; 0 holds out the last ones instead.
        train_fraction: with `hold_every` 0, the share of the views, from the first on, used for training.
        download: where to download a missing file: `url`, `bytes` and `sha256` (None: only its size is checked).
    """

    root: str = ""
    name: str = "npz"
    coordinates: Coordinates = "given"
    near: float | None = 2.0
    far: float | None = 6.0
    aabb_half: float | None = 1.5
    hold_every: int = 0
    path: str | None = None
    train_fraction: float = 0.8
    download: Mapping[str, Any] | None = None

    def __post_init__(self) -> None:
        self.root = self.path or self.root

    def hold_out(self, views: Sequence[int]) -> tuple[tuple[int, ...], tuple[int, ...]]:
        """Return the training views and the held-out views."""
        return super().hold_out(views) if self.hold_every else in_order(views, self.train_fraction)

    def protocol(self, judged_by: str) -> dict[str, str]:
        """Return what measured numbers depend on: which views are the test views."""
        rest = f"after the first {self.train_fraction:.0%}"
        return {"test_views": f"every {self.hold_every}th" if self.hold_every else rest}

    def folder(self) -> Path:
        """Return the folder of the file."""
        return named_folder(self.root)

    def capture(self) -> Capture:
        """Return the views; download the file first if it is missing and a URL is given."""
        path = Path(self.root)
        if self.download and not path.exists():
            fetch(self.download["url"], path, self.download["bytes"], self.download["sha256"])
        images, poses, focal = _load(path)
        _, height, width, _ = images.shape
        left_out, views = LeftOut(str(path)), []
        for number, (image, pose) in enumerate(zip(images, poses, strict=True)):
            with left_out.unless_usable(str(number)):
                views.append(
                    View(
                        name=str(number),
                        photograph=StoredImage(
                            path, number=number, header=PictureHeader((width, height), 1), image=image
                        ),
                        c2w=pose_from_matrix(pose, f"{path}: poses[{number}]"),
                        focal=(focal, focal),
                        center=(width / 2, height / 2),
                        size=(float(width), float(height)),
                    )
                )
        left_out.require_enough(len(views))
        return Capture(tuple(views), path, left_out=left_out)


def _load(path: Path) -> tuple[np.ndarray, np.ndarray, float]:
    """Return images, poses and the focal length; nothing in the file is executed (no pickles)."""
    with open_npz(path, CURE) as archive:
        if missing := [key for key in KEYS if key not in archive]:
            raise InputError(f"{path} lacks {listed(missing)}; it has {listed(archive) or 'nothing'}. {LAYOUT}")
        images, poses, focal = (np.asarray(archive[key]) for key in KEYS)
    if images.ndim != 4 or images.shape[-1] != 3 or 0 in images.shape:
        raise InputError(f"{path}: images has the shape {images.shape}. {LAYOUT}")
    require_within("views", len(images), path, "views")
    if images.dtype != np.uint8 and images.dtype.kind != "f":
        raise InputError(
            f"{path}: images has the type {images.dtype}, but it must be floating point in 0..1, or uint8."
        )
    if poses.ndim == 0 or len(poses) != len(images):
        found = len(poses) if poses.ndim else 1
        raise InputError(
            f"{path} has {len(images)} images but {found} poses; there must be one pose per image. {LAYOUT}"
        )
    if focal.size != 1 or focal.dtype.kind not in "fiu":
        raise InputError(f"{path}: focal must be one number of pixels. {LAYOUT}")
    return images, poses, float(focal.reshape(-1)[0])

"""The one-file layout of the tiny Lego scene: `images`, `poses` and `focal` in a numpy archive."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Shaped

from nerf_lightning.data.captures.capture import Capture, View
from nerf_lightning.data.captures.checks import pose_from_matrix, usable
from nerf_lightning.data.captures.left_out import LeftOut
from nerf_lightning.data.captures.splits import every_kth, in_order
from nerf_lightning.data.pixels.decoding import Photograph
from nerf_lightning.data.pixels.images import area_downscale
from nerf_lightning.data.pixels.store import empty_store
from nerf_lightning.data.readers.base import GivenFrameReader
from nerf_lightning.files.budgets import require_within
from nerf_lightning.files.download import fetch
from nerf_lightning.files.links import is_there
from nerf_lightning.files.numpy_files import open_npz
from nerf_lightning.messages.errors import InputError
from nerf_lightning.messages.escaping import listed
from nerf_lightning.nerf.geometry.cameras import pinhole_cameras, resized
from nerf_lightning.nerf.types.scene import PixelStore, Scene

KEYS = ("images", "poses", "focal")
LAYOUT = "It needs images (n, height, width, 3), poses (n, 4, 4) camera-to-world and one focal length in pixels."
CURE = f"Remove it, and copy or download it again. {LAYOUT}"


@dataclass
class NpzReader(GivenFrameReader):
    """Read `images` (n h w 3), `poses` (n 4 4, camera-to-world) and `focal` (pixels) from one file.

    Colors are floating point in 0..1 or uint8. The held-out views are both val and test.

    Args:
        path: the .npz file.
        hold_every: hold out the first and every k-th view after it; 0 holds out the last ones instead.
        train_fraction: with `hold_every` 0, the share of the views, from the first on, used for training.
        download: where to download a missing file: `url`, `bytes` and `sha256` (None: only its size is checked).
    """

    path: str
    hold_every: int = 0
    train_fraction: float = 0.8
    download: Mapping[str, Any] | None = None
    name: str = field(default="npz", kw_only=True)

    def read(self) -> Scene:
        """Return the capture, downloaded first if it is absent and an address is given.

        Raises:
            InputError: a setting that makes no sense, a failed download, or anything wrong with the file.
        """
        self.check_settings()
        if self.hold_every < 0:
            raise InputError(f"scene.hold_every is {self.hold_every}, but it must be 0 (in order) or more.")
        path = Path(self.path)
        if self.download and not path.exists():
            fetch(self.download["url"], path, self.download["bytes"], self.download["sha256"])
        images, poses, focal = _load(path)
        count, height, width, _ = images.shape
        self.check_divisible(width, height)
        left_out, views = LeftOut(str(path)), []
        for number, pose in enumerate(poses):
            with left_out.unless_usable(str(number)):
                views.append(
                    View(
                        name=str(number),
                        photograph=Photograph(path),
                        c2w=pose_from_matrix(pose, f"{path}: poses[{number}]"),
                        focal=(focal, focal),
                        center=(width / 2, height / 2),
                        size=(float(width), float(height)),
                    )
                )
        views = list(usable(Capture(tuple(views), path, left_out=left_out)).views)
        left_out.say(len(views))
        images, count = images[[int(view.name) for view in views]], len(views)
        cameras = pinhole_cameras(torch.stack([view.c2w for view in views]).float(), focal, width, height)
        if self.hold_every:
            train, held = every_kth(range(count), self.hold_every)
        else:
            train, held = in_order(range(count), self.train_fraction)
        rest = f"after the first {self.train_fraction:.0%}"
        return self.scene(
            resized(cameras, cameras.width // self.downscale, cameras.height // self.downscale),
            _pixels(images, self.downscale, path),
            {"train": train, "val": held, "test": held},
            [view.name for view in views],
            {
                "filter": "none" if self.downscale == 1 else "area",
                "test_views": f"every {self.hold_every}th" if self.hold_every else rest,
            },
            otherwise="black",
        )


def _load(path: Path) -> tuple[np.ndarray, np.ndarray, float]:
    """Return images, poses and the focal length; nothing in the file is executed (no pickles)."""
    if not is_there(path):
        raise InputError(f"The file {path} does not exist. Set scene.path to the .npz file, or copy it there.")
    with open_npz(path, CURE) as archive:
        if missing := [key for key in KEYS if key not in archive]:
            raise InputError(f"{path} lacks {listed(missing)}; it has {listed(archive) or 'nothing'}. {LAYOUT}")
        images, poses, focal = (np.asarray(archive[key]()) for key in KEYS)
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


def _pixels(images: Shaped[np.ndarray, "n h w 3"], downscale: int, path: Path) -> PixelStore:
    """Return the pictures as 8-bit colors, round(255 x), opaque."""
    count, height, width, _ = images.shape
    store = empty_store([(width // downscale, height // downscale)] * count)
    rgba = np.full((height, width, 4), 255, dtype=np.uint8)
    for view, image in enumerate(images):
        if image.dtype != np.uint8:
            # Written so that NaN fails too.
            if not ((image >= 0) & (image <= 1)).all():
                raise InputError(
                    f"{path}: images[{view}] has values outside 0..1 or NaN. Divide 0..255 colors by 255, "
                    "or store them as uint8."
                )
            image = np.rint(image.astype(np.float32) * 255)
        rgba[..., :3] = image
        store.view(view).numpy()[...] = area_downscale(rgba, downscale)
    return store

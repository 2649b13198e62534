"""The one-file layout of the tiny Lego scene: `images`, `poses` and `focal` in a numpy archive."""

import zipfile
import zlib
from collections.abc import Mapping
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Float, Shaped
from torch import Tensor

from nerf_lightning.data.captures.checks import (
    FARTHEST,
    LEAST_FOCAL,
    box_around_origin,
    check_bounds,
    check_divisible,
    check_step,
    impossible_lens,
    pose_from_matrix,
)
from nerf_lightning.data.captures.splits import every_kth, in_order
from nerf_lightning.data.pixels.images import area_downscale
from nerf_lightning.data.pixels.plain_background import background_for, cut_out, protocol_of
from nerf_lightning.data.pixels.store import empty_store
from nerf_lightning.data.readers.base import Reader
from nerf_lightning.files.budgets import require_within
from nerf_lightning.files.download import fetch
from nerf_lightning.files.links import is_there
from nerf_lightning.files.numpy_files import ArrayHeader, archive_headers, check_unpacked, read_member
from nerf_lightning.files.regular import open_regular
from nerf_lightning.messages.errors import InputError
from nerf_lightning.messages.escaping import listed
from nerf_lightning.nerf.geometry.cameras import pinhole_cameras, resized
from nerf_lightning.nerf.types.scene import PixelStore, Scene

KEYS = ("images", "poses", "focal")
LAYOUT = "It needs images (n, height, width, 3), poses (n, 4, 4) camera-to-world and one focal length in pixels."


class NpzReader(Reader):
    """Read `images` (n h w 3), `poses` (n 4 4, camera-to-world) and `focal` (pixels) from one file.

    Colours are floating point in 0..1 or uint8. The held-out views are both val and test.

    Args:
        path: the .npz file.
        near: distance along every ray at which content may begin, scene units.
        far: distance at which content ends.
        background: what lies behind the scene: white, black, random or none. null: black; where a plain background was
            cut out, white_or_random, black_or_random or random, as its colour is. The pictures have no alpha.
        cut_out: where they show a thing before one plain colour, make that transparent.
        hold_every: hold out the first and every k-th view after it; 0 holds out the last ones instead.
        train_fraction: with `hold_every` 0, the share of the views, from the first on, to learn from.
        downscale: whole factor by which the pictures shrink (area filter); the focal length follows.
        aabb_half: half the side of the box around the origin that holds the content, scene units.
        download: where to get an absent file: `url`, `bytes` and `sha256` (None: only its size is checked).
        max_gigabytes: how much the file may unpack to; what is small on the disk may be made to fill the memory.
        name: what the scene is called in reports.
    """

    def __init__(
        self,
        path: str,
        near: float = 2.0,
        far: float = 6.0,
        background: str | None = None,
        cut_out: bool = True,
        hold_every: int = 0,
        train_fraction: float = 0.8,
        downscale: int = 1,
        aabb_half: float = 1.5,
        download: Mapping[str, Any] | None = None,
        max_gigabytes: float = 2.0,
        name: str = "npz",
    ) -> None:
        self.path = Path(path)
        self.near = near
        self.far = far
        self.background = background
        self.cut_out = cut_out
        self.hold_every = hold_every
        self.train_fraction = train_fraction
        self.downscale = downscale
        self.aabb_half = aabb_half
        self.download = download
        self.max_gigabytes = max_gigabytes
        self.name = name

    def read(self) -> Scene:
        """Return the capture, downloaded first if it is absent and an address is given.

        Raises:
            InputError: a setting that makes no sense, a failed download, or anything wrong with the file.
        """
        self._check_settings()
        if self.download and not self.path.exists():
            fetch(self.download["url"], self.path, self.download["bytes"], self.download["sha256"])
        arrays = _load(self.path, self.max_gigabytes)
        images, focal = (
            _checked_images(arrays["images"], self.path),
            _checked_focal(arrays["focal"], self.path),
        )
        c2w = _poses(arrays["poses"], len(images), self.path)
        height, width = images.shape[1:3]
        if reason := impossible_lens((width, height), (focal, focal)):
            raise InputError(f"{self.path}: {reason}. It must be in pixels, not a share of them.")
        check_divisible(width, height, self.downscale)
        train, held = self._split(len(images))
        full = pinhole_cameras(c2w, focal, width, height)
        pixels = _pixels(images, self.downscale, self.path)
        pixels, color = cut_out(pixels, self.name, self.cut_out and self.background != "none")
        return Scene(
            name=self.name,
            cameras=resized(full, full.width // self.downscale, full.height // self.downscale),
            pixels=pixels,
            near=torch.full((len(images),), float(self.near)),
            far=torch.full((len(images),), float(self.far)),
            aabb=box_around_origin(self.aabb_half),
            splits={"train": train, "val": held, "test": held},
            view_names=tuple(str(view) for view in range(len(images))),
            background=background_for(self.background, color, "black"),
            to_user=torch.eye(4),
            protocol=self._protocol() | protocol_of(color),
            truth=None,
        )

    def _check_settings(self) -> None:
        """Refuse settings that make no sense before any file is read."""
        check_step("downscale", self.downscale)
        check_bounds(self.near, self.far)
        background_for(self.background, None, "black")
        if self.hold_every < 0:
            raise InputError(f"scene.hold_every is {self.hold_every}, but it must be 0 (in order) or more.")
        box_around_origin(self.aabb_half)

    def _split(self, count: int) -> tuple[tuple[int, ...], tuple[int, ...]]:
        """Return the views to learn from and the ones held out."""
        if self.hold_every:
            return every_kth(range(count), self.hold_every)
        return in_order(range(count), self.train_fraction)

    def _protocol(self) -> dict[str, str]:
        """Say how the pixels were made and which views are judged."""
        rest = f"after the first {self.train_fraction:.0%}"
        return {
            "downscale": str(self.downscale),
            "filter": "none" if self.downscale == 1 else "area",
            "test_views": f"every {self.hold_every}th" if self.hold_every else rest,
        }


def _load(path: Path, max_gigabytes: float) -> dict[str, np.ndarray]:
    """Return the three arrays; nothing in the file is executed (no pickles)."""
    if not is_there(path):
        raise InputError(f"The file {path} does not exist. Set scene.path to the .npz file, or copy it there.")
    try:
        # What is taken of it is bounded by its headers.
        with open_regular(path, None) as file, zipfile.ZipFile(file) as archive:
            headers = archive_headers(archive, KEYS)
            _check_headers(headers, [Path(name).stem for name in archive.namelist()], path, max_gigabytes)
            return {key: read_member(archive, key) for key in KEYS}
    except zipfile.BadZipFile as error:
        raise InputError(_damaged(path, error)) from error
    except (OSError, ValueError, EOFError, NotImplementedError, RuntimeError, zlib.error) as error:
        raise InputError(_damaged(path, error)) from error


def _damaged(path: Path, error: Exception) -> str:
    with suppress(OSError), open_regular(path, None) as file:
        if file.read(6) == b"\x93NUMPY":
            return f"{path} is not a numpy .npz archive: it holds a single array. {LAYOUT}"
    return f"{path} is not a numpy .npz archive, or is damaged: {error}. Remove it, and copy or download it again."


def _check_headers(headers: dict[str, ArrayHeader], present: list[str], path: Path, max_gigabytes: float) -> None:
    missing = [key for key in KEYS if key not in headers]
    if missing:
        raise InputError(f"{path} lacks {listed(missing)}; it has {listed(present) or 'nothing'}. {LAYOUT}")
    require_within("views", headers["images"].shape[0] if headers["images"].shape else 0, str(path), "views")
    cure = "If you trust it, allow more with scene.max_gigabytes=N; else use another file."
    check_unpacked(path, sum(header.num_bytes for header in headers.values()), 1e9 * max_gigabytes, cure)


def _checked_images(images: Shaped[np.ndarray, "..."], path: Path) -> Shaped[np.ndarray, "n h w 3"]:
    """Refuse images of another shape or type; their values are checked view by view."""
    if images.ndim != 4 or images.shape[-1] != 3 or 0 in images.shape:
        raise InputError(f"{path}: images has the shape {images.shape}. {LAYOUT}")
    if images.dtype != np.uint8 and images.dtype.kind != "f":
        raise InputError(
            f"{path}: images has the type {images.dtype}, but it must be floating point in 0..1, or uint8."
        )
    return images


def _checked_focal(focal: Shaped[np.ndarray, "..."], path: Path) -> float:
    """Return the focal length in pixels."""
    value = float(focal.reshape(-1)[0]) if focal.size == 1 and focal.dtype.kind in "fiu" else 0.0
    if not LEAST_FOCAL <= value <= FARTHEST:
        raise InputError(
            f"{path}: focal must be one number above 0, from {LEAST_FOCAL:g} to {FARTHEST:g} pixels. {LAYOUT}"
        )
    return value


def _poses(poses: Shaped[np.ndarray, "..."], count: int, path: Path) -> Float[Tensor, "views 3 4"]:
    """Return one checked pose per image."""
    if poses.ndim == 0 or len(poses) != count:
        found = len(poses) if poses.ndim else 1
        raise InputError(f"{path} has {count} images but {found} poses; there must be one pose per image. {LAYOUT}")
    return torch.stack([pose_from_matrix(pose, f"{path}: poses[{i}]") for i, pose in enumerate(poses)]).float()


def _pixels(images: Shaped[np.ndarray, "n h w 3"], downscale: int, path: Path) -> PixelStore:
    """Return the pictures as 8-bit colours, round(255 x), opaque."""
    count, height, width, _ = images.shape
    store = empty_store([(width // downscale, height // downscale)] * count)
    rgba = np.full((height, width, 4), 255, dtype=np.uint8)
    for view, image in enumerate(images):
        if image.dtype != np.uint8:
            # Written so that NaN fails too.
            if not ((image >= 0) & (image <= 1)).all():
                raise InputError(
                    f"{path}: images[{view}] has values outside 0..1 or NaN. Divide 0..255 colours by 255, "
                    "or store them as uint8."
                )
            image = np.rint(image.astype(np.float32) * 255)
        rgba[..., :3] = image
        store.view(view).numpy()[...] = area_downscale(rgba, downscale)
    return store

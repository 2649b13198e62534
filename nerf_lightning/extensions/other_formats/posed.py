"""The base of readers with a camera per picture: each names its files and returns a camera for each picture."""

import logging
import math
import os
from collections.abc import Callable, Collection, Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeVar

import torch
from jaxtyping import Float
from torch import Tensor

from nerf_lightning.data.captures.capture import Capture, View, of_one_lens
from nerf_lightning.data.captures.checks import pose_from_matrix
from nerf_lightning.data.captures.find_pictures import PICTURE_FOLDERS, find_pictures, first_with_pictures
from nerf_lightning.data.captures.left_out import LeftOut
from nerf_lightning.data.captures.reader import CaptureReader
from nerf_lightning.data.pixels.decoded_photographs import Photograph
from nerf_lightning.data.pixels.picture_files import read_header
from nerf_lightning.files.budgets import require_within
from nerf_lightning.files.signatures import Signature
from nerf_lightning.files.trust import for_message
from nerf_lightning.messages.errors import InputError
from nerf_lightning.messages.escaping import require_printable
from nerf_lightning.nerf.geometry.poses import flip_yz, is_rigid
from nerf_lightning.nerf.geometry.world_frame import unit_of
from nerf_lightning.nerf.types.scene import LensModel

CURE = "Export it again."

Item = TypeVar("Item")
Size = tuple[float, float]
Pose = Float[Tensor, "3 4"]

log = logging.getLogger(__name__)


@dataclass(frozen=True)
class Intrinsics:
    """A camera's focal lengths and principal point in pixels of `size`, and its lens."""

    focal: tuple[float, float]
    center: tuple[float, float]
    size: Size
    """(width, height)."""
    lens_model: LensModel = "pinhole"
    lens: tuple[float, float, float, float, float, float] = (0.0, 0.0, 0.0, 0.0, 0.0, 0.0)
    """k1, k2, k3, k4, p1, p2."""


@dataclass(frozen=True)
class Posed:
    """One picture with its camera, as in the format."""

    name: str
    """Of the picture."""
    where: str
    """Its place in a file, for messages."""
    camera: Callable[[Size], tuple[Pose, Intrinsics]]
    """Returns the camera to world (right, up, back, center) of a picture of (width, height) pixels, and its intrinsics;
    `InputError` says why there are none."""
    depth: Path | None = None


FOLDERS = (*(name for name in PICTURE_FOLDERS if name), "color", "frames", "results")
"""Of pictures, the likeliest first."""


@dataclass
class PosedReader(CaptureReader):
    """Read pictures with one camera each, as listed by a format.

    Args:
        images: the folder of the pictures below root; null: the format's own.
        intrinsics: fx, fy, cx, cy in pixels of the pictures, for formats without intrinsics.
    """

    images: str | None = None
    intrinsics: list[float] | None = None

    def posed(
        self,
        source: Path,
        items: Mapping[str, Item],
        posed: Callable[[Item, str], Posed],
        folder: Path | None = None,
        root: Path | None = None,
        **more: Any,
    ) -> Capture:
        """Return the capture of all existing pictures with a camera.

        Args:
            source: the file that lists them.
            items: its entries, by their place in it.
            posed: returns the picture of an entry; takes the entry and its place (for messages).
            folder: what names are relative to; None: the usual folder of photographs.
            root: the folder below which pictures are searched for; None: the one that the user named.
            more: further values of `Capture`.
        """
        require_within("views", len(items), source, "views")
        if self.images is not None:
            folder = root = self.below(self.images)
        bases, root = [root or self.folder(), self.top()], root or self.top()
        folder = folder or first_with_pictures(self.folder(), FOLDERS) or root
        left_out, named = LeftOut(str(source)), list[Posed]()
        for place, item in items.items():
            with left_out.unless_usable(place):
                each = posed(item, f"{source}: {place}")
                require_printable(each.name, each.where)
                named.append(each)
        files = find_pictures([each.name for each in named], folder, root, source, self.allow_outside)
        views, kinds = [], list[LensModel]()
        for each in named:
            with left_out.unless_usable(each.name):
                if each.name not in files:
                    raise InputError(self._absent(each, root))
                picture = files[each.name]
                header = read_header(picture)
                width, height = map(float, header.size)
                c2w, camera = each.camera((width, height))
                below = (picture.relative_to(base) for base in bases if picture.is_relative_to(base))
                views.append(
                    View(
                        name=next(below, picture).as_posix(),
                        photograph=Photograph(picture, header=header),
                        c2w=c2w,
                        focal=camera.focal,
                        center=camera.center,
                        size=camera.size,
                        lens=camera.lens,
                        depth=each.depth if each.depth is not None and os.path.isfile(each.depth) else None,
                    )
                )
                is_plain = camera.lens_model == "radial_tangential" and not any(camera.lens)
                kinds.append("pinhole" if is_plain else camera.lens_model)
        left_out.require_enough(len(views))
        return of_one_lens(Capture(tuple(views), source, left_out=left_out, **more), kinds)

    def user_intrinsics(self, program: str, size: Size = (1.0, 1.0)) -> Intrinsics:
        """Return the intrinsics given by the user, for a picture of (width, height) pixels."""
        if self.intrinsics is None or len(self.intrinsics) != 4:
            raise InputError(
                f"{self.root}: {program} has poses without focal lengths. Give fx, fy, cx and cy in pixels of the "
                "pictures: scene=other_program 'scene.intrinsics=[525,525,319.5,239.5]'."
            )
        fx, fy, cx, cy = map(float, self.intrinsics)
        return Intrinsics((fx, fy), (cx, cy), size)

    def pictures(self, likeliest: str = "images") -> Path:
        """Return the folder of the pictures."""
        root = self.folder()
        return first_with_pictures(root, [self.images] if self.images else [likeliest, *FOLDERS]) or root

    def _absent(self, picture: Posed, root: Path) -> str:
        elsewhere = os.path.isabs(picture.name) and os.path.isfile(picture.name)
        cure = ", or add scene.allow_outside=true to read it where it is" if elsewhere else ""
        return f"{picture.where}: no picture below {root} is called {picture.name}. Copy it there{cure}."


@dataclass(frozen=True)
class Format:
    """How to recognize and read captures of a program."""

    program: str
    signatures: tuple[Signature, ...]
    """Of the file that lists the cameras, the likeliest first."""
    read: Callable[[PosedReader, Path], Capture]
    """Returns the content of such a file, in its order."""
    suits: Callable[[Path], bool] = Path.exists
    """Whether a folder with such a file is such a capture."""
    one_each: bool = False
    """Whether such a file belongs to one picture."""


def from_opencv(matrix: object, where: str) -> Pose:
    """Convert camera to world from axes right, down, forward to axes right, up, back."""
    return flip_yz(pose_from_matrix(matrix, where))


def from_world_to_camera(matrix: object, where: str) -> Pose:
    """Convert world to camera with axes right, down, forward to camera to world (right, up, back)."""
    w2c = pose_from_matrix(matrix, where)
    try:
        inverse = torch.linalg.inv(w2c[:, :3])
    except RuntimeError:
        raise InputError(f"{where} has a rotation of determinant 0, so it is no pose. {CURE}") from None
    return flip_yz(torch.cat([inverse, -inverse @ w2c[:, 3:]], dim=1))


def from_rotation_and_center(rotation: list[float], center: list[float], where: str) -> Pose:
    """Return camera to world (right, up, back) from a row-major world-to-camera rotation and the camera's center."""
    matrix = torch.tensor(rotation, dtype=torch.float64).reshape(3, 3).mT
    return from_opencv(torch.cat([matrix, torch.tensor(center, dtype=torch.float64)[:, None]], dim=1), where)


def numbers(value: object, count: int, where: str) -> list[float]:
    """Return the numbers of nested lists, in order; JSON may also contain them as text.

    >>> numbers([[1, 0], ["0.5", 2]], 4, "a.json: matrix")
    [1.0, 0.0, 0.5, 2.0]
    """
    found = list(_flat(value))
    try:
        if len(found) == count and not any(isinstance(each, bool) for each in found):
            return [float(each) for each in found]
    except (TypeError, ValueError, OverflowError):
        pass
    wanted, is_ = (
        "a number" if count == 1 else f"{count} numbers",
        "missing" if value is None else for_message(" ".join(map(str, found))),
    )
    raise InputError(f"{where} must be {wanted}, but it is {is_}. {CURE}")


def number(content: dict[str, Any], key: str, where: str, default: object = None) -> float:
    """Return a number, which JSON may contain as text."""
    (value,) = numbers(content.get(key, default), 1, f"{where}: {key}")
    return value


def entries(content: object, key: str, where: str) -> list[Any]:
    """Return a list in a JSON object."""
    found = content.get(key) if isinstance(content, dict) else None
    if not isinstance(found, list):
        raise InputError(f"{where} must have a list {key}. {CURE}")
    return found


def numbered(key: str, items: list[Item]) -> dict[str, Item]:
    """Return the items of a list in a file, by their place in it.

    >>> numbered("frames", ["a", "b"])
    {'frames[0]': 'a', 'frames[1]': 'b'}
    """
    return {f"{key}[{index}]": item for index, item in enumerate(items)}


def sparse_points(points: Collection[object], path: Path) -> Float[Tensor, "points 3"]:
    """Return points of three numbers each; if one is broken, none, which is logged."""
    require_within("points", len(points), path, "points")
    try:
        rows = [numbers(point, 3, f"{path}: a point") for point in points]
    except InputError as error:
        log.warning("%s: its points are left out. %s", path, error)
        rows = []
    return torch.tensor(rows, dtype=torch.float64).reshape(-1, 3)


def similarity(matrix: object, where: str) -> Float[Tensor, "4 4"]:
    """Return a matrix that rotates, scales uniformly and translates; raise `InputError` for any other."""
    found = torch.eye(4, dtype=torch.float64)
    found[:3] = pose_from_matrix(matrix, where)
    unit = unit_of(found)
    if not (unit > 0 and bool(is_rigid(torch.cat([found[:3, :3] / unit, found[:3, 3:]], dim=1)))):
        raise InputError(f"{where} is not a rotation, a shift and the same scale along all axes. {CURE}")
    return found


def panorama(size: Size) -> Intrinsics:
    """Return the intrinsics of a whole equirectangular panorama of (width, height) pixels."""
    width, height = size
    return Intrinsics((width / (2 * math.pi), height / math.pi), (width / 2, height / 2), size, "equirectangular")


def _flat(value: object) -> Iterable[Any]:
    if not isinstance(value, list):
        return [value]
    return [each for part in value for each in _flat(part)]

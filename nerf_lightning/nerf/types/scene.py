"""What a reader returns: cameras, pixels, and where the content is."""

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from typing import Literal, NamedTuple

import torch
from jaxtyping import Bool, Float, Float64, Int, UInt8
from torch import Tensor

from nerf_lightning.messages.errors import InputError
from nerf_lightning.nerf.geometry.poses import flip_yz
from nerf_lightning.nerf.types.rays import KnownDepths
from nerf_lightning.nerf.types.tensor_struct import TensorStruct

Background = Literal["white", "black", "random", "white_or_random", "black_or_random", "none"]
"""What is behind the scene.

`random`: a new color for each ray of a step, which teaches empty space to be empty; at evaluation white.
`white_or_random`: the same, but white behind pixels that may show some of a background that was cut out (`UNSURE`).
`black_or_random`: the same with black, also at evaluation. `none`: nothing. The last interval of a dense level absorbs
all remaining light; levels with an occupancy grid have no such interval, and leave it black.
"""

DRAWN: tuple[Background, ...] = ("random", "white_or_random", "black_or_random")

UNSURE = 254
"""Alpha (of 255) of pixels that may show a background that was cut out: outlines and holes."""

LensModel = Literal["pinhole", "radial_tangential", "fisheye", "equirectangular"]
"""How a lens distorts a pinhole's image; the formulas are in `geometry.lenses`, those of equirectangular panoramas,
which show all directions, in `geometry.panoramas`."""

Space = Literal["bounded", "ndc", "contracted"]
"""The modeled part of the world: a box, everything in front of a near plane (normalized device coordinates), or
everything, contracted around a box."""


OPENCV_ORDER, OPENCV_FISHEYE = [0, 1, 4, 5, 2], [0, 1, 2, 3]
"""Positions of OpenCV's coefficients in `Cameras.lens`."""


@dataclass(frozen=True)
class Cameras(TensorStruct):
    """Cameras, one per view, through lenses of one kind."""

    c2w: Float[Tensor, "*views 3 4"]
    """Camera-to-world; the columns are right, up, back and the camera's center."""
    focal: Float[Tensor, "*views 2"]
    """Focal lengths in pixels along x and y; of panoramas, pixels per radian."""
    center: Float[Tensor, "*views 2"]
    """Principal point in pixels from the upper left corner of the image (x, y)."""
    lens: Float[Tensor, "*views 6"]
    """Distortion coefficients k1, k2, k3, k4, p1, p2 as in OpenCV; zeros for a pinhole, p 0 for a fisheye."""
    lens_model: LensModel
    """The meaning of the coefficients; one for all views of a scene."""
    width: Int[Tensor, "*views"]
    """Image width in pixels."""
    height: Int[Tensor, "*views"]
    """Image height in pixels."""
    ndc: Float[Tensor, "*views 2"] | None = None
    """Focal length over half the image's size, if rays are in normalized device coordinates (`geometry.ndc`) and the
    world's z axis points back from the scene; None: rays are in world coordinates."""

    @classmethod
    def from_opencv(
        cls,
        c2w: Float[Tensor, "*views rows 4"],
        matrix: Float[Tensor, "*#views 3 3"],
        size: tuple[int, int] | Int[Tensor, "*#views 2"],
        distortion: Float[Tensor, "*#views k"] | None = None,
        fisheye: bool = False,
        pixel_center: float = 0.5,
    ) -> "Cameras":
        """Return cameras whose axes are right, down, forward, as in OpenCV, COLMAP and nerfstudio's files.

        Args:
            c2w: camera to world; `torch.linalg.inv` of OpenCV's extrinsics. A fourth row is ignored.
            matrix: the camera matrix, in pixels.
            size: (width, height) in pixels.
            distortion: k1, k2, p1, p2 and perhaps k3 of `cv2.projectPoints`; of a fisheye up to four k of
                `cv2.fisheye`; None: a pinhole.
            fisheye: whether `distortion` is of a fisheye.
            pixel_center: coordinate of the first pixel's center: 0.5 as in COLMAP, 0 as in `cv2.calibrateCamera`.

        Raises:
            InputError: a skewed camera matrix, or unsupported coefficients (a rational or prism model).
        """
        views = c2w.shape[:-2]
        given = torch.zeros(*views, 0) if distortion is None else distortion.to(c2w.device).expand(*views, -1)
        most = 4 if fisheye else 5
        skew = matrix[..., 0, 1].abs() > 1e-6 * matrix[..., 0, 0].abs()
        if bool(skew.any()) or bool((given[..., most:] != 0).any()):
            raise InputError(
                f"The camera matrix is skewed, or the lens has more than {most} coefficients (k1 k2 p1 p2 k3; of a "
                "fisheye k1 k2 k3 k4), which no lens here has. Undistort the photographs first."
            )
        lens = torch.zeros(*views, 6, device=c2w.device)
        places = OPENCV_FISHEYE if fisheye else OPENCV_ORDER
        for place, value in zip(places, given[..., :most].unbind(dim=-1), strict=False):
            lens[..., place] = value.to(lens)
        width, height = torch.as_tensor(size, device=c2w.device).expand(*views, 2).unbind(dim=-1)
        matrix = matrix.to(c2w).expand(*views, 3, 3)
        return cls(
            c2w=flip_yz(c2w[..., :3, :]),
            focal=torch.stack([matrix[..., 0, 0], matrix[..., 1, 1]], dim=-1).float(),
            center=(matrix[..., :2, 2] + (0.5 - pixel_center)).float(),
            lens=lens,
            lens_model="fisheye" if fisheye else "pinhole" if distortion is None else "radial_tangential",
            width=width,
            height=height,
        )

    def to_opencv(
        self, pixel_center: float = 0.5
    ) -> tuple[Float[Tensor, "*views 3 4"], Float[Tensor, "*views 3 3"], Float[Tensor, "*views k"]]:
        """Return what `from_opencv` takes: camera to world, camera matrix, and k1 k2 p1 p2 k3 (a fisheye's four k).

        Raises:
            InputError: a panorama, or a fourth radial coefficient, which has another meaning in OpenCV.
        """
        fisheye = self.lens_model == "fisheye"
        if self.lens_model == "equirectangular" or (not fisheye and bool((self.lens[..., 3] != 0).any())):
            raise InputError(
                "OpenCV has no panoramas, and no k4 of this meaning: these cameras cannot be written as its."
            )
        matrix = torch.diag_embed(torch.cat([self.focal, torch.ones_like(self.focal[..., :1])], dim=-1))
        matrix[..., :2, 2] = self.center + (pixel_center - 0.5)
        order = OPENCV_FISHEYE if fisheye else OPENCV_ORDER
        return flip_yz(self.c2w), matrix, self.lens[..., order]


@dataclass(frozen=True)
class PixelStore:
    """Every pixel of every view in one flat array; views may differ in size. Row by row, row 0 on top.

    The arrays may be memory-mapped from a file and larger than memory: index them, never traverse them.
    """

    rgba: UInt8[Tensor, "pixels 4"]
    """Straight (not premultiplied) alpha; 255 if the format has none."""
    offset: Int[Tensor, "views"]
    """Index of each view's first pixel."""
    width: Int[Tensor, "views"]
    height: Int[Tensor, "views"]
    has_transparency: bool
    """Whether any pixel is not fully opaque."""
    mask: UInt8[Tensor, "pixels"] | None = None
    """1 if a pixel is trained on and scored, 0 if it is left out; None keeps all."""

    def view(self, index: int) -> UInt8[Tensor, "height width 4"]:
        """Return one view as a picture (no copy)."""
        return self._picture(self.rgba, index)

    def view_mask(self, index: int) -> Bool[Tensor, "height width"] | None:
        """Return which pixels of one view the mask keeps; None without a mask."""
        return None if self.mask is None else self._picture(self.mask, index) > 0

    def index_of(
        self, view: Int[Tensor, "*pixels"], x: Int[Tensor, "*pixels"], y: Int[Tensor, "*pixels"]
    ) -> Int[Tensor, "*pixels"]:
        """Return the indices of pixels in the flat arrays."""
        return self.offset[view] + y * self.width[view] + x

    def _picture(self, flat: Tensor, index: int) -> Tensor:
        start, width, height = (int(x[index]) for x in (self.offset, self.width, self.height))
        return flat[start : start + width * height].view(height, width, *flat.shape[1:])


class Truth(NamedTuple):
    """The exact geometry of each pixel of a view, if a scene knows it, row by row."""

    depth: Float[Tensor, "pixels"]
    """Distance along the unit ray through the pixel's center to the first surface; inf where there is none."""
    normals: Float[Tensor, "pixels 3"]
    """Unit surface normal in world axes, facing the camera; zero where there is no surface."""


@dataclass(frozen=True)
class SceneRecord:
    """The part of a scene that outlives its pictures: enough to render, and to place renders in the user's frame."""

    name: str
    cameras: Cameras
    near: Float[Tensor, "views"]
    """Distance along the ray at which content may begin, per view, in scene units."""
    far: Float[Tensor, "views"]
    """Distance at which content ends."""
    aabb: Float[Tensor, "2 3"]
    """Lower and upper corner of a world box that contains the content."""
    splits: dict[str, tuple[int, ...]]
    """Views of `train`, `val` and `test`; the last two may be absent from a checkpoint. For several captures also
    `sources`, which adds to `train` the training views of captures that are never trained on."""
    view_names: tuple[str, ...]
    background: Background
    to_user: Float64[Tensor, "4 4"]
    """Similarity from scene coordinates to the user's own frame, which may be a map's: millions of meters."""
    space: Space = "bounded"
    metres_per_unit: float | None = None
    """Meters per unit of the user's frame; None: unknown."""
    capture_of: tuple[int, ...] | None = None
    """Number of each view's capture, if several were joined; None: one capture."""
    captures: tuple[str, ...] = ()
    """The names of the joined captures."""

    @property
    def user_cameras(self) -> Cameras:
        """The cameras in the user's own frame, poses in float64: what `model.render` takes."""
        linear, c2w = self.to_user[:3, :3], self.cameras.c2w.double()
        rotation = linear / torch.linalg.det(linear) ** (1 / 3)
        centers = linear @ c2w[..., 3:] + self.to_user[:3, 3:]
        return replace(self.cameras, c2w=torch.cat([rotation @ c2w[..., :3], centers], dim=-1), ndc=None)

    @property
    def trained_captures(self) -> tuple[str, ...]:
        """The names of the captures that are trained on; for one capture, its own."""
        if self.capture_of is None:
            return (self.name,)
        numbers = {self.capture_of[view] for view in self.splits["train"]}
        return tuple(name for number, name in enumerate(self.captures) if number in numbers)

    @property
    def sources(self) -> tuple[int, ...]:
        """Views that may be used to render others."""
        return self.splits.get("sources") or self.splits["train"]


@dataclass(frozen=True, kw_only=True)
class Scene(SceneRecord):
    """What a reader returns: pictures with cameras, and where to look for content."""

    pixels: PixelStore
    protocol: dict[str, str]
    """How the pixels were made (downscale filter and the like), stamped on every number measured on them."""
    truth: Callable[[int], Truth] | None
    """Returns exact depth and normals of a view, for scenes that know them."""
    points: Float[Tensor, "points 3"] = field(default_factory=lambda: torch.zeros(0, 3))
    """Sparse points of a reconstruction, in scene units; there may be none."""
    depths: KnownDepths | None = None
    """Known depths of pixels of its photographs, if the capture has any."""
    left_out: tuple[str, ...] = ()
    """Photographs of the capture without a pose, which are not views."""
    refined: bool = False
    """Whether its cameras are or were learned with the model: they are only near where the photographs were taken."""

"""The nouns of the program: frozen structs of tensors with named axes.

Units: world axes as the user gave them (or a recorded similarity of them); a camera looks along -z of its own axes
(x right, y up, z back); pixel centres lie at +0.5, row 0 is on top; colours are sRGB-encoded in [0, 1].
`*rays` is any leading shape. Letters: `t` is the distance along a ray of unit direction.
"""

from collections.abc import Callable
from dataclasses import dataclass, field, fields, replace
from typing import Any, Literal, TypeVar

import torch
from jaxtyping import Bool, Float, Int, UInt8
from torch import Tensor

Background = Literal["white", "black", "random", "none"]
"""What lies behind the scene; `none` closes the ray: its last interval takes all the light that is left."""

LensModel = Literal["pinhole", "radial_tangential", "fisheye"]
"""How a lens bends what a pinhole would show; the formulas are in `geometry.lenses`."""


Space = Literal["bounded", "ndc", "contracted"]
"""How much of the world is modelled: a box, all that lies in front of a near plane (normalised device coordinates), or
everything, contracted around a box."""

# Not typing.Self, which runtime type checkers do not know.
Struct = TypeVar("Struct", bound="TensorStruct")


class TensorStruct:
    """Mixin of the frozen dataclasses below: move or index every tensor at once, nested structs included."""

    def map(self: Struct, fn: Callable[[Tensor], Tensor]) -> Struct:
        """Return a copy with `fn` applied to each tensor."""
        changed: dict[str, Any] = {}
        for each in fields(self):  # type: ignore[arg-type]
            value = getattr(self, each.name)
            if isinstance(value, Tensor):
                changed[each.name] = fn(value)
            elif isinstance(value, TensorStruct):
                changed[each.name] = value.map(fn)
        return replace(self, **changed)  # type: ignore[type-var]

    def to(self: Struct, device: torch.device | str, non_blocking: bool = False) -> Struct:
        """Return a copy on `device`."""
        return self.map(lambda tensor: tensor.to(device, non_blocking=non_blocking))

    def __getitem__(self: Struct, index: Any) -> Struct:
        """Index the leading axes of every tensor."""
        return self.map(lambda tensor: tensor[index])


@dataclass(frozen=True)
class Cameras(TensorStruct):
    """Cameras, one per view, through lenses of one kind."""

    c2w: Float[Tensor, "*views 3 4"]
    """Camera-to-world; the columns are right, up, back and the camera's centre."""
    focal: Float[Tensor, "*views 2"]
    """Focal lengths in pixels along x and y."""
    center: Float[Tensor, "*views 2"]
    """Principal point in pixels from the upper left corner of the image (x, y)."""
    lens: Float[Tensor, "*views 6"]
    """Distortion coefficients k1, k2, k3, k4, p1, p2 in the sense of OpenCV; zeros for a pinhole, p 0 for a fisheye."""
    lens_model: LensModel
    """What the coefficients mean; one for all views of a scene."""
    width: Int[Tensor, "*views"]
    """Image width in pixels."""
    height: Int[Tensor, "*views"]
    """Image height in pixels."""
    ndc: Float[Tensor, "*views 2"] | None = None
    """Focal length over half the image's size, where rays run through normalised device coordinates (`geometry.ndc`)
    and the world's z axis is the captures' back; None: rays run through the world."""


@dataclass(frozen=True)
class PixelStore:
    """Every pixel of every view in one flat array; views may differ in size. Row by row, row 0 on top.

    The arrays may be a file's, mapped into memory and larger than it: index them, never go over the whole.
    """

    rgba: UInt8[Tensor, "pixels 4"]
    """Straight (not premultiplied) alpha; 255 where the format has none."""
    offset: Int[Tensor, "views"]
    """Index of each view's first pixel."""
    width: Int[Tensor, "views"]
    height: Int[Tensor, "views"]
    has_transparency: bool
    """Whether the alpha of any pixel says more than that something is there."""
    mask: UInt8[Tensor, "pixels"] | None = None
    """1 where a pixel is trained on and scored, 0 where it is left out; None keeps all."""

    def view(self, index: int) -> UInt8[Tensor, "height width 4"]:
        """Return one view as a picture (no copy)."""
        return self._picture(self.rgba, index)

    def kept(self, index: int) -> Bool[Tensor, "height width"] | None:
        """Tell which pixels of one view the mask keeps; None where there is no mask."""
        return None if self.mask is None else self._picture(self.mask, index) > 0

    def _picture(self, flat: Tensor, index: int) -> Tensor:
        start, width, height = (int(x[index]) for x in (self.offset, self.width, self.height))
        return flat[start : start + width * height].view(height, width, *flat.shape[1:])


@dataclass(frozen=True)
class Truth:
    """The exact geometry of each pixel, where a scene knows it. Flat like the pixel store."""

    depth: Float[Tensor, "pixels"]
    """Distance along the unit ray through the pixel's centre to the first surface; inf where there is none."""
    normals: Float[Tensor, "pixels 3"]
    """Unit surface normal in world axes, facing the camera; zero where there is no surface."""


@dataclass(frozen=True)
class Scene:
    """What a reader returns: pictures with cameras, and where to look for content."""

    name: str
    cameras: Cameras
    pixels: PixelStore
    near: Float[Tensor, "views"]
    """Distance along the ray at which content may begin, per view, in scene units."""
    far: Float[Tensor, "views"]
    """Distance at which content ends."""
    aabb: Float[Tensor, "2 3"]
    """Lower and upper corner of a world box that contains the content."""
    splits: dict[str, tuple[int, ...]]
    """Views of `train`, `val` and `test`."""
    view_names: tuple[str, ...]
    background: Background
    to_user: Float[Tensor, "4 4"]
    """Similarity that takes scene coordinates to the user's own frame."""
    protocol: dict[str, str]
    """How the pixels were made (downscale filter and the like), stamped on every number measured on them."""
    truth: Truth | None
    """Exact depth and normals, for scenes that know them."""
    space: Space = "bounded"
    points: Float[Tensor, "points 3"] = field(default_factory=lambda: torch.zeros(0, 3))
    """Sparse points of a reconstruction, in scene units; there may be none."""
    left_out: tuple[str, ...] = ()
    """Photographs of the capture that have no pose, and so are no views."""


@dataclass(frozen=True)
class RayBundle(TensorStruct):
    """Rays r(t) = origin + t * direction, for t between near and far."""

    origins: Float[Tensor, "*rays 3"]
    directions: Float[Tensor, "*rays 3"]
    """Unit length, so `t` is a distance."""
    near: Float[Tensor, "*rays"]
    far: Float[Tensor, "*rays"]
    camera_index: Int[Tensor, "*rays"]
    view_directions: Float[Tensor, "*rays 3"]
    """Where the camera looks in the world, unit length: what colour depends on. Differs from `directions` in
    normalised device coordinates."""


@dataclass(frozen=True)
class RaySamples(TensorStruct):
    """Adjacent intervals along each ray, kept as their fenceposts."""

    edges: Float[Tensor, "*rays edges"]
    """Increasing distances; one more than there are samples."""
    endless: bool = False
    """Whether even steps are those of `geometry.spacing`, for space without bounds, and not of the distance."""

    @property
    def starts(self) -> Float[Tensor, "*rays samples"]:
        """Where each interval begins."""
        return self.edges[..., :-1]

    @property
    def ends(self) -> Float[Tensor, "*rays samples"]:
        """Where each interval ends."""
        return self.edges[..., 1:]

    @property
    def midpoints(self) -> Float[Tensor, "*rays samples"]:
        """Where the field is asked."""
        return 0.5 * (self.starts + self.ends)

    @property
    def deltas(self) -> Float[Tensor, "*rays samples"]:
        """Length of each interval."""
        return self.ends - self.starts


@dataclass(frozen=True)
class PackedSamples(TensorStruct):
    """Only the intervals that may hold something, ray after ray, each ray's in order.

    The arrays have a capacity; what lies beyond the last bound is padding of zero length. It is packed for speed, and
    has functions of its own (`rendering.packed`).
    """

    ray_index: Int[Tensor, "capacity"]
    starts: Float[Tensor, "capacity"]
    ends: Float[Tensor, "capacity"]
    bounds: Int[Tensor, "bounds"]
    """The samples of ray r are those from bounds[r] to bounds[r + 1]; one more than there are rays."""
    found: Int[Tensor, ""]
    """How many there were before what exceeds the capacity was dropped."""

    @property
    def place(self) -> Int[Tensor, "capacity"]:
        """Number of each sample in its ray, from 0."""
        return torch.arange(self.ray_index.shape[0], device=self.bounds.device) - self.bounds[self.ray_index]

    def at(self, kept: Int[Tensor, "kept"], bounds: Int[Tensor, "bounds"]) -> "PackedSamples":
        """Return some of the samples, in order, with the bounds that they have then."""
        return PackedSamples(self.ray_index[kept], self.starts[kept], self.ends[kept], bounds, self.found)

    @property
    def midpoints(self) -> Float[Tensor, "capacity"]:
        """Where the field is asked."""
        return 0.5 * (self.starts + self.ends)

    @property
    def deltas(self) -> Float[Tensor, "capacity"]:
        """Length of each interval."""
        return self.ends - self.starts


@dataclass(frozen=True)
class FieldOutput(TensorStruct):
    """What a field says of points in space."""

    density: Float[Tensor, "*points"]
    """Per unit length, >= 0."""
    rgb: Float[Tensor, "*points 3"]
    """In [0, 1]."""


@dataclass(frozen=True)
class Rendering(TensorStruct):
    """What one level saw along each ray."""

    rgb: Float[Tensor, "*rays 3"]
    """Composited over the background, exactly once."""
    foreground: Float[Tensor, "*rays 3"]
    """The scene's own light, before the background: sum of weights times colour."""
    opacity: Float[Tensor, "*rays"]
    """Sum of weights."""
    depth: Float[Tensor, "*rays"]
    """Expected distance along the ray; light that escapes ends at far."""


@dataclass(frozen=True)
class DenseRendering(Rendering):
    """A level whose rays all have the same number of samples."""

    weights: Float[Tensor, "*rays samples"]
    samples: RaySamples


@dataclass(frozen=True)
class PackedRendering(Rendering):
    """A level that skipped what is empty."""

    weights: Float[Tensor, "capacity"]
    samples: PackedSamples


@dataclass(frozen=True)
class Batch(TensorStruct):
    """Rays, all that a model may see, and what the photographs say of them."""

    rays: RayBundle
    rgba: Float[Tensor, "*rays 4"]
    """Straight alpha; blended with the step's background in one place (`rendering.blending`)."""
    weight: Float[Tensor, "*rays"]
    """How much each pixel counts: 0 where it is masked, else 1."""


@dataclass(frozen=True)
class PixelIndex(TensorStruct):
    """Which pixel of which view."""

    view: Int[Tensor, "*rays"]
    x: Int[Tensor, "*rays"]
    """Column, from 0 on the left."""
    y: Int[Tensor, "*rays"]
    """Row, from 0 on top."""


def opaque(alpha: Float[Tensor, "*rays"]) -> Bool[Tensor, "*rays"]:
    """Tell the pixels that are wholly covered by the scene, where geometry can be scored."""
    return alpha >= 1.0

"""Rays, where they are sampled, and the pixels that they belong to."""

from dataclasses import dataclass, replace

import torch
from jaxtyping import Float, Int
from torch import Tensor
from torch.nn import functional

from nerf_lightning.nerf.types.tensor_struct import TensorStruct


@dataclass(frozen=True)
class RayBundle(TensorStruct):
    """Rays r(t) = origin + t * direction, for t between near and far."""

    origins: Float[Tensor, "*rays 3"]
    directions: Float[Tensor, "*rays 3"]
    """Unit length, so `t` is a distance."""
    near: Float[Tensor, "*rays"]
    far: Float[Tensor, "*rays"]
    view_directions: Float[Tensor, "*rays 3"]
    """Where the camera looks in the world, unit length: what color depends on. Differs from `directions` in
    normalized device coordinates."""
    photograph: Int[Tensor, "*rays"] | None = None
    """Number of the view whose photograph a training step explains; None everywhere else (validation, evaluation,
    films, exports, the viewer), where what a photograph alone has, such as its exposure, is not to be seen. Models
    that look at photographs are told of it wherever a view is rendered, since they must not look at the view itself."""
    capture: Int[Tensor, "*rays"] | None = None
    """Number of the capture that each ray runs through; None: the first, which is mostly the only one."""
    pixel_side: Float[Tensor, "*rays 2"] | None = None
    """Side of the ray's pixel (root of its area) at distance 0, and by how much it grows per unit of distance; None for
    rays that are no pixel's."""
    together: int = 1
    """So many rays after one another belong to pixels of a picture that touch, and may share where they are sampled."""

    def between(self) -> "RayBundle":
        """Return the ray in the middle of those that come together, and of what has no middle that of the first."""
        count = self.together

        def middle(column: Tensor) -> Tensor:
            return column.unflatten(0, (-1, count)).mean(dim=1) if column.is_floating_point() else column[::count]

        rays = replace(self, together=1).map(middle)
        along, seen = (functional.normalize(each, dim=-1) for each in (rays.directions, rays.view_directions))
        return replace(rays, directions=along, view_directions=seen)


@dataclass(frozen=True)
class RaySamples(TensorStruct):
    """Adjacent intervals along each ray, kept as their fenceposts."""

    edges: Float[Tensor, "*rays edges"]
    """Increasing distances; one more than there are samples."""
    contracted_spacing: bool = False
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
class RaggedSamples(TensorStruct):
    """Only the intervals that may hold something, ray after ray, each ray's in order.

    The arrays have a capacity; what lies beyond the last bound is padding of zero length, spread over the rays, since a
    GPU adds up what flows back to one ray one by one. It is ragged for speed, and has functions of its own
    (`rendering.ragged`).
    """

    ray_index: Int[Tensor, "capacity"]
    starts: Float[Tensor, "capacity"]
    ends: Float[Tensor, "capacity"]
    bounds: Int[Tensor, "bounds"]
    """The samples of ray r are those from bounds[r] to bounds[r + 1]; one more than there are rays."""
    found: Int[Tensor, ""]
    """How many there were before what exceeds the capacity was dropped."""
    longest: int | None = None
    """No ray has more samples; None: the bounds say so, read on the host."""

    @property
    def sample_index(self) -> Int[Tensor, "capacity"]:
        """Number of each sample in its ray, from 0."""
        first = self.bounds.index_select(0, self.ray_index)
        return torch.arange(self.ray_index.shape[0], device=self.bounds.device) - first

    def at(self, kept: Int[Tensor, "kept"], bounds: Int[Tensor, "bounds"]) -> "RaggedSamples":
        """Return some of the samples, in order, with the bounds that they have then."""
        ray, starts, ends = (each.index_select(0, kept) for each in (self.ray_index, self.starts, self.ends))
        return RaggedSamples(ray, starts, ends, bounds, self.found, self.longest)

    @property
    def midpoints(self) -> Float[Tensor, "capacity"]:
        """Where the field is asked."""
        return 0.5 * (self.starts + self.ends)

    @property
    def deltas(self) -> Float[Tensor, "capacity"]:
        """Length of each interval."""
        return self.ends - self.starts


@dataclass(frozen=True)
class PixelIndex(TensorStruct):
    """Which pixel of which view."""

    view: Int[Tensor, "*rays"]
    x: Int[Tensor, "*rays"]
    """Column, from 0 on the left."""
    y: Int[Tensor, "*rays"]
    """Row, from 0 on top."""


@dataclass(frozen=True)
class KnownDepths(TensorStruct):
    """Pixels at which the distance of the surface is known, from structure from motion or a depth sensor."""

    pixels: PixelIndex
    distance: Float[Tensor, "known"]
    """Along the unit ray through the pixel, scene units."""
    certainty: Float[Tensor, "known"]
    """In (0, 1]: 1 / (1 + (relative error / `CERTAIN`)^2)."""
    from_pictures: bool = False
    """Whether they follow from the photographs, and are none of the capture's own."""

    def __len__(self) -> int:
        return len(self.distance)


@dataclass(frozen=True)
class Batch(TensorStruct):
    """Pixels of photographs and what they show; the rays through them are made in the step (`RayGenerator`)."""

    pixels: PixelIndex
    rgba: Float[Tensor, "*rays 4"]
    """Straight alpha; blended with the step's background in one place (`rendering.background`)."""
    weight: Float[Tensor, "*rays"]
    """How much each pixel counts: 0 where it is masked, else 1."""
    distance: Float[Tensor, "*rays"] | None = None
    """Of the surface along the unit ray, scene units, where `certainty` is not 0; None: unknown everywhere."""
    certainty: Float[Tensor, "*rays"] | None = None
    """How much each distance counts, in [0, 1]; 0 where it is unknown."""

    @property
    def num_rays(self) -> int:
        """How many pixels there are, each with its ray."""
        return self.weight.numel()


@dataclass(frozen=True)
class Target(TensorStruct):
    """What the renderings of some rays are compared with."""

    rgb: Float[Tensor, "*rays 3"]
    """What the photographs show, over the step's background."""
    weight: Float[Tensor, "*rays"]
    """Of each ray, >= 0; its mean over the whole batch is 1."""
    pixels: PixelIndex
    """Where in which photograph each ray lies."""
    distance: Float[Tensor, "*rays"] | None = None
    """Where along each ray the surface is, in the units of its samples, if `certainty` is not 0; None: unknown."""
    certainty: Float[Tensor, "*rays"] | None = None
    """How much each distance counts, in [0, 1]; 0 where it is unknown."""
    infinity: Float[Tensor, "*rays"] | None = None
    """Where along each ray the world ends, in normalized device coordinates; None: nowhere."""

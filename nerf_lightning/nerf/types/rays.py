"""Rays, where they are sampled, the points at which fields are evaluated, and the pixels that rays belong to."""

from collections.abc import Callable, Hashable
from dataclasses import dataclass, replace

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor
from torch.nn import functional

from nerf_lightning.nerf.randomness import PointRandom
from nerf_lightning.nerf.types.tensor_struct import TensorStruct, overwrite


@dataclass(frozen=True)
class RayBundle(TensorStruct):
    """Rays r(t) = origin + t * direction, for t between near and far."""

    origins: Float[Tensor, "*rays 3"]
    directions: Float[Tensor, "*rays 3"]
    """Unit length, so `t` is a distance."""
    near: Float[Tensor, "*rays"]
    far: Float[Tensor, "*rays"]
    view_directions: Float[Tensor, "*rays 3"]
    """Directions in the world, unit length, on which color depends. They differ from `directions` in normalized device
    coordinates."""
    photograph: Int[Tensor, "*rays"] | None = None
    """Number of the view whose photograph a training step explains; None everywhere else (validation, evaluation,
    films, exports, the viewer), where what is specific to a photograph, such as its exposure, must not be visible. For
    models that render from photographs it is set whenever a view is rendered, since they must not use the view
    itself."""
    capture: Int[Tensor, "*rays"] | None = None
    """Number of each ray's capture; None: the first, which is usually the only one."""
    pixel_side: Float[Tensor, "*rays 2"] | None = None
    """Side of the ray's pixel (root of its area) at distance 0, and its growth per unit of distance; None for rays that
    belong to no pixel."""
    together: int = 1
    """Number of consecutive rays that belong to adjacent pixels of a picture, and may share their samples'
    positions."""

    def between(self) -> "RayBundle":
        """Return the mean ray of each group of `together` rays, with the first ray's values where there is no mean."""
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
    """Whether steps are even in normalized distance (`geometry.contraction`), for unbounded space, instead of
    distance."""

    @property
    def starts(self) -> Float[Tensor, "*rays samples"]:
        """Start of each interval."""
        return self.edges[..., :-1]

    @property
    def ends(self) -> Float[Tensor, "*rays samples"]:
        """End of each interval."""
        return self.edges[..., 1:]

    @property
    def midpoints(self) -> Float[Tensor, "*rays samples"]:
        """Where the field is evaluated."""
        return 0.5 * (self.starts + self.ends)

    @property
    def deltas(self) -> Float[Tensor, "*rays samples"]:
        """Length of each interval."""
        return self.ends - self.starts


@dataclass(frozen=True)
class RaggedSamples(TensorStruct):
    """Only the intervals that may hold something, ray by ray, in order along each ray.

    The arrays have a capacity; beyond the last bound is padding of zero length, spread over the rays, since a GPU
    accumulates the gradients of one ray serially. The layout is ragged for speed, and has its own functions
    (`rendering.quadrature`).
    """

    ray_index: Int[Tensor, "capacity"]
    starts: Float[Tensor, "capacity"]
    ends: Float[Tensor, "capacity"]
    bounds: Int[Tensor, "bounds"]
    """The samples of ray r are those from bounds[r] to bounds[r + 1]; one more than there are rays."""
    found: Int[Tensor, ""]
    """Number of samples before those that exceed the capacity were dropped."""
    longest: int | None = None
    """Maximum number of samples of any ray; None: given by the bounds, read on the host."""

    @property
    def sample_index(self) -> Int[Tensor, "capacity"]:
        """Index of each sample on its ray, from 0."""
        first = self.bounds.index_select(0, self.ray_index)
        return torch.arange(self.ray_index.shape[0], device=self.bounds.device) - first

    def at(self, kept: Int[Tensor, "kept"], bounds: Int[Tensor, "bounds"]) -> "RaggedSamples":
        """Return some of the samples, in order, with their new bounds."""
        ray, starts, ends = (each.index_select(0, kept) for each in (self.ray_index, self.starts, self.ends))
        return RaggedSamples(ray, starts, ends, bounds, self.found, self.longest)

    @property
    def midpoints(self) -> Float[Tensor, "capacity"]:
        """Where the field is evaluated."""
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
    """Whether they were computed from the photographs instead of given by the capture."""

    def __len__(self) -> int:
        return len(self.distance)


@dataclass(frozen=True)
class Batch(TensorStruct):
    """Pixels of photographs and what they show; the rays through them are made in the step (`RayGenerator`)."""

    pixels: PixelIndex
    rgba: Float[Tensor, "*rays 4"]
    """Straight alpha; blended with the step's background in one place (`rendering.background`)."""
    weight: Float[Tensor, "*rays"]
    """Weight of each pixel: 0 if masked, else 1."""
    distance: Float[Tensor, "*rays"] | None = None
    """Distance of the surface along the unit ray, scene units, where `certainty` is not 0; None: unknown everywhere."""
    certainty: Float[Tensor, "*rays"] | None = None
    """Weight of each distance, in [0, 1]; 0 where it is unknown."""

    @property
    def num_rays(self) -> int:
        """Number of pixels, each with its ray."""
        return self.weight.numel()

    def now(self) -> "Batch":
        """Return the same: unlike a `LazyBatch`, it has been gathered."""
        return self


@dataclass(frozen=True)
class LazyBatch:
    """A batch that is gathered on its device when a step asks for it.

    A recorded step gathers it from numbers that it reads on the device, and so its replay the batch of other numbers.
    """

    num_rays: int
    numbers: tuple[int, ...]
    """What varies between batches."""
    kind: Hashable
    """The same for batches that differ in their numbers alone."""
    gather: Callable[[Int[Tensor, "numbers"]], Batch]
    """Returns the batch of numbers that lie on the device."""
    device: torch.device

    def now(self) -> Batch:
        """Return the batch."""
        there = torch.empty(len(self.numbers), dtype=torch.int64, device=self.device)
        overwrite(there, np.array(self.numbers))
        return self.gather(there)

    def to(self, device: torch.device | str, non_blocking: bool = False) -> "LazyBatch":
        """Return the same: it is where the pixels are, which is where the model is."""
        return self


@dataclass(frozen=True)
class Target(TensorStruct):
    """What the renderings of some rays are compared with."""

    rgb: Float[Tensor, "*rays 3"]
    """What the photographs show, over the step's background."""
    weight: Float[Tensor, "*rays"]
    """Weight of each ray, >= 0; its mean over the whole batch is 1."""
    pixels: PixelIndex
    """The photograph and pixel of each ray."""
    distance: Float[Tensor, "*rays"] | None = None
    """Distance of the surface along each ray, in the units of its samples, where `certainty` is not 0; None:
    unknown."""
    certainty: Float[Tensor, "*rays"] | None = None
    """Weight of each distance, in [0, 1]; 0 where it is unknown."""
    infinity: Float[Tensor, "*rays"] | None = None
    """Distance along each ray at which the world ends, in normalized device coordinates; None: nowhere."""


@dataclass(frozen=True)
class Points(TensorStruct):
    """Points in space, with the directions and photographs from which they are seen.

    What all samples of a ray share (its direction, its photograph) is stored once, with an axis of length 1.
    """

    positions: Float[Tensor, "*points 3"]
    """Positions in scene units."""
    directions: Float[Tensor, "*#points 3"] | None = None
    """Unit length, from the camera to the point; None if only density is needed."""
    photograph: Int[Tensor, "*#points"] | None = None
    """Number of the view whose photograph is explained; None outside training steps (`RayBundle.photograph`)."""
    random: PointRandom | None = None
    """The step's random numbers; None outside training steps."""
    covariance: Float[Tensor, "*points 6"] | None = None
    """Covariance of the part of its pixel's cone that a sample represents (`geometry.cones`), scene units squared; None
    if unused (`Field.sees_cones`), or if a point belongs to no pixel."""

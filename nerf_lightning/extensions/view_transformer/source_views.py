"""Choose the photographs that a ray is rendered from: those taken nearest to its origin.

As in IBRNet (arXiv 2102.13090): by direction from the content if cameras surround it, else by distance. In training,
they are drawn from a larger pool, and their number varies, so that no arrangement is memorized.
"""

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor
from torch.nn import functional

from nerf_lightning.messages.errors import InputError
from nerf_lightning.nerf.randomness import PointRandom, RayRandom
from nerf_lightning.nerf.types.photographs import Photographs
from nerf_lightning.nerf.types.rays import RayBundle
from nerf_lightning.nerf.types.tensor_struct import TensorStruct

POOLS = ((0.2, 1), (0.65, 2), (1.0, 3))
"""Upper bounds of a uniform number, and the pool's size as a multiple of the sources (20, 45 and 35 %)."""
LARGEST_POOL = 22
MORE_OR_FEWER = 2
"""Maximum number of sources that are added or dropped in training."""
NO_PHOTOGRAPH = -1


@dataclass(frozen=True)
class SourceViews(TensorStruct):
    """The photographs that some rays are rendered from; the rays of one target share theirs."""

    views: Int[Tensor, "targets sources"]
    """Indices into `Photographs`."""
    valid: Bool[Tensor, "targets sources"]
    """False if there are no more photographs; the index is then arbitrary."""
    target: Int[Tensor, "rays"]
    """The target of each ray."""


@torch.no_grad()
def choose_sources(photographs: Photographs, rays: RayBundle, count: int, random: RayRandom | None) -> SourceViews:
    """Return the photographs that each ray is rendered from, never including its own.

    Args:
        photographs: on the rays' device.
        rays: their origins are the targets' positions.
        count: photographs per target; in training two more or fewer.
        random: the step's random numbers; None takes the nearest.

    Raises:
        InputError: a capture has no photographs.
    """
    capture, photograph, eye, of_ray = _targets(rays)
    distance = squared_distances(
        photographs, capture, eye, torch.arange(len(photographs.capture), device=eye.device)[None]
    )
    other, itself = photographs.capture != capture[:, None], photographs.numbers == photograph[:, None]
    distance = distance.masked_fill(other | itself, torch.inf)
    if not bool(distance.isfinite().any(dim=1).all()):
        raise InputError(
            "A view is rendered from other photographs of its capture, and there are none. Give the capture more "
            "photographs to train on, or take it out."
        )
    num_views = distance.shape[1]
    if random is None:
        pool = count
    else:
        step = PointRandom(random.key[:1], torch.zeros_like(random.key[:1]), torch.arange(2, device=random.key.device))
        larger, more = step.uniform("sources.step").tolist()
        pool = min(LARGEST_POOL, count * next(times for share, times in POOLS if larger < share))
        count = max(1, count - MORE_OR_FEWER + int(more * (2 * MORE_OR_FEWER + 1)))
    pool, count = min(max(pool, count), num_views), min(count, num_views)
    nearest = distance.sort(dim=1, stable=True)
    views, valid = nearest.indices[:, :pool], nearest.values[:, :pool].isfinite()
    if random is not None:
        of_target = PointRandom(random.key[:1, None], photograph[:, None], photographs.numbers[views])
        order = torch.where(valid, of_target.uniform("sources.order"), torch.inf).argsort(dim=1, stable=True)
        views, valid = views.gather(1, order), valid.gather(1, order)
    return SourceViews(views[:, :count], valid[:, :count], of_ray)


def squared_distances(
    photographs: Photographs,
    capture: Int[Tensor, "targets"],
    eye: Float[Tensor, "targets 3"],
    views: Int[Tensor, "#targets views"],
) -> Float[Tensor, "targets views"]:
    """Return the distances used to choose the nearest photographs: of directions if cameras surround the content.

    Args:
        photographs: of all captures.
        capture: of each target.
        eye: position of each target.
        views: the photographs to measure, of the target's own capture.
    """
    eyes, middle = photographs.cameras.c2w[views, :, 3], photographs.middle[capture][:, None]
    # Not by the cosine, which hardly changes if directions almost agree.
    turned = functional.normalize(eye[:, None] - middle, dim=-1) - functional.normalize(eyes - middle, dim=-1)
    apart = torch.where(photographs.around[capture][:, None, None], turned, eye[:, None] - eyes)
    return apart.square().sum(dim=-1)


def _targets(rays: RayBundle) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Return the unique origins of rays (capture, photograph, eye), and the index of each ray's."""
    # Origins are compared by their bits, like the integers next to them.
    none = torch.zeros_like(rays.near, dtype=torch.int64)
    capture = none if rays.capture is None else rays.capture
    photograph = none + NO_PHOTOGRAPH if rays.photograph is None else rays.photograph
    bits = rays.origins.float().contiguous().view(torch.int32).long()
    all_rows = torch.cat([capture[:, None], photograph[:, None], bits], dim=1)
    rows, of_ray = torch.unique(all_rows, dim=0, return_inverse=True)
    return rows[:, 0], rows[:, 1], rows[:, 2:].to(torch.int32).contiguous().view(torch.float32), of_ray

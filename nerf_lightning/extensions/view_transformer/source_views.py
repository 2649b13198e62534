"""Which photographs a ray is rendered from: those taken from nearest to where it is seen from.

As IBRNet picks them (arXiv 2102.13090): by direction from the content where cameras stand around it, else by distance.
In training out of a larger pool, and more or fewer, so that no arrangement is learned by heart.
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
"""Up to which uniform number the pool is how many times as large as the number of sources (20, 45 and 35 %)."""
LARGEST_POOL = 22
MORE_OR_FEWER = 2
"""So many sources are added or left out at most in training."""
NO_PHOTOGRAPH = -1


@dataclass(frozen=True)
class SourceViews(TensorStruct):
    """The photographs that some rays are rendered from; the rays of one target share theirs."""

    views: Int[Tensor, "targets sources"]
    """Which of `Photographs` they are."""
    given: Bool[Tensor, "targets sources"]
    """False where there are no more photographs; the place is then that of any."""
    target: Int[Tensor, "rays"]
    """Of each ray."""


@torch.no_grad()
def choose_sources(photographs: Photographs, rays: RayBundle, count: int, random: RayRandom | None) -> SourceViews:
    """Return the photographs that each ray is rendered from; the one that it belongs to itself is never among them.

    Args:
        photographs: on the rays' device.
        rays: their origins are where the targets were taken from.
        count: photographs per target; in training two more or fewer.
        random: the step's numbers; None takes the nearest.

    Raises:
        InputError: a capture without photographs.
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
    views, known = nearest.indices[:, :pool], nearest.values[:, :pool].isfinite()
    if random is not None:
        of_target = PointRandom(random.key[:1, None], photograph[:, None], photographs.numbers[views])
        order = torch.where(known, of_target.uniform("sources.order"), torch.inf).argsort(dim=1, stable=True)
        views, known = views.gather(1, order), known.gather(1, order)
    return SourceViews(views[:, :count], known[:, :count], of_ray)


def squared_distances(
    photographs: Photographs,
    capture: Int[Tensor, "targets"],
    eye: Float[Tensor, "targets 3"],
    views: Int[Tensor, "#targets views"],
) -> Float[Tensor, "targets views"]:
    """Return how far photographs are from targets, as the nearest are chosen: of directions where cameras stand around.

    Args:
        photographs: of all captures.
        capture: that each target belongs to.
        eye: where it is seen from.
        views: which photographs are asked about; of its own capture.
    """
    eyes, middle = photographs.cameras.c2w[views, :, 3], photographs.middle[capture][:, None]
    # Not by the cosine, which hardly changes where directions all but agree.
    turned = functional.normalize(eye[:, None] - middle, dim=-1) - functional.normalize(eyes - middle, dim=-1)
    apart = torch.where(photographs.around[capture][:, None, None], turned, eye[:, None] - eyes)
    return apart.square().sum(dim=-1)


def _targets(rays: RayBundle) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Return the origins that rays start from, each once (capture, photograph, eye), and which is each ray's."""
    # Origins are told apart by their bits, as the whole numbers beside them.
    none = torch.zeros_like(rays.near, dtype=torch.int64)
    capture = none if rays.capture is None else rays.capture
    photograph = none + NO_PHOTOGRAPH if rays.photograph is None else rays.photograph
    bits = rays.origins.float().contiguous().view(torch.int32).long()
    all_rows = torch.cat([capture[:, None], photograph[:, None], bits], dim=1)
    rows, of_ray = torch.unique(all_rows, dim=0, return_inverse=True)
    return rows[:, 0], rows[:, 1], rows[:, 2:].to(torch.int32).contiguous().view(torch.float32), of_ray

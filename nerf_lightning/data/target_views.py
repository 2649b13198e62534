"""Batches whose rays come from a few photographs, for models that render each photograph from others."""

import torch
from jaxtyping import Int
from torch import Tensor

from nerf_lightning.nerf.randomness import fold, permute


def rays_of_few_views(
    starts: Int[Tensor, "views"],
    counts: Int[Tensor, "views"],
    step: int,
    slots: Int[Tensor, "rays"],
    num_rays: int,
    num_views: int,
    key: int,
) -> Int[Tensor, "rays"]:
    """Return the indices of a step's rays (pixels, or squares of them): equally many from each of a few views.

    The views follow a keyed order, new each time that all have been used, and so do the rays of each view, so that
    nothing is stored and a step is a function of its number alone.

    Args:
        starts: the index of each view's first ray.
        counts: the number of each view's rays.
        step: number of the step.
        slots: which of the batch's rays to return.
        num_rays: of the whole batch; those of a view are contiguous.
        num_views: of a batch.
        key: of the attempt.
    """
    total, per_view = len(starts), -(-num_rays // num_views)
    turn = step * num_views + slots // per_view
    numbers = torch.empty_like(slots)
    for number in turn.unique().tolist():
        lap, place = divmod(number, total)
        view = int(permute(torch.tensor([place]), total, torch.tensor([fold(key, "views", lap)])))
        here = turn == number
        count = int(counts[view])
        # A view's rays continue where they ended when it was last used, in an order that is new once all were seen.
        seen = lap * per_view + slots[here] % per_view
        keys = torch.tensor([fold(key, "rays of a view", view, int(round_)) for round_ in (seen // count).unique()])
        round_of = seen // count - int((seen // count).min())
        within = permute(seen % count, count, keys[round_of])
        numbers[here] = int(starts[view]) + within
    return numbers

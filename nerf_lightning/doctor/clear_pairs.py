"""Pairs of photographs whose matched details fit each other, whatever the poses say: only these may contradict poses.

Details that repeat and photographs far apart make matches that are mostly mistakes, and right poses explain few of
them. But mistakes do not fit any two cameras either.
"""

from dataclasses import dataclass, replace

import torch
from torch import Tensor

from nerf_lightning.doctor.epipolar import agreeing, parallax
from nerf_lightning.doctor.matches import Matches
from nerf_lightning.doctor.proofs import Proof
from nerf_lightning.doctor.refit import refitted, with_pose
from nerf_lightning.nerf.types.scene import Cameras

# So many of the largest pairs are looked at; each must have so many matches.
MOST_PAIRS, FEWEST = 16, 30
# Share of a pair's matches that two free cameras explain, from which on they are no mistakes.
CLEAR = 0.65
# Share of those that the poses must explain.
AGREES = 0.5
# Radians between the rays of most details: without, any place of the camera would do.
LEAST_PARALLAX = 0.03


@dataclass(frozen=True)
class ClearPair:
    """Two photographs whose details fit each other."""

    contradicts: bool
    """The poses do not explain most of what fits."""
    proof: Proof
    """What fits, and how the two cameras stand to each other."""


def clear_pairs(matches: Matches, cameras: Cameras) -> list[ClearPair]:
    """Return the clear ones among the largest pairs, the largest first.

    Args:
        matches: of all pairs.
        cameras: whose poses are judged.
    """
    _, pair, count = matches.view.unique(dim=0, return_inverse=True, return_counts=True)
    largest = [number for number in count.argsort(descending=True)[:MOST_PAIRS].tolist() if count[number] >= FEWEST]
    found = (_judged(matches.where(pair == number), cameras) for number in largest)
    return [each for each in found if each is not None]


def _judged(matches: Matches, cameras: Cameras) -> ClearPair | None:
    view, other = matches.view[0].tolist()
    # The other camera where it is; this one turned alike and a step beside it, to any of six sides.
    there = cameras.c2w[other].double()
    steps = torch.cat([torch.eye(3), -torch.eye(3)]).double()
    eyes = there[:, 3] + steps @ there[:, :3].T * float(_step(cameras))
    starts = torch.cat([there[:, :3].expand(6, 3, 3), eyes[:, :, None]], dim=-1)
    poses = refitted(matches, cameras.c2w, starts.to(cameras.c2w))
    tried = [replace(cameras, c2w=with_pose(cameras.c2w, view, pose)) for pose in poses]
    explained = torch.stack([agreeing(matches, each.c2w) for each in tried])
    best = int(explained.sum(dim=1).argmax())
    fits = explained[best]
    if float(fits.float().mean()) < CLEAR:
        return None
    fitting = matches.where(fits)
    if float(parallax(fitting, tried[best].c2w).median()) < LEAST_PARALLAX:
        return None
    agrees = agreeing(fitting, cameras.c2w)
    against = fitting.where(~agrees) if bool((~agrees).any()) else fitting
    return ClearPair(float(agrees.float().mean()) < AGREES, Proof(against, tried[best]))


def _step(cameras: Cameras) -> Tensor:
    centers = cameras.c2w[:, :, 3]
    return (centers - centers.mean(dim=0)).norm(dim=-1).mean().clamp(min=1e-6)

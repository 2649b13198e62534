"""A second opinion on a view that its neighbours contradict: only a pose that fits better proves that its own is wrong.

Details that repeat, stripes around a can and outlines that slide over a smooth surface make matches that contradict
right poses, too. They give themselves away: no other pose explains them, or the views that stand nearest agree.
"""

from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from nerf_lightning.doctor.check import Evidence
from nerf_lightning.doctor.epipolar import agreeing
from nerf_lightning.doctor.features import shrunk_cameras
from nerf_lightning.doctor.matches import Matches, matched_pairs
from nerf_lightning.doctor.refit import refitted, with_pose

# The other pose must explain so many details that the given one does not, of so many from each of two other views.
FEWEST, FEWEST_OF_A_PAIR = 24, 8
# It must explain this share of what right poses of this capture usually explain, and most of the matches: less may be
# the other side of a thing whose sides look alike.
CONVINCING, MOST = 0.6, 0.55
# The views nearest by the given poses speak for a pose with as many details and this share of the usual.
NEAREST, FEWEST_FOR, SPEAKS_FOR = 4, 20, 0.7
# From where the search begins: the poses of the view and of so many suspects, and of so many views that share most.
MOST_MIXED, STARTS = 8, 4


@dataclass(frozen=True)
class BetterPose:
    """Where a photograph was taken from, as the details say that it shares with others."""

    view: int
    pose: Float[Tensor, "3 4"]
    neighbors: tuple[int, ...]
    """The views that speak for it, the one with most details first."""
    explained: float
    """Share of the view's matches that lie where this pose says."""
    before: float
    """The same share with the given pose."""
    degrees: float
    """By which the given pose is turned away from it."""


def is_vouched_for(evidence: Evidence, view: int, others: list[int]) -> bool:
    """Tell whether the views that stand nearest, by the given poses, agree with a view.

    Args:
        evidence: all that was found.
        view: the one that is contradicted.
        others: the views that nothing is said against.
    """
    c2w = evidence.scene.cameras.c2w
    known = [other for other in others if other != view and other in evidence.corners]
    away = (c2w[known, :, 3] - c2w[view, :, 3]).norm(dim=-1)
    # Cameras side by side that look elsewhere share nothing.
    turned = (c2w[known, :, 2] - c2w[view, :, 2]).norm(dim=-1)
    order = (away / away.median().clamp(min=1e-12) + turned).argsort()[:NEAREST].tolist()
    pairs = [(view, known[place]) for place in order]
    matches = matched_pairs(shrunk_cameras(evidence.scene.cameras), evidence.corners, pairs)
    agrees = agreeing(matches, c2w)
    return int(agrees.sum()) >= FEWEST_FOR and float(agrees.float().mean()) >= SPEAKS_FOR * evidence.agreement


def better_pose(evidence: Evidence, view: int, suspects: list[int]) -> BetterPose | None:
    """Return the pose that explains what a view shares with others, if one does and the given one does not.

    Args:
        evidence: all that was found.
        view: the one that is contradicted.
        suspects: all views that are contradicted; what they share proves nothing.
    """
    c2w, own = evidence.scene.cameras.c2w, _of_view(evidence.matches, view, suspects)
    partner = own.view[:, 1]
    if len(own.view) < FEWEST or len(partner.unique()) < 2:
        return None
    before = agreeing(own, c2w)
    poses = refitted(own, c2w, _starts(own, c2w, suspects))
    explained = torch.stack([agreeing(own, with_pose(c2w, view, pose)) for pose in poses])
    best = int(explained.sum(dim=1).argmax())
    gained = explained[best] & ~before
    speaking, counts = partner[gained].unique(return_counts=True)
    strong = speaking[counts >= FEWEST_OF_A_PAIR][counts[counts >= FEWEST_OF_A_PAIR].argsort(descending=True)]
    share = float(explained[best].float().mean())
    if int(gained.sum()) < FEWEST or len(strong) < 2 or share < max(CONVINCING * evidence.agreement, MOST):
        return None
    turn = poses[best, :, :3].T @ c2w[view, :, :3]
    degrees = float((0.5 * (turn.diagonal().sum() - 1)).clamp(-1, 1).acos().rad2deg())
    return BetterPose(view, poses[best], tuple(strong.tolist()), share, float(before.float().mean()), degrees)


def _of_view(matches: Matches, view: int, suspects: list[int]) -> Matches:
    """Return a view's matches with its larger partners that are no suspects, the view itself first."""
    matches = matches.with_first(view)
    partner = matches.view[:, 1]
    allowed = ~torch.isin(partner, torch.tensor(suspects))
    size = torch.bincount(partner)[partner]
    return (
        matches.where(allowed & (size >= 0.5 * size[allowed].max())) if bool(allowed.any()) else matches.where(allowed)
    )


def _starts(own: Matches, c2w: Float[Tensor, "views 3 4"], suspects: list[int]) -> Float[Tensor, "starts 3 4"]:
    view, partner = int(own.view[0, 0]), own.view[:, 1]
    others, counts = partner.unique(return_counts=True)
    others = others[counts.argsort(descending=True)][:STARTS]
    middle = c2w[others, :, 3].mean(dim=0)
    # Beside the partner: at its very place no ray of both would meet.
    beside = torch.cat([c2w[others, :, :3], (0.8 * c2w[others, :, 3] + 0.2 * middle)[:, :, None]], dim=-1)
    # Poses that were mixed up are those of other suspects; the view itself is one.
    mixed = [view, *(suspect for suspect in suspects[:MOST_MIXED] if suspect != view)]
    return torch.cat([c2w[mixed], beside])

"""A second opinion on a view that its neighbors contradict: only a pose that fits better proves that its own is wrong.

Repeated details, stripes around a can and outlines that slide over a smooth surface cause matches that contradict right
poses, too. They can be recognized: no other pose explains them, or the nearest views agree.
"""

from dataclasses import dataclass, replace

import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn import functional

from nerf_lightning.doctor.check import Analysis
from nerf_lightning.doctor.epipolar import agreeing, parallax, rays_of
from nerf_lightning.doctor.features import shrunk_cameras
from nerf_lightning.doctor.matches import Matches, Proof, matched_pairs, nearest_views
from nerf_lightning.nerf.geometry.poses import rotation_from_vector
from nerf_lightning.nerf.types.scene import Cameras

# Minimum number of details that the other pose must explain and the given one does not, and that from each of two other
# views.
FEWEST, FEWEST_OF_A_PAIR = 24, 8
# It must explain this share of what right poses of this capture usually explain, and most of the matches: less may be
# the other side of an object whose sides look alike.
CONVINCING, MOST = 0.6, 0.55
# The nearest views by the given poses support a pose with as many details and this share of the usual.
NEAREST, FEWEST_FOR, SPEAKS_FOR = 4, 20, 0.7
# Starting points of the search: the poses of the view, of this many suspects, and of this many views that share most.
MOST_MIXED, STARTS = 8, 4
# Maximum number of the largest pairs that are examined, and of matches of each.
MOST_PAIRS, FEWEST_IN_PAIR = 16, 30
# Minimum share of a pair's matches that two free cameras explain if they are not mistakes; the share of these that the
# poses must explain; and radians between most rays, below which the camera's position is undetermined.
CLEAR, AGREES, LEAST_PARALLAX = 0.65, 0.5, 0.03
# Iterations of a fit, and pixels beyond which a match counts less and less, in the first and in the last iteration.
ROUNDS, WIDE, NARROW = 20, 16.0, 1.0


@dataclass(frozen=True)
class BetterPose:
    """The pose of a photograph according to the details that it shares with others."""

    view: int
    pose: Float[Tensor, "3 4"]
    neighbors: tuple[int, ...]
    """The views that support it, the one with most details first."""
    explained: float
    """Share of the view's matches that agree with this pose."""
    before: float
    """The same share for the given pose."""
    degrees: float
    """Rotation between the given pose and this one."""


def is_vouched_for(analysis: Analysis, view: int, others: list[int]) -> bool:
    """Return whether the nearest of `others`, which are not contradicted, agree with a view."""
    c2w = analysis.scene.cameras.c2w
    known = torch.tensor([other for other in others if other in analysis.corners], dtype=torch.long)
    pairs = [(view, other) for other in nearest_views(c2w, torch.tensor([view]), known, NEAREST)[0].tolist()]
    matches = matched_pairs(shrunk_cameras(analysis.scene.cameras), analysis.corners, pairs)
    agrees = agreeing(matches, c2w)
    return int(agrees.sum()) >= FEWEST_FOR and float(agrees.float().mean()) >= SPEAKS_FOR * analysis.agreement


def better_pose(analysis: Analysis, view: int, suspects: list[int]) -> BetterPose | None:
    """Return the pose that explains what a view shares with others, if one does and the given one does not.

    What the view shares with `suspects`, all contradicted views, proves nothing.
    """
    c2w, own = analysis.scene.cameras.c2w, _of_view(analysis.matches, view, suspects)
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
    if int(gained.sum()) < FEWEST or len(strong) < 2 or share < max(CONVINCING * analysis.agreement, MOST):
        return None
    turn = poses[best, :, :3].T @ c2w[view, :, :3]
    degrees = float((0.5 * (turn.diagonal().sum() - 1)).clamp(-1, 1).acos().rad2deg())
    return BetterPose(view, poses[best], tuple(strong.tolist()), share, float(before.float().mean()), degrees)


def _of_view(matches: Matches, view: int, suspects: list[int]) -> Matches:
    """Return a view's matches with its larger partners that are not suspects, the view itself first."""
    matches = matches.with_first(view)
    partner = matches.view[:, 1]
    allowed, size = ~torch.isin(partner, torch.tensor(suspects)), torch.bincount(partner)[partner]
    least = 0.5 * size[allowed].max() if bool(allowed.any()) else 0
    return matches.where(allowed & (size >= least))


def _starts(own: Matches, c2w: Float[Tensor, "views 3 4"], suspects: list[int]) -> Float[Tensor, "starts 3 4"]:
    view, partner = int(own.view[0, 0]), own.view[:, 1]
    others, counts = partner.unique(return_counts=True)
    others = others[counts.argsort(descending=True)][:STARTS]
    middle = c2w[others, :, 3].mean(dim=0)
    # Next to the partner: at the same position, their rays would not meet.
    beside = torch.cat([c2w[others, :, :3], (0.8 * c2w[others, :, 3] + 0.2 * middle)[:, :, None]], dim=-1)
    # Mixed-up poses are those of other suspects; the view itself is one.
    mixed = [view, *(suspect for suspect in suspects[:MOST_MIXED] if suspect != view)]
    return torch.cat([c2w[mixed], beside])


def clear_pairs(matches: Matches, cameras: Cameras) -> list[tuple[bool, Proof]]:
    """Return the clear ones of the largest pairs, the largest first; `cameras` are judged.

    For each: whether the poses fail to explain most of the fitting matches, and those that contradict them (all, if
    none do), with the fitted cameras.
    """
    _, pair, count = matches.view.unique(dim=0, return_inverse=True, return_counts=True)
    largest = [
        number for number in count.argsort(descending=True)[:MOST_PAIRS].tolist() if count[number] >= FEWEST_IN_PAIR
    ]
    found = (_judged(matches.where(pair == number), cameras) for number in largest)
    return [each for each in found if each is not None]


def _judged(matches: Matches, cameras: Cameras) -> tuple[bool, Proof] | None:
    view, other = matches.view[0].tolist()
    # The other camera is fixed; this one has the same rotation and is a step away, in any of six directions.
    there = cameras.c2w[other].double()
    steps = torch.cat([torch.eye(3), -torch.eye(3)]).double()
    centers = cameras.c2w[:, :, 3]
    step = (centers - centers.mean(dim=0)).norm(dim=-1).mean().clamp(min=1e-6)
    eyes = there[:, 3] + steps @ there[:, :3].T * float(step)
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
    return float(agrees.float().mean()) < AGREES, Proof(against, tried[best])


def refitted(
    own: Matches, c2w: Float[Tensor, "views 3 4"], starts: Float[Tensor, "starts 3 4"]
) -> Float[Tensor, "starts 3 4"]:
    """Return each start after Gauss-Newton steps on the distances of matches from the planes of their partners' rays.

    Large distances count less and less (Cauchy weights, ever narrower), since some of the matches are wrong. The
    matches are of one view, which comes first in each, and the poses of the others are assumed to be right.
    """
    rays, _ = rays_of(own, c2w)
    there, focal = rays[:, 1], own.focal[:, 0].double()
    eyes = c2w[own.view[:, 1], :, 3].double()
    local = torch.cat([own.plane[:, 0] * own.plane.new_tensor([1.0, -1.0]), -torch.ones(len(eyes), 1)], dim=-1).double()
    local = functional.normalize(local, dim=-1)
    rotation, center = starts[:, :, :3].double(), starts[:, :, 3].double()
    unit = float((center - eyes.mean(dim=0)).norm(dim=-1).mean().clamp(min=1e-9))

    def off(step: Float[Tensor, "*tried starts 6"]) -> Float[Tensor, "*tried starts matches"]:
        turned = rotation_from_vector(step[..., :3]) @ rotation
        between = eyes - (center + unit * step[..., 3:])[..., None, :]
        normal = functional.normalize(torch.linalg.cross(between, there.expand_as(between)), dim=-1)
        return focal * (normal * (local @ turned.mT)).sum(dim=-1)

    tiny = 1e-5
    tried = torch.cat([torch.zeros(1, 6), tiny * torch.eye(6)]).double()[:, None].expand(7, len(starts), 6)
    for number in range(ROUNDS):
        width = WIDE * (NARROW / WIDE) ** (number / (ROUNDS - 1))
        here, *beside = off(tried)
        slopes = (torch.stack(beside, dim=-1) - here[..., None]) / tiny
        weighted = slopes / (1 + (here / width).square())[..., None]
        system = weighted.mT @ slopes
        system = system + (1e-3 * system.diagonal(dim1=1, dim2=2).mean(dim=1) + 1e-9)[:, None, None] * torch.eye(6)
        step = -torch.linalg.solve(system, (weighted.mT @ here[..., None])[..., 0])
        step = step * (0.3 / step.norm(dim=1, keepdim=True).clamp(min=0.3))
        rotation = rotation_from_vector(step[:, :3]) @ rotation
        center = center + unit * step[:, 3:]
    return torch.cat([rotation, center[:, :, None]], dim=-1).to(starts)


def with_pose(c2w: Float[Tensor, "views 3 4"], view: int, pose: Float[Tensor, "3 4"]) -> Float[Tensor, "views 3 4"]:
    """Return the poses with one of them changed."""
    changed = c2w.clone()
    changed[view] = pose
    return changed

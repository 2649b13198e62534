"""Checks of the poses against the pixels: places that photographs share must agree with the cameras."""

from dataclasses import replace
from functools import partial

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from nerf_lightning.doctor.check import MORE_DETAILS, Analysis, Check, CheckFn, look, not_judged, ok, wrong
from nerf_lightning.doctor.conventions import AXES, ORDERS, PHOTOGRAPHS, Reading
from nerf_lightning.doctor.epipolar import TOLERANCE, agreeing
from nerf_lightning.doctor.features import LONGER_SIDE
from nerf_lightning.doctor.matches import Matches, Proof, strongest_proof
from nerf_lightning.doctor.second_opinion import (
    CONVINCING,
    BetterPose,
    better_pose,
    clear_pairs,
    is_vouched_for,
    with_pose,
)

FEWEST = 200  # Minimum number of matches to judge the whole capture
# Maximum number of matches used to try other readings.
ENOUGH = 5000
# Size of a view's largest pair, relative to the usual, from which on a view is judged; and its share of agreeing
# matches, relative to the usual, below which its pose is wrong.
CLEAR_PAIR, ODD = 0.4, 0.45
# Shares of matches that agree. Right poses reach 0.6 to 0.9; wrong ones 0.03 to 0.3 by chance.
SOUND, HOPELESS = 0.5, 0.3
# Another reading must explain this much more.
BETTER = 0.1
ZOOMS = (0.25, 0.33, 0.5, 0.6, 0.7, 0.8, 0.9, 0.95, 1.0, 1.05, 1.1, 1.25, 1.4, 1.7, 2.0, 3.0, 4.0)
# Relative errors of the focal length from which on it is noted, and wrong.
OFF, FAR_OFF = 1.15, 1.35
CLEARER = 0.01
# Maximum number of contradicted views for which a better pose is searched, and reported.
MOST_REFITTED, MOST_TOLD = 20, 3
# Minimum number of clear pairs of photographs to judge all poses wrong, and the share of them that contradicts the
# poses.
FEWEST_CLEAR, MOST_AGAINST = 4, 0.8
DOUBTFUL = "It may be details that repeat or shine, or photographs far apart; more or larger photographs help to tell."
TOO_FEW = "too few details could be found again from one photograph to another"


def poses_and_pixels(analysis: Analysis) -> Check:
    """Judge whether the poses explain what photographs share."""
    share, count = analysis.agreement, len(analysis.matches.view)
    if count < FEWEST:
        return not_judged(TOO_FEW, MORE_DETAILS)
    near = f"(to {TOLERANCE} pixels of {LONGER_SIDE})"
    message = f"{100 * share:.0f} % of {count} matched details lie where the cameras say {near}"
    if share >= SOUND:
        return ok(message)
    return _by_clear_pairs(analysis, message)


def _by_clear_pairs(analysis: Analysis, message: str) -> Check:
    """Judge all poses by pairs of photographs whose matches are certain, since most matches do not agree."""
    pairs = clear_pairs(analysis.matches, analysis.scene.cameras)
    against = [proof for contradicts, proof in pairs if contradicts]
    if len(pairs) < FEWEST_CLEAR:
        return not_judged(f"{message}; too few photographs share enough details to tell", DOUBTFUL)
    share = len(against) / len(pairs)
    message += f"; {len(against)} of {len(pairs)} pairs whose details fit each other contradict the poses"
    if share <= 1 - MOST_AGAINST:
        return ok(message)
    cure = "See the other verdicts for the cause; if they name none, estimate the poses again (nerf poses)."
    if share < MOST_AGAINST or analysis.agreement >= HOPELESS:
        return look(message, cure)
    return wrong(message, cure, (against[0],))


def focal_length(analysis: Analysis) -> Check:
    """Judge whether another focal length explains the pixels better."""
    matches, cameras, c2w = thinned(analysis.matches, ENOUGH), analysis.scene.cameras, analysis.scene.cameras.c2w
    shares = {zoom: _share(matches, c2w, zoom) for zoom in ZOOMS}
    if len(matches.view) < FEWEST:
        return not_judged(TOO_FEW, MORE_DETAILS)
    if max(shares.values()) < HOPELESS:
        return not_judged("too few details lie where the cameras say, with any focal length", DOUBTFUL)
    best = max(shares, key=lambda zoom: shares[zoom])
    off = max(best, 1 / best)
    focal = float(cameras.focal.median())
    if off < OFF or shares[best] < shares[1.0] + CLEARER:
        if max(shares[zoom] for zoom in ZOOMS if max(zoom, 1 / zoom) >= FAR_OFF) > shares[1.0] - CLEARER:
            return not_judged("other focal lengths fit as well", "It needs photographs from more sides.")
        return ok(f"{focal:.0f} pixels (median) fits the poses and the pixels best")
    against = agreeing(analysis.matches, c2w, best) & ~analysis.agrees
    return (wrong if off >= FAR_OFF else look)(
        f"the pixels fit the poses better with {best:g} times the focal length: {100 * shares[best]:.0f} % of matched "
        f"details agree instead of {100 * shares[1.0]:.0f} %",
        f"Set the focal length to about {best * focal:.0f} pixels (it is {focal:.0f}); often it belongs to photographs "
        "of another size, or the field of view is that of the other side.",
        strongest_proof(analysis.matches, against, replace(cameras, focal=best * cameras.focal)),
    )


def single_poses(analysis: Analysis) -> Check:
    """Judge each view's pose by the views that share most with it."""
    matches, c2w = analysis.matches, analysis.scene.cameras.c2w
    if len(matches.view) < FEWEST:
        return not_judged(TOO_FEW, MORE_DETAILS)
    if analysis.agreement < SOUND:
        # The poses as a whole may be the cause: poses_and_pixels decides.
        share = f"{100 * analysis.agreement:.0f} % of matched details lie where the cameras say"
        return not_judged(f"only {share}, too few to tell one view from another", DOUBTFUL)
    bad, judged, least = odd_views(matches, analysis.agrees, len(c2w))
    found = f"{judged} of {len(matches.views)} views could be judged"
    if 2 * judged < len(matches.views):
        return not_judged(f"only {found}", MORE_DETAILS)
    if not bad:
        return ok(f"{found}, and agree with their neighbors (least {least:.0%})")
    others = [view for view in range(len(c2w)) if view not in bad]
    doubted = [view for view in bad if not is_vouched_for(analysis, view, others)]
    if not doubted:
        return ok(f"{found}; {analysis.named(bad)} agree with the nearest views")
    better = [pose for view in doubted[:MOST_REFITTED] if (pose := better_pose(analysis, view, bad))]
    if not better:
        message = f"few details that {analysis.named(doubted)} share with others lie where the cameras say"
        return not_judged(f"{message}, but no other pose fits better", DOUBTFUL)
    return _wrong_poses(analysis, better, bad)


def _wrong_poses(analysis: Analysis, better: list[BetterPose], suspects: list[int]) -> Check:
    c2w = analysis.scene.cameras.c2w
    least, views = CONVINCING * analysis.agreement, [pose.view for pose in better]
    fits = {view: fitting_pose(analysis.matches, c2w, view, suspects, least) for view in views}
    mixed_up = {view: other for view, other in fits.items() if other is not None}
    swapped = [f"{analysis.named([a])} fits the camera of {analysis.named([b])}" for a, b in mixed_up.items()]
    turned = [
        f"{analysis.named([pose.view])} fits with a pose {pose.degrees:.1f} degrees away ({100 * pose.explained:.0f} % "
        f"of its details lie where that one says, {100 * pose.before:.0f} % where the given one does)"
        for pose in better
        if fits[pose.view] is None
    ]
    return wrong(
        f"the pose of {analysis.named(views)} contradicts what its photograph shares with others; "
        + "; ".join([*swapped, *turned][:MOST_TOLD]),
        "Give each photograph its own pose (swap them back), or remove these views (scene.frames, or from the file)."
        if swapped
        else "Remove these views (scene.frames, or from the file), or estimate their poses again.",
        tuple(proof for pose in better for proof in _proof_of(analysis, pose)),
    )


def _proof_of(analysis: Analysis, pose: BetterPose) -> tuple[Proof, ...]:
    matches, cameras = analysis.matches, analysis.scene.cameras
    c2w = with_pose(cameras.c2w, pose.view, pose.pose)
    shared = (matches.view == pose.view).any(dim=1) & torch.isin(matches.view, torch.tensor(pose.neighbors)).any(dim=1)
    against = agreeing(matches, c2w) & ~analysis.agrees & shared
    return strongest_proof(matches, against, replace(cameras, c2w=c2w), pose.view)


def odd_views(matches: Matches, good: Bool[Tensor, "matches"], num_views: int) -> tuple[list[int], int, float]:
    """Return views that contradict the rest, the worst first; how many could be judged; and their minimum share.

    They are found one at a time; the matches of each are then ignored, so that they do not count against its neighbors.
    `good` are the matches that agree with the cameras.
    """
    shares, largest = shares_of_views(matches, good, num_views)
    # Of photographs that share little, most matches are mistakes: they prove nothing.
    clear = CLEAR_PAIR * largest[largest > 0].median()
    judged, least = int((largest >= clear).sum()), float(shares[largest >= clear].min())
    usual, bad = shares[largest >= clear].median(), []
    for _ in range(num_views):
        worst = int(torch.where(largest >= clear, shares, 2.0).argmin())
        if float(largest[worst]) < clear or shares[worst] >= ODD * usual:
            break
        bad.append(worst)
        rows = (matches.view != worst).all(dim=1)
        matches, good = matches.where(rows), good[rows]
        shares, largest = shares_of_views(matches, good, num_views)
    return bad, judged, least


def shares_of_views(
    matches: Matches, good: Bool[Tensor, "matches"], num_views: int
) -> tuple[Float[Tensor, "views"], Float[Tensor, "views"]]:
    """Return for each view the share of its matches that agree, and the size of its largest pair.

    Only the larger pairs of each view count: matches of pictures that show different things are mistakes.
    """
    pair = matches.view[:, 0] * num_views + matches.view[:, 1]
    _, number, size = pair.unique(return_inverse=True, return_counts=True)
    size = size[number]
    most = torch.zeros(num_views, dtype=size.dtype)
    for side in (0, 1):
        most.scatter_reduce_(0, matches.view[:, side], size, "amax")
    shared, agreed = torch.zeros(num_views), torch.zeros(num_views)
    for side in (0, 1):
        view = matches.view[:, side]
        strong = (size >= 0.5 * most[view]).float()
        shared.index_add_(0, view, strong)
        agreed.index_add_(0, view, strong * good)
    return agreed / shared.clamp(min=1), most.float()


def thinned(matches: Matches, most: int) -> Matches:
    """Return at most `most` of the matches, evenly spread."""
    step = -(-len(matches.view) // most) or 1
    return matches.where(slice(None, None, step))


def fitting_pose(
    matches: Matches, c2w: Float[Tensor, "views 3 4"], view: int, suspects: list[int], least: float
) -> int | None:
    """Return the suspect whose camera fits this view's photograph, if any: the two were mixed up."""
    own = matches.where((matches.view == view).any(dim=1))
    best, best_share = None, least
    for other in suspects:
        # A match with the view whose camera is tried proves nothing: the centers would coincide.
        free = own.where(~(own.view == other).any(dim=1))
        if other == view or len(free.view) < 20:
            continue
        share = _share(free, with_pose(c2w, view, c2w[other]))
        if share > best_share:
            best, best_share = other, share
    return best


def _share(matches: Matches, c2w: Float[Tensor, "views 3 4"], zoom: float = 1.0) -> float:
    return float(agreeing(matches, c2w, zoom).float().mean()) if len(matches.view) else 0.0


def best_reading(analysis: Analysis, readings: tuple[Reading, ...], fine: str) -> Check:
    """Judge whether another reading of the capture explains the pixels better; `fine`: the message if not."""
    scene, matches = analysis.scene, thinned(analysis.matches, ENOUGH)
    if len(matches.view) < FEWEST:
        return not_judged(TOO_FEW, MORE_DETAILS)
    given = _share(matches, scene.cameras.c2w)
    shares = [_share(changed, poses) for poses, changed in (reading.change(scene, matches) for reading in readings)]
    best = max(range(len(readings)), key=shares.__getitem__)
    if shares[best] < max(given + BETTER, HOPELESS):
        if given < HOPELESS:
            return not_judged("too few details lie where the cameras say, under any convention", DOUBTFUL)
        return ok(f"{fine}: no other convention fits the images better")
    poses, changed = readings[best].change(scene, analysis.matches)
    fits = replace(scene.cameras, c2w=poses.to(scene.cameras.c2w)) if changed is analysis.matches else None
    against = agreeing(changed, poses) & ~analysis.agrees
    return wrong(
        f"the poses look {readings[best].says}: {100 * shares[best]:.0f} % of matched details then agree, instead of "
        f"{100 * given:.0f} %",
        readings[best].cure,
        strongest_proof(analysis.matches, against, fits),
    )


CHECKS: dict[str, CheckFn] = {
    "axes": partial(best_reading, readings=AXES, fine="the cameras' axes are right, up, back, camera to world"),
    "mirrored photographs": partial(best_reading, readings=PHOTOGRAPHS, fine="the photographs are not mirrored"),
    "order of photographs": partial(best_reading, readings=ORDERS, fine="each photograph has its own pose"),
    "poses match photographs": poses_and_pixels,
    "single poses": single_poses,
    "focal length": focal_length,
}

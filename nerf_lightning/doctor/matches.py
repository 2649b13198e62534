"""Match places of different photographs by their pixels alone, and collect proofs.

When two corners match: `match` and RATIO in `features.py`.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from nerf_lightning.data.pixels.store import in_threads
from nerf_lightning.doctor.features import Corners, match
from nerf_lightning.nerf.geometry.lenses import unproject
from nerf_lightning.nerf.types.scene import Cameras

# Number of corners of each picture used to find pictures of the same content.
FEW_CORNERS = 64
# Number of others that each view is compared with.
PARTNERS = 6
ALIKE = 0.8
# Of a panorama only what is ahead of its camera (within 60 degrees) is compared: to the sides, places in a plane go to
# infinity. For other lenses they are limited only where they would.
AHEAD, HARDLY_AHEAD = 0.5, 0.05


@dataclass(frozen=True)
class Matches:
    """Matched places of all pairs, concatenated."""

    view: Int[Tensor, "matches 2"]
    """Which two views of the scene."""
    plane: Float[Tensor, "matches 2 2"]
    """Place in each, undistorted, in focal lengths from the principal point, x right, y down."""
    focal: Float[Tensor, "matches 2"]
    """Focal length of each, in pixels of the shrunk pictures."""
    rgb: Float[Tensor, "matches 2 3"]
    """Color around the place in each."""
    views: tuple[int, ...]
    """The examined views: all, or a subset of very many."""

    def where(self, rows: Bool[Tensor, "matches"] | slice) -> "Matches":
        """Return the selected matches."""
        return Matches(self.view[rows], self.plane[rows], self.focal[rows], self.rgb[rows], self.views)

    def with_first(self, view: int) -> "Matches":
        """Return a view's matches with its own end first."""
        own = self.where((self.view == view).any(dim=1))
        turned = own.view[:, 1] == view
        view_, plane, focal, rgb = (
            torch.where(turned.view(-1, *[1] * (part.dim() - 1)), part.flip(1), part)
            for part in (own.view, own.plane, own.focal, own.rgb)
        )
        return Matches(view_, plane, focal, rgb, self.views)


@dataclass(frozen=True)
class Proof:
    """Two photographs with details that are visible in both and that contradict the cameras."""

    matches: Matches
    """Details of the two, all of which contradict the cameras."""
    fits: Cameras | None
    """All cameras according to the details, if known."""


def strongest_proof(
    matches: Matches, against: Bool[Tensor, "matches"], fits: Cameras | None, view: int | None = None
) -> tuple[Proof, ...]:
    """Return the pair of photographs (with `view` first, if given) with most of the matches `against` the cameras.

    There may be none; `fits` are the cameras that they support.
    """
    matches = matches.where(against) if view is None else matches.where(against).with_first(view)
    if not len(matches.view):
        return ()
    _, pair, count = matches.view.unique(dim=0, return_inverse=True, return_counts=True)
    return (Proof(matches.where(pair == count.argmax()), fits),)


def matched_pairs(
    cameras: Cameras, corners: Mapping[int, Corners], pairs: Sequence[tuple[int, int]], visible: bool = False
) -> Matches:
    """Return places matched between the two views of each pair; cameras are for the shrunk pictures."""

    def matched(number: int) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        both = list(pairs[number])
        found = match(*(corners[view] for view in both))
        if cameras.lens_model == "equirectangular":
            sides = enumerate(both)
            found = found[torch.stack([_ahead(cameras, v, corners[v].xy[found[:, side]]) for side, v in sides]).all(0)]
        plane = [_plane(cameras, view, corners[view].xy[found[:, side]]) for side, view in enumerate(both)]
        rgb = [corners[view].rgb[found[:, side]] for side, view in enumerate(both)]
        focal = cameras.focal[both].mean(dim=-1).expand(len(found), 2)
        return torch.tensor(both).expand(len(found), 2), torch.stack(plane, 1), focal, torch.stack(rgb, 1)

    parts = in_threads(matched, len(pairs), "Comparing photographs", visible)
    none = (torch.zeros(0, 2, dtype=torch.long), torch.zeros(0, 2, 2), torch.zeros(0, 2), torch.zeros(0, 2, 3))
    view, plane, focal, rgb = (torch.cat(column) for column in zip(none, *parts, strict=True))
    return Matches(view, plane, focal, rgb, tuple(sorted(corners)))


def likely_pairs(corners: Mapping[int, Corners]) -> list[tuple[int, int]]:
    """Return pairs of views that have most in common, judged by their clearest corners."""
    views, count = sorted(corners), len(corners)
    few = torch.zeros(count, FEW_CORNERS, max((c.descriptor.shape[1] for c in corners.values()), default=0))
    for number, view in enumerate(views):
        kept = corners[view].descriptor[:FEW_CORNERS]
        few[number, : len(kept)] = kept
    shared = torch.zeros(count, count)
    for number in range(count):
        similar = torch.einsum("cd,vkd->vck", few[number], few)
        best, there = similar.max(dim=2)
        mutual = similar.argmax(dim=1).gather(1, there) == torch.arange(FEW_CORNERS)
        shared[number] = (mutual & (best > ALIKE)).sum(dim=1)
    shared.fill_diagonal_(-1)
    ranked = shared.topk(min(PARTNERS, max(count - 1, 0)), dim=1).indices.tolist()
    likely = {(min(a, b), max(a, b)) for a in range(count) for b in ranked[a] if shared[a, b] > 0}
    return [(views[a], views[b]) for a, b in sorted(likely)]


def _ahead(cameras: Cameras, view: int, xy: Float[Tensor, "places 2"]) -> Bool[Tensor, "places"]:
    plane = (xy - cameras.center[view]) / cameras.focal[view]
    return unproject(plane, cameras.lens[view], cameras.lens_model)[..., 2] > AHEAD


def _plane(cameras: Cameras, view: int, xy: Float[Tensor, "places 2"]) -> Float[Tensor, "places 2"]:
    plane = (xy - cameras.center[view]) / cameras.focal[view]
    if cameras.lens_model == "pinhole":
        return plane
    local = unproject(plane, cameras.lens[view], cameras.lens_model)
    return local[..., :2] / local[..., 2:].clamp(min=HARDLY_AHEAD)


def nearest_views(
    c2w: Float[Tensor, "all 3 4"], views: Int[Tensor, "views"], others: Int[Tensor, "others"], most: int
) -> Int[Tensor, "views nearest"]:
    """Return for each view up to `most` of the others, except itself, that are near and look in its direction.

    The nearest comes first; half of the usual distance to the others counts as much as 30 degrees.
    """
    away = torch.cdist(c2w[views, :, 3], c2w[others, :, 3])
    # Adjacent cameras that look in different directions share nothing.
    turned = torch.cdist(c2w[views, :, 2], c2w[others, :, 2])
    apart = away / away.mean(dim=1, keepdim=True).clamp(min=1e-12) + turned
    apart[views[:, None] == others] = torch.inf
    count = min(most, int(apart.isfinite().sum(dim=1).min()))
    return others[apart.topk(count, largest=False).indices]

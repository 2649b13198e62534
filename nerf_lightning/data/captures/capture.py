"""The content of a capture before any pixel is read: views with poses and intrinsics, sparse points, splits."""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from nerf_lightning.data.captures.left_out import LeftOut
from nerf_lightning.data.pixels.decoded_photographs import Photograph
from nerf_lightning.messages.errors import InputError
from nerf_lightning.messages.escaping import listed
from nerf_lightning.nerf.types.scene import LensModel

SINGLE: tuple[LensModel, ...] = ("fisheye", "equirectangular")
"""Lens models that cannot be expressed by another."""
MOST_ODD = 0.25
"""Maximum share of views that are left out because their kind of lens differs from the others'."""


@dataclass(frozen=True)
class View:
    """One photograph with its camera, as given by the format."""

    name: str
    photograph: Photograph
    c2w: Float[Tensor, "3 4"]
    """Camera to the user's world: right, up, back, center; float64."""
    focal: tuple[float, float]
    """In pixels of `size`."""
    center: tuple[float, float]
    size: tuple[float, float]
    """(width, height) for which the intrinsics hold; the picture may be a shrunk copy."""
    lens: tuple[float, float, float, float, float, float] = (0.0, 0.0, 0.0, 0.0, 0.0, 0.0)
    """k1, k2, k3, k4, p1, p2."""
    depth: Path | None = None
    """A 16-bit gray picture or a NumPy array (.npy) of depths along the camera's axis; 0 is unknown."""
    depth_unit: float | None = None
    """Length of a unit of `depth`, in units of the capture; None: see `known_depths.depths_of_maps`."""


@dataclass(frozen=True)
class Capture:
    """A whole capture in the user's own frame."""

    views: tuple[View, ...]
    source: Path
    """The file that lists the views, for messages."""
    lens_model: LensModel = "pinhole"
    points: Float[Tensor, "points 3"] = field(default_factory=lambda: torch.zeros(0, 3, dtype=torch.float64))
    """Sparse points of the reconstruction."""
    point_errors: Float[Tensor, "known"] = field(default_factory=lambda: torch.zeros(0, dtype=torch.float64))
    """Mean reprojection error of each point in pixels; empty without `tracks`."""
    tracks: Int[Tensor, "seen 2"] = field(default_factory=lambda: torch.zeros(0, 2, dtype=torch.int64))
    """Which point was seen in which view, if the format says so."""
    bounds: Float[Tensor, "views 2"] | None = None
    """Nearest and farthest depth of content, if the format has them."""
    box: Float[Tensor, "2 3"] | None = None
    """Lower and upper corner of the content's bounding box, if the format has one."""
    splits: dict[str, tuple[int, ...]] | None = None
    """If the format names them."""
    undo: Float[Tensor, "4 4"] = field(default_factory=lambda: torch.eye(4, dtype=torch.float64))
    """Transforms the poses' frame into the frame of the capture's author."""
    left_out: LeftOut = field(default_factory=lambda: LeftOut(""))
    """Views that cannot be used, and photographs that have no pose."""
    depth_unit: float = 1e-3
    """Length of a level of the views' depth maps, in units of the capture; sensors count millimeters."""

    def some(self, views: Sequence[int]) -> "Capture":
        """Return some of the views, in order; the splits follow."""
        place = {number: new for new, number in enumerate(views)}
        splits = self.splits and {
            split: tuple(place[number] for number in numbers if number in place)
            for split, numbers in self.splits.items()
        }
        bounds = None if self.bounds is None else self.bounds[list(views)]
        numbers = torch.full((len(self.views),), -1)
        numbers[list(views)] = torch.arange(len(views))
        tracks = torch.stack([self.tracks[:, 0], numbers[self.tracks[:, 1]]], dim=1)
        return replace(
            self,
            views=tuple(self.views[number] for number in views),
            bounds=bounds,
            splits=splits,
            tracks=tracks[tracks[:, 1] >= 0],
        )

    def some_points(self, mask: Bool[Tensor, "points"]) -> "Capture":
        """Return the capture with some of its sparse points; the tracks follow."""
        tracks = self.tracks[mask[self.tracks[:, 0]]]
        numbers = mask.cumsum(dim=0) - 1
        return replace(
            self,
            points=self.points[mask],
            point_errors=self.point_errors[mask] if len(self.point_errors) else self.point_errors,
            tracks=torch.stack([numbers[tracks[:, 0]], tracks[:, 1]], dim=1),
        )


def common_lens_model(kinds: set[LensModel]) -> LensModel | None:
    """Return the lens model, of which a scene has one, that can express all of these; None if there is none.

    A lens without distortion has coefficients of 0; fisheyes and panoramas cannot be combined with others.

    >>> common_lens_model({"pinhole", "radial_tangential"}), common_lens_model({"pinhole", "fisheye"})
    ('radial_tangential', None)
    """
    if len(kinds) == 1:
        return next(iter(kinds))
    if kinds & set(SINGLE):
        return None
    return "radial_tangential" if "radial_tangential" in kinds else "pinhole"


def of_one_lens(capture: Capture, kinds: Sequence[LensModel]) -> Capture:
    """Return a capture with the lens model that can express those of all views (`kinds`), or of all but a few.

    A scene has one kind of lens. Up to a quarter of the views are left out if they have another one.

    Raises:
        InputError: no kind of lens suits enough views.
    """
    groups = [{kind for kind in kinds if kind not in SINGLE}, *({kind} for kind in SINGLE)]
    usual = max(groups, key=lambda group: sum(kind in group for kind in kinds))
    kept = [number for number, kind in enumerate(kinds) if kind in usual]
    if len(kinds) - len(kept) > MOST_ODD * len(kinds):
        raise InputError(
            f"{capture.source} mixes lenses of several kinds ({listed(sorted(set(kinds)))}), and a scene has one. "
            "Undistort the photographs, or split the capture: one for each kind."
        )
    for view, kind in zip(capture.views, kinds, strict=True):
        if kind not in usual:
            capture.left_out.faults[view.name] = (
                f"{capture.source}: {view.name} has another kind of lens ({kind}) than most views, and a scene has "
                "one. Undistort the photographs."
            )
    return replace(capture.some(kept), lens_model=common_lens_model(usual) or "pinhole")

"""The coverage map of a page: from which directions the scene was seen. The page writes its labels as text.

What counts as seen: NEAR_ENOUGH in `visualization/camera_layout.py`.
"""

from typing import NamedTuple

import torch

from nerf_lightning.nerf.geometry.world_frame import directions_seen
from nerf_lightning.nerf.types.scene import SceneRecord
from nerf_lightning.visualization.camera_layout import CELL, COLOURS, NEAR_ENOUGH, seen_cells, views_by_split

WIDTH = 360  # Of the map, in its own units: degrees, or for forward-facing captures, a part of their width
MARGIN = 0.15
Dot = tuple[float, float]


class CoverageMap(NamedTuple):
    """A map in a page; its shapes are in its own units, y down."""

    caption: str
    height: float
    covered: str
    """The path (SVG) around what was seen; empty: the map has dots alone."""
    splits: list[tuple[str, str, list[Dot]]]
    """Label, color and dots of each split."""
    across: list[str]
    """Labels of the x axis, evenly spaced."""
    up: list[str]
    """Labels of the y axis from the top."""
    width: float = WIDTH


def coverage_map(scene: SceneRecord) -> CoverageMap:
    """Return the map of directions or, of a forward-facing capture, of the cameras' positions."""
    return _positions(scene) if scene.space == "ndc" else _directions(scene)


def _directions(scene: SceneRecord) -> CoverageMap:
    azimuth, elevation = directions_seen(scene)
    return CoverageMap(
        f"Directions around the middle of the scene, in degrees: azimuth across, elevation up. Green is within "
        f"{NEAR_ENOUGH:.0f} degrees of a photograph. Directions from which nobody will look need no photographs.",
        180,
        "".join(_row(180 - CELL * (row + 1), cells) for row, cells in enumerate(seen_cells(scene).tolist())),
        _dots(scene, azimuth + 180, 90 - elevation),
        ["-180", "-90", "0", "90", "180"],
        ["90", "45", "0", "-45", "-90"],
    )


def _positions(scene: SceneRecord) -> CoverageMap:
    places = scene.cameras.c2w[:, :2, 3]
    low, high = places.amin(dim=0), places.amax(dim=0)
    middle, half = (low + high) / 2, (high - low).max().clamp(min=1e-6) * (0.5 + MARGIN)
    # As wide as high as the cameras' positions; at least a third, for the labels.
    ratio = float(((high - low)[1] / (2 * half) + MARGIN).clamp(1 / 3, 1))
    across, up = (places - middle).unbind(dim=-1)
    x, y = WIDTH / 2 * (1 + across / half), WIDTH / 2 * (ratio - up / half)
    ends = [middle + sign * half * torch.tensor([1.0, ratio]) for sign in (-1, 1)]
    return CoverageMap(
        "Where the cameras stood, seen from behind them, in scene units: x across, y up.",
        WIDTH * ratio,
        "",
        _dots(scene, x, y),
        [f"{end[0]:.2g}" for end in ends],
        [f"{end[1]:.2g}" for end in reversed(ends)],
    )


def _dots(scene: SceneRecord, x: torch.Tensor, y: torch.Tensor) -> list[tuple[str, str, list[Dot]]]:
    val, test = (scene.splits.get(name, ()) for name in ("val", "test"))
    kinds = ("validation" if val != test else "", "test" if test else "")
    labels = {"train": "training", "held out": " and ".join(filter(None, kinds))}
    return [
        (
            f"{labels[split]} ({len(views)})",
            COLOURS[split],
            [(round(float(x[v]), 1), round(float(y[v]), 1)) for v in views],
        )
        for split, views in views_by_split(scene).items()
        if views
    ]


def _row(top: int, covered: list[bool]) -> str:
    """Return rectangles over neighboring cells of a row that were seen.

    >>> _row(0, [False, True, True, False])
    'M3 0h6v3h-6z'
    """
    path, start = "", 0
    for column, cell in enumerate([*covered, False]):
        if not cell:
            width = CELL * (column - start)
            path += f"M{CELL * start} {top}h{width}v{CELL}h-{width}z" if width else ""
            start = column + 1
    return path

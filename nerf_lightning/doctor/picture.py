"""The picture of an examined capture: its cameras from above and from the side, and from where it was seen."""

from collections.abc import Sequence
from typing import TYPE_CHECKING

from jaxtyping import Float, UInt8
from torch import Tensor

from nerf_lightning.doctor.check import Check, Evidence
from nerf_lightning.doctor.epipolar import places
from nerf_lightning.doctor.extent import clear_matches
from nerf_lightning.visualization.camera_layout import MOST_POINTS, draw_coverage, draw_layout
from nerf_lightning.visualization.figures import new_figure, picture_of

if TYPE_CHECKING:
    from matplotlib.axes import Axes

WIDEST = 130
VERDICTS = {"ok": "#3c9d6b", "look": "#d9a400", "wrong": "#c8372d"}


def doctor_picture(
    evidence: Evidence, checks: Sequence[Check], about: str, width: int = 1500, height: int = 1150
) -> UInt8[Tensor, "height width 3"]:
    """Return the picture: two views of the cameras, the coverage map and the verdicts.

    Args:
        evidence: what was found.
        checks: the verdicts.
        about: what was examined, in one line.
        width: in pixels.
        height: in pixels.
    """
    figure = new_figure(width, height)
    grid = figure.add_gridspec(2, 2, height_ratios=[1.25, 1.0], width_ratios=[1.0, 1.0])
    scene = evidence.scene
    above, side = figure.add_subplot(grid[0, 0]), figure.add_subplot(grid[0, 1])
    content = content_points(evidence)
    draw_layout(above, side, scene, content)
    draw_coverage(figure.add_subplot(grid[1, 0]), scene)
    _write_verdicts(figure.add_subplot(grid[1, 1]), checks)
    points = len(content)
    what = "sparse points" if len(scene.points) else "matched details"
    figure.suptitle(
        f"{shortened(about)}\n{points} {what}, space {scene.space}",
        fontsize=12,
        weight="bold",
        parse_math=False,
    )
    return picture_of(figure)


def shortened(text: str) -> str:
    """Return a line that a picture has room for, without the beginning of a long one."""
    return text if len(text) <= WIDEST else f"... {text[-WIDEST:]}"


def content_points(evidence: Evidence) -> Float[Tensor, "points 3"]:
    """Return where content lies: the sparse points, or where the rays of matched details meet."""
    scene = evidence.scene
    found = scene.points
    if not len(found):
        found = places(evidence.matches, scene.cameras.c2w)[clear_matches(evidence)]
    return found[:: max(1, -(-len(found) // MOST_POINTS))]


def _write_verdicts(axes: "Axes", checks: Sequence[Check]) -> None:
    axes.set_axis_off()
    axes.set_title("verdicts", fontsize=11)
    step = 1.0 / max(len(checks), 1)
    for row, check in enumerate(checks):
        y = 1.0 - (row + 0.5) * step
        axes.text(0.0, y, check.verdict, color=VERDICTS[check.verdict], fontsize=8.5, weight="bold", va="center")
        axes.text(0.08, y, check.name, fontsize=8.5, va="center")
        text = check.message if len(check.message) <= 80 else check.message[:78].rstrip() + " ..."
        axes.text(0.34, y, text, fontsize=7.5, color="0.35", va="center", parse_math=False)
    axes.set_xlim(0, 1)
    axes.set_ylim(0, 1)

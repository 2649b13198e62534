"""Summarize found poses for the user."""

from pathlib import Path

from nerf_lightning.data.sfm.reconstruction import SparseModel
from nerf_lightning.messages.console import spoken
from nerf_lightning.messages.escaping import listed

# Share of the photographs: if fewer were registered, give advice.
ENOUGH = 0.8


def summary_lines(model: SparseModel, matching: str, is_video: bool, folder: Path, seconds: float) -> list[str]:
    """Return what was found and written to `folder` as lines, with advice if it is little."""
    found, total = len(model.registered), len(model.registered) + len(model.left_out)
    what = "frames" if is_video else "photographs"
    cameras = "one camera" if model.num_cameras == 1 else f"{model.num_cameras} cameras"
    lines = [
        f"registered          {found} of {total} {what} ({cameras}, {matching} matching)",
        f"reprojection error  {model.reprojection_error:.2f} px",
        f"points              {model.num_points}",
        f"time                {spoken(seconds)}",
        f"written             {folder}",
    ]
    if model.left_out:
        lines.append(f"left out            {listed(model.left_out)}")
    return [*lines, *remarks(model, matching, is_video)]


def remarks(model: SparseModel, matching: str, is_video: bool) -> list[str]:
    """Return what to do differently, if anything."""
    lines = []
    if model.apart:
        lines.append(
            f"{listed(model.apart, 4)} fit together but not with the rest: if they show another place, make a separate "
            "capture of them; if not, photographs between the two are missing."
        )
    if len(model.registered) < ENOUGH * (len(model.registered) + len(model.left_out)):
        more = (
            "film slowly, walking rather than turning; a smaller every= takes more frames of this video."
            if is_video
            else "take more photographs between those left out and the others (overlapping by two thirds), sharp ones, "
            "with one zoom and from positions a few steps apart."
        )
        pairs = " matching=exhaustive compares every photograph with every other." if matching == "sequential" else ""
        lines.append(f"few were registered: {more}{pairs}")
    return lines

"""Figures with axes, drawn with matplotlib's objects: without pyplot, there is no global state."""

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np
import torch
from jaxtyping import Float, UInt8
from torch import Tensor

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

_DPI = 100
_LINE = "#3b5b92"


def loss_curve(
    steps: Sequence[int], values: Sequence[float], label: str = "loss", width: int = 640, height: int = 400
) -> UInt8[Tensor, "height width 3"]:
    """Return a plot (`width` by `height` pixels) of a quantity over the steps, on a logarithmic axis.

    Values that are not positive and finite leave a gap.
    """
    figure = new_figure(width, height)
    _draw_curve(figure.subplots(), steps, values, label)
    return picture_of(figure)


def epoch_figure(
    render: Float[Tensor, "rows columns 3"],
    depth: Float[Tensor, "rows columns"],
    steps: Sequence[int],
    losses: Sequence[float],
    height: int = 400,
) -> UInt8[Tensor, "height width 3"]:
    """Return the three panels of one epoch: the render, its depth (scene units, near bright) and the loss."""
    rows, columns = depth.shape
    aspect = min(max(columns / rows, 0.5), 2.0)
    figure = new_figure(round(height * (2 * aspect + 1.7)), height)
    left, middle, right = figure.subplots(1, 3, width_ratios=[aspect, 1.15 * aspect, 1.35])
    left.imshow(render.detach().float().cpu().clamp(0, 1).numpy())
    seen = middle.imshow(depth.detach().float().cpu().numpy(), cmap="magma_r")
    bar = figure.colorbar(seen, ax=middle, fraction=0.05, pad=0.03)
    bar.ax.invert_yaxis()  # near on top, as in the other pictures
    bar.outline.set_visible(False)
    bar.ax.tick_params(labelsize=8, length=2)
    for axes, title in ((left, "render"), (middle, "depth")):
        axes.set_title(title, fontsize=10)
        axes.set_axis_off()
    right.set_title("loss", fontsize=10)
    _draw_curve(right, steps, losses, label="")
    return picture_of(figure)


def new_figure(width: int, height: int) -> "Figure":
    """Return an empty figure of `width` by `height` pixels that lays itself out."""
    from matplotlib.figure import Figure
    from matplotlib.layout_engine import ConstrainedLayoutEngine

    layout = ConstrainedLayoutEngine(w_pad=0.1, h_pad=0.1)
    return Figure(figsize=(width / _DPI, height / _DPI), dpi=_DPI, layout=layout)


def _draw_curve(axes: "Axes", steps: Sequence[int], values: Sequence[float], label: str) -> None:
    shown = np.array(values, dtype=float)
    shown[~((shown > 0) & np.isfinite(shown))] = np.nan
    # A single point makes no line, so it gets a marker.
    axes.plot(np.array(steps), shown, color=_LINE, linewidth=1.4, marker="o" if len(shown) < 2 else None)
    if np.isfinite(shown).any():
        axes.set_yscale("log")
    axes.set_xlabel("step", fontsize=9)
    axes.set_ylabel(label, fontsize=9)
    axes.grid(True, which="major", color="0.88", linewidth=0.8)
    axes.tick_params(which="both", labelsize=8, color="0.6")
    axes.spines[["top", "right"]].set_visible(False)
    axes.spines[["bottom", "left"]].set_color("0.6")


def picture_of(figure: "Figure") -> UInt8[Tensor, "height width 3"]:
    """Return the pixels of a drawn figure."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg

    canvas = FigureCanvasAgg(figure)
    canvas.draw()
    return torch.from_numpy(np.array(canvas.buffer_rgba())[..., :3].copy())

"""Curves of a run as drawings (SVG) in a page."""

import io
import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import islice
from typing import NamedTuple

from nerf_lightning.export.figures import new_figure
from nerf_lightning.reports.embedding import data_address

Curve = tuple[Sequence[int], Sequence[float]]
"""Steps and values."""
WIDTH, HEIGHT = 560, 320
MOST_CURVES = 12
"""In one chart; more are not told apart, and a stranger's file may have thousands."""
COLORS = ("#2f6db3", "#e07b39", "#3c9d6b", "#8b5fbf", "#c8372d", "#6a7280")


@dataclass(frozen=True)
class Chart:
    """Which curves are drawn together."""

    label: str
    tags: re.Pattern[str]
    is_logarithmic: bool = False


# Only names of these forms are drawn: others may be anything.
CHARTS = (
    Chart("PSNR (dB)", re.compile(r"(train/psnr_\w{1,40}|val/psnr)")),
    Chart("loss", re.compile(r"train/loss(_\w{1,40})?"), is_logarithmic=True),
    Chart("learning rate", re.compile(r"train/learning_rate"), is_logarithmic=True),
    Chart("rays per second", re.compile(r"speed/rays_per_second")),
    Chart("memory (GB)", re.compile(r"memory/\w{1,40}_gigabytes")),
)


class Drawing(NamedTuple):
    """A chart in a page."""

    label: str
    address: str
    note: str
    """What of it is not drawn; empty: all is."""


def curve_drawings(curves: Mapping[str, Curve]) -> list[Drawing]:
    """Return the charts that there is something to draw in."""
    drawings = []
    for chart in CHARTS:
        drawn = {tag: _finite(curve, chart) for tag, curve in sorted(curves.items()) if chart.tags.fullmatch(tag)}
        drawn = {tag: curve for tag, curve in drawn.items() if curve[0]}
        if drawn:
            first, more = dict(islice(drawn.items(), MOST_CURVES)), len(drawn) - MOST_CURVES
            note = f"{more} more curves are in the run's TensorBoard files." if more > 0 else ""
            drawings.append(Drawing(chart.label, data_address("image/svg+xml", _draw(chart, first)), note))
    return drawings


def _finite(curve: Curve, chart: Chart) -> Curve:
    kept = [
        (step, value)
        for step, value in zip(*curve, strict=True)
        if math.isfinite(value) and (value > 0 or not chart.is_logarithmic)
    ]
    return [step for step, _ in kept], [value for _, value in kept]


def _draw(chart: Chart, curves: Mapping[str, Curve]) -> bytes:
    figure = new_figure(WIDTH, HEIGHT)
    axes = figure.subplots()
    for number, (tag, (steps, values)) in enumerate(curves.items()):
        marker = "o" if len(steps) < 3 else None
        axes.plot(
            list(steps), list(values), label=tag, color=COLORS[number % len(COLORS)], linewidth=1.4, marker=marker, ms=3
        )
    if chart.is_logarithmic:
        axes.set_yscale("log")
    axes.set_title(chart.label, fontsize=11, loc="left")
    axes.set_xlabel("step", fontsize=9)
    axes.grid(True, color="0.9", linewidth=0.8)
    axes.tick_params(which="both", labelsize=8, color="0.6")
    axes.spines[["top", "right"]].set_visible(False)
    if len(curves) > 1:
        axes.legend(fontsize=8, framealpha=0.9)
    buffer = io.BytesIO()
    figure.savefig(buffer, format="svg", metadata={"Date": None})
    return buffer.getvalue()

"""Curves of a run, read from its TensorBoard files and drawn (SVG) for a page."""

import io
import logging
import math
import re
import tempfile
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import islice
from pathlib import Path
from typing import NamedTuple

from nerf_lightning.files.budgets import require_within
from nerf_lightning.files.html import data_address
from nerf_lightning.files.regular import read_bytes
from nerf_lightning.messages.errors import InputError
from nerf_lightning.visualization.figures import new_figure

Curve = tuple[Sequence[int], Sequence[float]]  # Steps and values
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
    Chart("PSNR (dB)", re.compile(r"PSNR/(train_\w{1,40}|validation)")),
    Chart("loss", re.compile(r"Training loss/\w{1,40}"), is_logarithmic=True),
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


MOST_POINTS = 1000


def read_curves(folder: Path) -> dict[str, tuple[list[int], list[float]]]:
    """Return steps and values of every scalar, thinned out where there are more than a drawing shows."""
    files = [file for file in folder.glob("*tfevents*") if not file.is_dir()]
    if not files:
        raise InputError("there are no TensorBoard files (logger=none)")
    from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

    logging.getLogger("tensorboard").setLevel(logging.ERROR)
    # 0 would keep all of a kind: one of those that are not wanted is the least.
    kinds = dict.fromkeys(("compressedHistograms", "images", "audio", "histograms", "tensors", "graph"), 1)
    # TensorBoard opens whatever lies in a folder, by its name.
    with tempfile.TemporaryDirectory(prefix="nerf-curves-") as copies:
        _copy(files, Path(copies))
        try:
            log = EventAccumulator(copies, size_guidance=kinds | {"scalars": MOST_POINTS}).Reload()
            tags = log.Tags()["scalars"]
            curves = {tag: [(event.step, float(event.value)) for event in log.Scalars(tag)] for tag in tags}
        except Exception as error:  # a stranger's records can fail in any way
            raise InputError(f"the TensorBoard files cannot be read ({type(error).__name__})") from error
    return {tag: ([step for step, _ in points], [value for _, value in points]) for tag, points in curves.items()}


def _copy(files: list[Path], folder: Path) -> None:
    size = values = 0
    for file in files:
        content = read_bytes(file, "event", "Leave it out of the folder.")
        # A scalar and its tag begin with the byte 10 each; so may, by chance, one byte in 256 of a picture.
        size, values = size + len(content), values + content.count(b"\n")
        require_within("event_bytes", size, file.parent, "bytes of TensorBoard files")
        require_within("event_values", values, file.parent, "values in its TensorBoard files")
        (folder / file.name).write_bytes(content)

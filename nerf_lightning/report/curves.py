"""Curves of a run, read from its TensorBoard files for a page; `page.js` smooths and draws them."""

import logging
import math
import re
import tempfile
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

from nerf_lightning.files.budgets import require_within
from nerf_lightning.files.regular import read_bytes
from nerf_lightning.messages.errors import InputError

Curve = tuple[Sequence[int], Sequence[float]]  # Steps and values
MOST_CURVES = 12
"""In one chart; more are not told apart, and a stranger's file may have thousands."""
DIGITS = 5
MOST_EQUAL = 3  # Names of one curve
LARGEST_STEP = 10**12
"""An untrusted file may number steps beyond what a script can count."""


@dataclass(frozen=True)
class Chart:
    """Which curves are drawn together."""

    label: str
    tags: re.Pattern[str]
    """Of the curves; its one group is the curve's label."""
    is_logarithmic: bool = False
    is_noisy: bool = False
    """Whether a smoothed curve is drawn as well."""
    from_zero: bool = False
    """Whether the axis begins at zero."""


# Only names of these forms are drawn: others may be anything.
CHARTS = (
    Chart("PSNR (dB)", re.compile(r"PSNR/(train_\w{1,40}|validation)"), is_noisy=True),
    Chart("Training loss", re.compile(r"Training loss/(\w{1,40})"), is_logarithmic=True, is_noisy=True),
    Chart("Learning rate", re.compile(r"train/(learning_rate)"), is_logarithmic=True),
    Chart("Rays per second", re.compile(r"speed/(rays_per_second)"), is_noisy=True, from_zero=True),
    Chart("Memory (GB)", re.compile(r"memory/(\w{1,40})_gigabytes"), from_zero=True),
)


class Drawing(NamedTuple):
    """A chart in a page, which the page's script draws."""

    label: str
    is_logarithmic: bool
    is_noisy: bool
    from_zero: bool
    curves: list[dict[str, Any]]
    """Each with its `label`, `steps` and `values`."""
    note: str
    """What of it is not drawn; empty: all is."""


def curve_drawings(curves: Mapping[str, Curve]) -> list[Drawing]:
    """Return the charts that there is something to draw in: a curve of at least two points."""
    drawings = []
    for chart in CHARTS:
        matched = {tag: match[1] for tag in sorted(curves) if (match := chart.tags.fullmatch(tag))}
        labels = _labels(matched)
        finite = {tag: _finite(curves[tag], chart) for tag in matched}
        # Equal curves, such as a level's loss of one term, would hide each other.
        equal: dict[tuple[Any, ...], list[str]] = {}
        for tag, (steps, values) in finite.items():
            if len(steps) > 1:
                equal.setdefault((tuple(steps), tuple(values)), []).append(labels[tag])
        drawn = [
            {"label": " = ".join(names[:MOST_EQUAL]), "steps": list(steps), "values": list(values)}
            for (steps, values), names in equal.items()
        ]
        if drawn:
            more = len(drawn) - MOST_CURVES
            note = f"{more} more curves are in the run's TensorBoard files." if more > 0 else ""
            shown = drawn[:MOST_CURVES]
            drawings.append(Drawing(chart.label, chart.is_logarithmic, chart.is_noisy, chart.from_zero, shown, note))
    return drawings


def _labels(names: Mapping[str, str]) -> dict[str, str]:
    """Return what each curve is called: `train_fine` is "training", or, of several levels, "training (fine)"."""
    levels = [name for name in names.values() if name.startswith("train_")]
    training = {name: "training" if len(levels) == 1 else f"training ({name[6:]})" for name in levels}
    return {tag: training.get(name, name.replace("_", " ")) for tag, name in names.items()}


def _finite(curve: Curve, chart: Chart) -> Curve:
    kept = [
        (step, float(f"{value:.{DIGITS}g}"))
        for step, value in zip(*curve, strict=True)
        if 0 <= step <= LARGEST_STEP and math.isfinite(value) and (value > 0 or not chart.is_logarithmic)
    ]
    return [step for step, _ in kept], [value for _, value in kept]


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

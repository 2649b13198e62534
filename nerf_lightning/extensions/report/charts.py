"""The charts of a page; `page.js` smooths and draws their curves."""

import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

Curve = tuple[Sequence[int], Sequence[float]]  # Steps and values
MOST_CURVES = 12
"""In one chart; more are not told apart, and a stranger's file may have thousands."""
DIGITS = 5
MOST_EQUAL = 3  # Names of one curve
LEVEL = "gradients/norm_"
"""Begins the tag of a curve of each level of the model; sums of the loss over a level are not drawn."""
WORDS = {
    "color": "color error",
    "depth": "depth error",
    "distortion": "spread along rays (distortion)",
    "interlevel": "misplaced samples (interlevel)",
}
"""Terms of the loss in plain words."""
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
    note: str = ""
    """What its curves are, where their names do not say it."""


# Only names of these forms are drawn: others may be anything.
CHARTS = (
    Chart(
        "PSNR (dB)",
        re.compile(r"PSNR/(train_\w{1,40}|validation)"),
        is_noisy=True,
        note="Training: the rays of a step. Validation: some rays of views not used for training, always the same.",
    ),
    Chart(
        "Training loss",
        re.compile(r"Training loss/(\w{1,40})"),
        is_logarithmic=True,
        is_noisy=True,
        note="What training minimizes: each term times its weight, and their sum.",
    ),
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
    """What its curves are, and which are not drawn; empty: nothing to say."""


def drawn(curves: Mapping[str, Curve]) -> list[Drawing]:
    """Return the charts that there is something to draw in: a curve of at least two points."""
    drawings = []
    for chart in CHARTS:
        matched = {
            tag: match[1]
            for tag in sorted(curves)
            if (match := chart.tags.fullmatch(tag)) and f"{LEVEL}{match[1]}" not in curves
        }
        labels = _labels(matched)
        finite = {tag: _finite(curves[tag], chart) for tag in matched}
        # Equal curves, such as the only term of a loss and the sum, would hide each other.
        equal: dict[tuple[Any, ...], list[str]] = {}
        for tag, (steps, values) in finite.items():
            if len(steps) > 1:
                equal.setdefault((tuple(steps), tuple(values)), []).append(labels[tag])
        distinct = [
            {"label": " = ".join(names[:MOST_EQUAL]), "steps": list(steps), "values": list(values)}
            for (steps, values), names in equal.items()
        ]
        if distinct:
            more = len(distinct) - MOST_CURVES
            left = f"{more} more curves are in the run's TensorBoard files." if more > 0 else ""
            note = f"{chart.note} {left}".strip() if len(distinct) > 1 else ""
            shown = distinct[:MOST_CURVES]
            drawings.append(Drawing(chart.label, chart.is_logarithmic, chart.is_noisy, chart.from_zero, shown, note))
    return drawings


def _labels(names: Mapping[str, str]) -> dict[str, str]:
    """Return what each curve is called: `train_fine` is "training", or, of several levels, "training (fine)"."""
    levels = [name for name in names.values() if name.startswith("train_")]
    called = {name: "training" if len(levels) == 1 else f"training ({name[6:]})" for name in levels}
    plain = {tag: name.removeprefix("photo_") for tag, name in names.items()}
    return {tag: called.get(name) or WORDS.get(name, name.replace("_", " ")) for tag, name in plain.items()}


def _finite(curve: Curve, chart: Chart) -> Curve:
    kept = [
        (step, float(f"{value:.{DIGITS}g}"))
        for step, value in zip(*curve, strict=True)
        if 0 <= step <= LARGEST_STEP and math.isfinite(value) and (value > 0 or not chart.is_logarithmic)
    ]
    return [step for step, _ in kept], [value for _, value in kept]

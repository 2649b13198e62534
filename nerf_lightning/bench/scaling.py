"""`nerf bench scaling=true`: how the time and the memory of a step, and reading a capture, grow with their sizes.

Each axis changes one size and leaves the others. Every point is measured in a process of its own, so that its memory is
its own, and has the shortest of several windows of steps: other work on the machine only ever makes them longer. The
exponent k of t = a n^k is fitted to the logarithms.
"""

import copy
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING, Any

from omegaconf import DictConfig, ListConfig, OmegaConf
from rich.progress import track
from rich.table import Table

from nerf_lightning.bench.noise_capture import write_noise_capture
from nerf_lightning.bench.scaling_point import Point, measure_point
from nerf_lightning.console import StdoutConsole, say, stderr_console
from nerf_lightning.cores import num_cores
from nerf_lightning.errors import InputError
from nerf_lightning.files.json_files import write_json

if TYPE_CHECKING:
    from matplotlib.axes import Axes

COUNTS, SIDES = (8, 32, 128), (64, 128, 256, 512)
"""Photographs, and pixels along their sides, of generated captures; the one varies at SIDE, the other at COUNT."""
COUNT, SIDE = 16, 128
TILE_POINTS = 1 << 14


@dataclass(frozen=True)
class Case:
    """One point of an axis."""

    size: int | float
    settings: dict[str, Any]
    """Of the config, by their names with dots."""
    processes: int = 1
    photographs: tuple[int, int] | None = None
    """Number and side of the photographs of a generated capture; None: the config's own scene."""


def benchmark_scaling(config: DictConfig) -> dict[str, float]:
    """Measure along the axes that the config names, print a table, write scaling.json and scaling.png.

    Returns:
        The exponent of a step's time, by axis.
    """
    axes = {name: AXES[name](config) for name in _names(config.scaling)}
    found: dict[str, list[tuple[int | float, Point]]] = {name: [] for name in axes}
    cases = [(name, case) for name, listed in axes.items() for case in listed]
    with TemporaryDirectory(prefix="nerf-scaling-") as folder:
        for name, case in track(cases, "measuring", console=stderr_console(), transient=True):
            found[name].append((case.size, _measured(config, case, Path(folder))))
    _print(found)
    where = Path(config.paths.output_dir or Path(config.paths.root_dir) / "bench")
    content = {name: [{"size": size} | vars(point) for size, point in points] for name, points in found.items()}
    write_json(where / "scaling.json", content)
    _draw(found, where / "scaling.png")
    say(f"written to {where / 'scaling.json'} and scaling.png")
    return {name: exponent([(size, point.step_seconds) for size, point in points]) for name, points in found.items()}


def exponent(points: Sequence[tuple[int | float, float]]) -> float:
    """Return k of t = a n^k, by least squares of the logarithms; nan where there are not two sizes.

    >>> round(exponent([(10.0, 3.0), (20.0, 12.0), (40.0, 48.0)]), 6)
    2.0
    """
    logs = [(math.log(n), math.log(t)) for n, t in points if n > 0 and t > 0]
    x_mean, y_mean = (sum(each[i] for each in logs) / max(1, len(logs)) for i in (0, 1))
    spread = sum((x - x_mean) ** 2 for x, _ in logs)
    return sum((x - x_mean) * (y - y_mean) for x, y in logs) / spread if spread > 0 else math.nan


def _names(wanted: object) -> list[str]:
    names = list(AXES) if wanted is True else [str(name) for name in wanted] if isinstance(wanted, ListConfig) else []
    unknown = [name for name in names if name not in AXES]
    if unknown or not names:
        raise InputError(
            f"scaling={wanted} names no axis that there is. Give true for all, or some of them: "
            f"scaling=[{','.join(AXES)}]."
        )
    return names


def _rays(config: DictConfig) -> list[Case]:
    most = int(config.data.batch_rays)
    return [Case(size, {"data.batch_rays": size}) for size in sorted({max(64, most // part) for part in (8, 4, 2, 1)})]


def _samples(config: DictConfig) -> list[Case]:
    """All levels' samples, as many times as many as configured."""
    keys = [
        f"model.levels.{level}.sampler.{key}"
        for level, settings in config.model.levels.items()
        for key in ("num_steps", "num_samples", "num_importance")
        if settings.get("sampler") and settings.sampler.get(key) is not None
    ]
    given = {key: int(OmegaConf.select(config, key)) for key in keys}
    return [
        Case(factor, {key: max(2, round(count * factor)) for key, count in given.items()})
        for factor in ((0.25, 0.5, 1.0, 2.0) if given else ())
    ]


def _table(config: DictConfig) -> list[Case]:
    """Entries of a level of the hash grid; nothing where the model has none."""
    log2 = config.encoder.get("log2_table_size")
    sizes = () if log2 is None else range(max(10, log2 - 6), log2 + 3, 2)
    return [Case(2**size, {"encoder.log2_table_size": size}) for size in sizes]


def _photographs(_: DictConfig) -> list[Case]:
    return [Case(count, {}, photographs=(count, SIDE)) for count in COUNTS]


def _pixels(_: DictConfig) -> list[Case]:
    return [Case(side**2, {}, photographs=(COUNT, side)) for side in SIDES]


def _threads(_: DictConfig) -> list[Case]:
    most = num_cores()
    return [Case(count, {"trainer.num_threads": count}) for count in sorted({2**k for k in range(8) if 2**k <= most})]


def _processes(_: DictConfig) -> list[Case]:
    most = num_cores()
    return [
        Case(count, {"trainer.num_threads": 1}, processes=count)
        for count in sorted({2**k for k in range(4) if 2**k <= most})
    ]


AXES: dict[str, Callable[[DictConfig], list[Case]]] = {
    "rays": _rays,
    "samples": _samples,
    "table": _table,
    "photographs": _photographs,
    "pixels": _pixels,
    "threads": _threads,
    "processes": _processes,
}


def _measured(config: DictConfig, case: Case, folder: Path) -> Point:
    chosen = copy.deepcopy(config)
    # One size of batches, so that a step's rays are those of the axis; and one of tiles, which takes seconds to choose.
    fixed: dict[str, Any] = {"data.sample_budget": None, "data.crop_steps": 0}
    if chosen.trainer.tile_points == "auto":
        fixed["trainer.tile_points"] = TILE_POINTS
    for key, value in (fixed | case.settings).items():
        OmegaConf.update(chosen, key, value)
    if case.photographs is not None:
        capture = folder / f"{case.photographs[0]}x{case.photographs[1]}"
        if not capture.exists():
            write_noise_capture(capture, *case.photographs)
        chosen.scene = {
            "_target_": "nerf_lightning.data.readers.transforms.TransformsReader",
            "root": str(capture),
            "space": "bounded",
        }
    return measure_point(chosen, case.processes)


def _print(found: dict[str, list[tuple[int | float, Point]]]) -> None:
    table = Table(title="nerf bench scaling=true: the shortest of several windows of steps")
    for column in ("", "size", "a step, ms", "a batch, ms", "memory, GB", "reading, s"):
        table.add_column(column, justify="left" if not column else "right")
    for name, points in found.items():
        for size, point in points:
            shown = (1e3 * point.step_seconds, 1e3 * point.batch_seconds, point.gigabytes, point.reading_seconds)
            table.add_row(name, f"{size:,.4g}", *(f"{value:.3g}" for value in shown))
        fitted = [
            exponent([(size, value(point)) for size, point in points]) for value in (_step, _batch, _memory, _reading)
        ]
        table.add_row("", "grows with power", *(f"{k:.2f}" for k in fitted), style="bold", end_section=True)
    StdoutConsole(width=100).print(table)


def _step(point: Point) -> float:
    return point.step_seconds


def _batch(point: Point) -> float:
    return point.batch_seconds


def _memory(point: Point) -> float:
    return point.gigabytes


def _reading(point: Point) -> float:
    return point.reading_seconds


def _draw(found: dict[str, list[tuple[int | float, Point]]], path: Path) -> None:
    """Draw time and memory over each size, both axes logarithmic."""
    from nerf_lightning.visualization.figures import new_figure, picture_of
    from nerf_lightning.visualization.pictures import save_png

    columns = min(4, len(found))
    rows = -(-len(found) // columns)
    figure = new_figure(320 * columns, 280 * rows)
    panels = figure.subplots(rows, columns, squeeze=False).flatten()
    for axes, (name, points) in zip(panels, found.items(), strict=False):
        _draw_axis(axes, name, points)
    for axes in panels[len(found) :]:
        axes.set_axis_off()
    save_png(path, picture_of(figure))


def _draw_axis(axes: "Axes", name: str, points: list[tuple[int | float, Point]]) -> None:
    sizes = [size for size, _ in points]
    for label, value, colour in (
        ("a step, ms", lambda point: 1e3 * point.step_seconds, "#2f6db3"),
        ("a batch, ms", lambda point: 1e3 * point.batch_seconds, "#3c9d6b"),
        ("memory, MB", lambda point: 1e3 * point.gigabytes, "#8a8f98"),
        ("reading, ms", lambda point: 1e3 * point.reading_seconds, "#e07b39"),
    ):
        drawn = [value(point) for _, point in points]
        power = exponent(list(zip(sizes, drawn, strict=True)))
        axes.plot(sizes, drawn, marker="o", markersize=3, linewidth=1.2, color=colour, label=f"{label}: {power:.2f}")
    axes.set_xscale("log")
    axes.set_yscale("log")
    axes.set_title(name, fontsize=10)
    axes.legend(fontsize=7, frameon=False)
    axes.tick_params(which="both", labelsize=7)
    axes.spines[["top", "right"]].set_visible(False)

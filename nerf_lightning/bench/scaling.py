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
from nerf_lightning.compute.cores import num_cores
from nerf_lightning.files.json_files import write_json
from nerf_lightning.files.made_folders import make_folder
from nerf_lightning.messages.console import StdoutConsole, say, stderr_console
from nerf_lightning.messages.errors import InputError

if TYPE_CHECKING:
    from matplotlib.axes import Axes

COUNTS, SIDES = (8, 32, 128), (64, 128, 256, 512)
"""Photographs, and pixels along their sides, of generated captures; the one varies at SIDE, the other at COUNT."""
COUNT, SIDE = 16, 128
TILE_POINTS = 1 << 16


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
    axes = _axes(config)
    found: dict[str, list[tuple[int | float, Point]]] = {name: [] for name in axes}
    cases = [(name, case) for name, listed in axes.items() for case in listed]
    with TemporaryDirectory(prefix="nerf-scaling-") as folder:
        for name, case in track(cases, "measuring", console=stderr_console(), transient=True):
            found[name].append((case.size, _measured(config, case, Path(folder))))
    _print(found)
    where = make_folder(Path(config.paths.output_dir or Path(config.paths.root_dir) / "bench"))
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


def _axes(config: DictConfig) -> dict[str, list[Case]]:
    """Return the points along each axis that is asked for; of all, those that the model has."""
    wanted = config.scaling
    names = list(AXES) if wanted is True else [str(name) for name in wanted] if isinstance(wanted, ListConfig) else []
    unknown = [name for name in names if name not in AXES]
    if unknown or not names:
        raise InputError(
            f"scaling={wanted} names no axis that there is. Give true for all, or some of them: "
            f"scaling=[{','.join(AXES)}]."
        )
    axes = {name: AXES[name](config) for name in names}
    absent = [name for name, cases in axes.items() if not cases]
    if absent and wanted is not True:
        raise InputError(
            f"scaling={wanted}: this model has nothing to change along {' and '.join(absent)}. Leave that out, or "
            "choose another model (model=fast has a table)."
        )
    return {name: cases for name, cases in axes.items() if cases}


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
            "cache_dir": str(folder / "decoded"),  # goes with the photographs
        }
    return measure_point(chosen, case.processes)


@dataclass(frozen=True)
class Quantity:
    """A field of `Point`, as it is shown."""

    field: str
    name: str
    unit: str
    factor: float
    colour: str

    def of(self, points: Sequence[tuple[int | float, Point]]) -> list[tuple[int | float, float]]:
        """Return size and value of each point, in the unit."""
        return [(size, self.factor * getattr(point, self.field)) for size, point in points]


QUANTITIES = (
    Quantity("step_seconds", "step", "ms", 1e3, "#2f6db3"),
    Quantity("processor_seconds", "its processor time", "ms", 1e3, "#7fb0e0"),
    Quantity("batch_seconds", "batch", "ms", 1e3, "#3c9d6b"),
    Quantity("gigabytes", "memory", "MB", 1e3, "#8a8f98"),
    Quantity("reading_seconds", "reading", "ms", 1e3, "#e07b39"),
    Quantity("again_seconds", "reading again", "ms", 1e3, "#e8b48c"),
    Quantity("setup_seconds", "set-up", "ms", 1e3, "#8d5fb0"),
)


def _print(found: dict[str, list[tuple[int | float, Point]]]) -> None:
    table = Table(title="nerf bench scaling=true: the shortest of several windows of steps")
    for column in ("", "size"):
        table.add_column(column, justify="right" if column else "left", no_wrap=True)
    for each in QUANTITIES:
        table.add_column(f"{each.name}, {each.unit}", justify="right")
    for name, points in found.items():
        columns = [quantity.of(points) for quantity in QUANTITIES]
        for row in zip(*columns, strict=True):
            table.add_row(name, f"{row[0][0]:,}", *(f"{value:,.3g}" for _, value in row))
        table.add_row(
            "", "grows with power", *(f"{exponent(column):.2f}" for column in columns), style="bold", end_section=True
        )
    StdoutConsole(width=120).print(table)


def _draw(found: dict[str, list[tuple[int | float, Point]]], path: Path) -> None:
    """Draw time and memory over each size, both axes logarithmic."""
    from nerf_lightning.visualization.figures import new_figure, picture_of
    from nerf_lightning.visualization.pictures import save_png

    columns = min(4, len(found))
    rows = -(-len(found) // columns)
    figure = new_figure(360 * columns, 360 * rows)
    panels = figure.subplots(rows, columns, squeeze=False).flatten()
    for axes, (name, points) in zip(panels, found.items(), strict=False):
        _draw_axis(axes, name, points)
    for axes in panels[len(found) :]:
        axes.set_axis_off()
    save_png(path, picture_of(figure))


def _draw_axis(axes: "Axes", name: str, points: list[tuple[int | float, Point]]) -> None:
    for each in QUANTITIES:
        drawn = each.of(points)
        label = f"{each.name}, {each.unit}: {exponent(drawn):.2f}"
        axes.plot(*zip(*drawn, strict=True), marker="o", markersize=3, linewidth=1.2, color=each.colour, label=label)
    axes.set_xscale("log")
    axes.set_yscale("log")
    sizes = [size for size, _ in points]
    axes.set_xticks(sizes, [f"{size:,}" for size in sizes], minor=False)
    axes.set_xticks([], minor=True)  # within a decade their labels would lie on each other
    axes.set_title(name, fontsize=10)
    # Below the panel: within, it would lie on lines.
    axes.legend(
        fontsize=6.5, frameon=False, ncols=2, columnspacing=0.8, loc="upper center", bbox_to_anchor=(0.45, -0.08)
    )
    axes.tick_params(which="both", labelsize=7)
    axes.spines[["top", "right"]].set_visible(False)

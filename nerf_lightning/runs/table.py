"""Measured runs as one table: a row per scene, model and setting, mean and standard deviation over seeds."""

import statistics
from collections.abc import Callable, Iterable, Iterator, Sequence
from pathlib import Path

from nerf_lightning.config.key_meanings import meaning_of
from nerf_lightning.config.overrides import leaves
from nerf_lightning.errors import InputError
from nerf_lightning.escaping import listed
from nerf_lightning.evaluation.metrics import HIGHER_IS_BETTER
from nerf_lightning.evaluation.protocol import differences
from nerf_lightning.files.yaml_files import read_plain_yaml
from nerf_lightning.runs.published import published_for
from nerf_lightning.runs.results import FoundResults, RunResult
from nerf_lightning.runs.summary import differing_keys
from nerf_lightning.runs.table_files import Row

ORDERS = (
    *("psnr", "cc_psnr", "ssim", "lpips", "depth_error", "normal_error"),
    *("steps", "minutes", "parameters", "megabytes", "frames_per_second", "model"),
)
"""What rows may be sorted by."""
SPREAD = {
    "psnr": "PSNR",
    "cc_psnr": "cc PSNR",
    "ssim": "SSIM",
    "lpips": "LPIPS",
    "depth_error": "depth error",
    "normal_error": "normal error",
}
PLAIN = {
    "steps": "steps",
    "minutes": "minutes",
    "frames_per_second": "frames/s",
    "parameters": "parameters",
    "megabytes": "MB",
}
HIGH_FIRST = (*HIGHER_IS_BETTER, "frames_per_second")
FINGERPRINT = "split_hash"
CHOOSE_PICTURES = ("split", "resolution", "masks", "downscale", "filter", "hold_every", "frames")
"""Where these differ, so do the pictures, and that need not be said again."""
# What tells whose numbers they are, and may move them a little: named below a table where it differs.
NOTED = ("version", "commit", "device", "precision")

MOST_SETTINGS = 32
"""Columns of settings by which runs differ: more are not read, and a stranger's run may have thousands."""

MOST_LETTERS = 80
"""Of a value that no command line gave."""

MOST_CURVES = 40
"""Rows whose curves are read: of more, the table would take long to come."""

Group = list[RunResult]
Curve = Sequence[float]
"""Values over the length of a run, at steps of equal distance."""


def no_curve(folder: Path) -> Curve:
    """Return no values, for tables without curves."""
    return ()


def result_table(
    found: FoundResults, order: str, published: bool, force: bool, curve_of: Callable[[Path], Curve] = no_curve
) -> tuple[list[Row], list[str]]:
    """Return the rows, and the lines that belong below them.

    Args:
        found: what was measured.
        order: one of `ORDERS`.
        published: add what others have published.
        force: put results together that were not measured alike.
        curve_of: returns the PSNR over the length of the run in a folder, empty where it is not known.

    Raises:
        InputError: they were not measured alike, and not `force`.
    """
    results = found.measured
    notes = one_protocol(results, force)
    groups, left_out = group_seeds(results)
    rows = group_rows(groups, order, curve_of)
    if published:
        rows = with_published(rows, results)
    notes += [*noted_settings(groups), *noted_origins(results)]
    if left_out:
        names = _names(result.folder for result in left_out)
        notes.append(f"Left out, since newer runs of the same settings and seed are there: {names}.")
    if found.unmeasured:
        notes.append(f"Without a PSNR in {found.file}: {_names(found.unmeasured)}.")
    return without_empty(rows), notes


def _names(folders: Iterable[Path]) -> str:
    return listed(map(str, folders), cap=5)


def one_protocol(results: Sequence[RunResult], force: bool) -> list[str]:
    """Return what is to be said of how the results were measured, a line for each difference.

    Raises:
        InputError: not all in the same way, and not `force`.
    """
    first_of: dict[str, RunResult] = {}
    pairs: dict[str, str] = {}
    # A result without LPIPS agrees with all backbones: what is compared with is one that has a backbone.
    results = sorted(results, key=lambda result: result.protocol.get("lpips") is None)
    for result in results:
        first = first_of.setdefault(result.scene, result)
        for other, same_scene in ((first, True), (results[0], False)):
            apart = _apart(other, result, same_scene)
            if apart and not force:
                raise InputError(
                    f"{other.folder} and {result.folder} were not measured alike ({'; '.join(apart)}), so their "
                    "numbers do not belong into one table. Leave one out (scenes=..., models=..., or fewer runs), "
                    "measure both alike with nerf eval and add measured=eval, or add force=true."
                )
            for difference in apart:
                pairs.setdefault(difference, f"{other.folder} and {result.folder}")
    return [f"Not all of these were measured alike: {pair}: {difference}." for difference, pair in pairs.items()]


def _apart(one: RunResult, other: RunResult, same_scene: bool) -> list[str]:
    """Return what keeps two results from being compared, in words and in settings that people know."""
    found = dict(each.split(": ", 1) for each in differences(one.protocol, other.protocol, same_scene))
    told = [f"{key}: {values}" for key, values in found.items() if key != FINGERPRINT]
    if FINGERPRINT in found and not found.keys() & {*CHOOSE_PICTURES}:
        told.append(_other_pictures(one.summary.overrides, other.summary.overrides))
    return told


def _other_pictures(one: dict[str, str], other: dict[str, str]) -> str:
    chosen = ({key: value for key, value in given.items() if _chooses_pictures(key)} for given in (one, other))
    differing = differing_keys(list(chosen))
    if not differing:
        return "other pictures, by the same settings: the capture was changed in between"
    return f"other pictures, of {listed(_as_given(one, other, differing), cap=3)}"


def _as_given(one: dict[str, str], other: dict[str, str], keys: Iterable[str]) -> Iterator[str]:
    for key in keys:
        told = [f"{key}={given[key]}" for given in (one, other) if key in given]
        yield " and ".join(told if len(told) == 2 else [*told, "its default"])


def _chooses_pictures(key: str) -> bool:
    is_of_scene = key == "scene" or key.startswith("scene.")
    return (is_of_scene and meaning_of(key).identity) or key in ("evaluation.split", "evaluation.max_views")


def noted_origins(results: Sequence[RunResult]) -> list[str]:
    """Return what else differs between the results: program, device, precision."""
    lines = []
    for key in NOTED:
        found = sorted({str(result.origin.get(key, "not said")) for result in results})
        if len(found) > 1:
            lines.append(f"{key}: {', '.join(found)}")
    return lines


def group_seeds(results: Sequence[RunResult]) -> tuple[list[Group], list[RunResult]]:
    """Return results that differ by their seed alone together, and older ones of a seed that is there, left out."""
    groups: dict[tuple[object, ...], dict[int | None, RunResult]] = {}
    left_out = []
    for result in sorted(results, key=lambda result: (result.summary.started or "", str(result.folder)), reverse=True):
        key = (
            *(result.scene, result.model, str(result.origin.get("config")), result.summary.steps),
            *sorted(result.settings.items()),
        )
        seeds = groups.setdefault(key, {})
        if result.seed in seeds:
            left_out.append(result)
        else:
            seeds[result.seed] = result
    return [list(seeds.values()) for seeds in groups.values()], left_out


def group_rows(groups: Sequence[Group], order: str, curve_of: Callable[[Path], Curve] = no_curve) -> list[Row]:
    """Return a row per group, by scene and then the best first; settings that all share are left out."""
    shown = _differing(groups)[:MOST_SETTINGS]
    ranked = sorted(groups, key=lambda group: _rank(group, order))
    return [_row(group, shown, curve) for group, curve in zip(ranked, relative_curves(ranked, curve_of), strict=True)]


def relative_curves(groups: Sequence[Group], curve_of: Callable[[Path], Curve]) -> list[Curve]:
    """Return the curve of each group's newest run, in parts of the range that the curves of its scene fill."""
    curves = [curve_of(group[0].folder) for group in groups[:MOST_CURVES]] + [()] * len(groups[MOST_CURVES:])
    reached: dict[str, list[float]] = {}
    for group, curve in zip(groups, curves, strict=True):
        reached.setdefault(group[0].scene, []).extend(curve)
    relative: list[Curve] = []
    for group, curve in zip(groups, curves, strict=True):
        low, high = min(reached[group[0].scene], default=0.0), max(reached[group[0].scene], default=1.0)
        relative.append([(value - low) / (high - low or 1.0) for value in curve])
    return relative


def noted_settings(groups: Sequence[Group]) -> list[str]:
    """Return what is to be said of settings that differ and have no column."""
    hidden = _differing(groups)[MOST_SETTINGS:]
    return [f"{len(hidden)} more settings differ and have no column: {listed(hidden, cap=5)}."] if hidden else []


def _differing(groups: Sequence[Group]) -> list[str]:
    return differing_keys([group[0].settings for group in groups])


def with_published(rows: list[Row], results: Sequence[RunResult]) -> list[Row]:
    """Return the rows with what others have published below those of each scene."""
    reader = {result.scene: str(result.origin.get("scene", "")) for result in results}
    table: list[Row] = []
    for scene in dict.fromkeys(row["scene"] for row in rows):
        table += [row for row in rows if row["scene"] == scene]
        table += [
            {
                "scene": scene,
                "model": found.method,
                "resolution": found.resolution,
                "PSNR": found.psnr,
                "steps": found.steps,
                "time": found.time,
                "source": f"published, {found.measured}: {found.source}",
            }
            for found in published_for(scene, reader[scene])
        ]
    return table


def without_empty(rows: list[Row]) -> list[Row]:
    """Return the rows without the columns that no row has, all with the same columns in the same order."""
    columns = dict.fromkeys(column for row in rows for column in row)
    kept = [column for column in columns if any(row.get(column) not in (None, "") for row in rows)]
    return [{column: row.get(column) for column in kept} for row in rows]


def _row(group: Group, shown: list[str], curve: Curve) -> Row:
    first = group[0]
    row: Row = {"scene": first.scene, "model": first.model}
    unsaid = _values_of(first.folder, [key for key in shown if key not in first.settings])
    row |= {key: first.settings.get(key, unsaid.get(key, "")) for key in shown}
    seeds = sorted(result.seed for result in group if result.seed is not None)
    row |= {"resolution": _resolution(first), "seeds": " ".join(map(str, seeds))}
    for metric, column in SPREAD.items():
        mean, deviation = _spread(group, metric)
        row |= {column: mean, f"{column} std": deviation}
        if metric == "psnr":
            row["curve"] = curve or None
    row |= {column: _spread(group, key)[0] for key, column in PLAIN.items()}
    row["steps"] = None if row["steps"] is None else round(row["steps"])
    others = f" and {len(group) - 1} more" if len(group) > 1 else ""
    return row | {"time": None, "folder": f"{first.folder}{others}", "source": None}


def _values_of(folder: Path, keys: Sequence[str]) -> dict[str, str]:
    """Return what a run had for settings that nobody gave: the number or word, or the option of a group."""
    if not keys:
        return {}
    try:
        config = leaves(read_plain_yaml(folder / ".hydra" / "config.yaml"))
        choices = read_plain_yaml(folder / ".hydra" / "hydra.yaml")["runtime"]["choices"]
        known = {key: config.get(key, choices.get(key)) for key in keys}
    except (InputError, LookupError, TypeError, AttributeError):
        return {}
    return {key: str(value)[:MOST_LETTERS] for key, value in known.items() if value is not None}


def _resolution(result: RunResult) -> str:
    """Return the size of the pictures that were measured; of several sizes, the smallest and how many more."""
    found = result.protocol.get("resolution")
    sizes = [f"{size[0]} x {size[1]}" for size in found if _is_size(size)] if isinstance(found, list) else []
    return f"{sizes[0]} and {len(sizes) - 1} more" if len(sizes) > 1 else "".join(sizes)


def _is_size(size: object) -> bool:
    return (
        isinstance(size, list) and len(size) == 2 and all(isinstance(side, int) and 0 < side < 10**6 for side in size)
    )


def _spread(group: Group, key: str) -> tuple[float | None, float | None]:
    """Return mean and standard deviation (of the population that the seeds are drawn from)."""
    values = [value for result in group if (value := result.values.get(key)) is not None]
    if len(values) < len(group):
        return None, None
    return statistics.fmean(values), statistics.stdev(values) if len(values) > 1 else None


def _rank(group: Group, order: str) -> tuple[str, bool, float, str]:
    first = group[0]
    value = None if order == "model" else _spread(group, order)[0]
    sign = -1.0 if order in HIGH_FIRST else 1.0
    return first.scene, value is None and order != "model", sign * (value or 0.0), first.model

"""Measured runs as rows: one per scene, model and setting, with mean and standard deviation over seeds."""

import statistics
from collections.abc import Sequence
from pathlib import Path

from nerf_lightning.config.overrides import leaves
from nerf_lightning.config.setting_rules import meaning_of
from nerf_lightning.evaluation.metrics import HIGHER_IS_BETTER
from nerf_lightning.evaluation.protocol import differences
from nerf_lightning.extensions.table.find_results import FoundResults, RunResult
from nerf_lightning.extensions.table.published import published_for
from nerf_lightning.files.yaml_files import read_plain_yaml
from nerf_lightning.messages.errors import InputError
from nerf_lightning.messages.escaping import listed
from nerf_lightning.runs.summary import differing_keys
from nerf_lightning.runs.table_columns import Row

SPREAD = {
    "psnr": "PSNR",
    "cc_psnr": "cc PSNR",
    "ssim": "SSIM",
    "lpips": "LPIPS",
    "depth_error": "depth error",
    "normal_error": "normal error",
}
"""Columns with mean and standard deviation."""
PLAIN = {
    "steps": "steps",
    "minutes": "minutes",
    "frames_per_second": "frames/s",
    "parameters": "parameters",
    "megabytes": "MB",
}
"""Columns with the mean alone."""
ORDERS = (*SPREAD, *PLAIN, "model")  # Keys by which rows may be sorted
HIGH_FIRST = (*HIGHER_IS_BETTER, "frames_per_second")
CHOOSE_PICTURES = ("split", "resolution", "masks", "downscale", "filter", "hold_every", "frames")
"""If these differ, so do the pictures, which need not be reported separately."""
NOTED = ("version", "commit", "device", "precision")
"""What may change the numbers slightly: noted below the table if it differs."""
MOST_SETTINGS = 32
"""Maximum number of columns for differing settings: an untrusted run may have thousands."""
MOST_LETTERS = 80

Group = list[RunResult]


def result_table(results: FoundResults, order: str, published: bool, force: bool) -> tuple[list[Row], list[str]]:
    """Return the rows, in one of `ORDERS`, and the notes below them.

    `force` combines results that were not measured in the same way.
    """
    notes = one_protocol(results.measured, force)
    groups, left_out = group_seeds(results.measured)
    groups.sort(key=lambda group: _rank(group, order))
    differing = differing_keys([group[0].settings for group in groups])
    shown, hidden = differing[:MOST_SETTINGS], differing[MOST_SETTINGS:]
    rows = [_row(group, shown) for group in groups]
    if published:
        rows = with_published(rows, results.measured)
    if hidden:
        notes.append(f"{len(hidden)} more settings differ and have no column: {listed(hidden, cap=5)}.")
    for key in NOTED:
        values = sorted({str(result.origin.get(key, "not said")) for result in results.measured})
        notes += [f"{key}: {', '.join(values)}"] if len(values) > 1 else []
    if left_out:
        names = listed((result.folder for result in left_out), cap=5)
        notes.append(f"Left out, because there are newer runs with the same settings and seed: {names}.")
    if results.unmeasured:
        notes.append(f"Without a PSNR in {results.file}: {listed(results.unmeasured, cap=5)}.")
    columns = [name for name in rows[0] if any(row[name] not in (None, "") for row in rows)]
    return [{name: row[name] for name in columns} for row in rows], notes


def one_protocol(results: Sequence[RunResult], force: bool) -> list[str]:
    """Return notes on how the results were measured, a line for each difference.

    Raises:
        InputError: they were not all measured in the same way, and `force` is false.
    """
    first_of: dict[str, RunResult] = {}
    pairs: dict[str, str] = {}
    # A result without LPIPS agrees with all backbones: compare with one that has a backbone.
    results = sorted(results, key=lambda result: result.protocol.get("lpips") is None)
    for result in results:
        first = first_of.setdefault(result.scene, result)
        for other, same_scene in ((first, True), (results[0], False)):
            reasons = _protocol_differences(other, result, same_scene)
            if reasons and not force:
                raise InputError(
                    f"{other.folder} and {result.folder} were not measured the same way ({'; '.join(reasons)}), so one "
                    "table cannot compare them. Leave one out (scenes=..., models=..., or fewer runs), measure both "
                    "the same way with nerf eval and add measured=eval, or add force=true."
                )
            for difference in reasons:
                pairs.setdefault(difference, f"{other.folder} and {result.folder}")
    return [f"Not all of these were measured the same way: {pair}: {difference}." for difference, pair in pairs.items()]


def _protocol_differences(one: RunResult, other: RunResult, same_scene: bool) -> list[str]:
    """Return why two results cannot be compared, in words and as settings."""
    found = dict(each.split(": ", 1) for each in differences(one.protocol, other.protocol, same_scene))
    is_other_pictures = found.pop("split_hash", None) is not None and not found.keys() & {*CHOOSE_PICTURES}
    told = [f"{key}: {values}" for key, values in found.items()]
    if is_other_pictures:
        given = [result.summary.overrides for result in (one, other)]
        chosen = [{key: value for key, value in each.items() if _chooses_pictures(key)} for each in given]
        differing = [
            " and ".join(f"{key}={each[key]}" if key in each else f"{key} not set" for each in chosen)
            for key in differing_keys(chosen)
        ]
        cause = "although the settings are the same: the capture has changed"
        told.append(f"different views: {listed(differing, cap=3)}" if differing else f"different views, {cause}")
    return told


def _chooses_pictures(key: str) -> bool:
    is_of_scene = key == "scene" or key.startswith("scene.")
    return (is_of_scene and meaning_of(key).identity) or key in (
        "evaluation.split",
        "evaluation.max_views",
        "experiment",
    )


def group_seeds(results: Sequence[RunResult]) -> tuple[list[Group], list[RunResult]]:
    """Group results that differ only by seed; return the groups, and older duplicates of a seed, which are left out."""
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


def with_published(rows: list[Row], results: Sequence[RunResult]) -> list[Row]:
    """Return the rows with published results below those of each scene."""
    reader = {result.scene: str(result.origin.get("scene", "")) for result in results}
    empty: Row = dict.fromkeys(rows[0])
    table: list[Row] = []
    for scene in dict.fromkeys(row["scene"] for row in rows):
        table += [row for row in rows if row["scene"] == scene]
        for found in published_for(scene, reader[scene]):
            source = f"published, {found.measured}: {found.source}"
            theirs = {"resolution": found.resolution, "PSNR": found.psnr, "steps": found.steps, "time": found.time}
            table.append(empty | {"scene": scene, "model": found.method} | theirs | {"source": source})
    return table


def _row(group: Group, keys: list[str]) -> Row:
    first = group[0]
    row: Row = {"scene": first.scene, "model": first.model}
    unsaid = _values_of(first.folder, [key for key in keys if key not in first.settings])
    row |= {key: first.settings.get(key, unsaid.get(key, "")) for key in keys}
    seeds = sorted(result.seed for result in group if result.seed is not None)
    row |= {"resolution": _resolution(first), "seeds": " ".join(map(str, seeds))}
    for metric, column in SPREAD.items():
        mean, deviation = _spread(group, metric)
        row |= {column: mean, f"{column} std": deviation}
    row |= {column: _spread(group, key)[0] for key, column in PLAIN.items()}
    row["steps"] = None if row["steps"] is None else round(row["steps"])
    others = f" and {len(group) - 1} more" if len(group) > 1 else ""
    return row | {"time": None, "folder": f"{first.folder}{others}", "source": None}


def _values_of(folder: Path, keys: Sequence[str]) -> dict[str, str]:
    """Return a run's values of settings that were not given: the number or word, or the option of a group."""
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
    """Return the size of the measured pictures; of several sizes, the smallest and the number of others."""
    found, sizes = result.protocol.get("resolution"), []
    for size in found if isinstance(found, list) else ():
        match size:
            case [int(width), int(height)] if 0 < min(width, height) <= max(width, height) < 10**6:
                sizes.append(f"{width} x {height}")
    return f"{sizes[0]} and {len(sizes) - 1} more" if len(sizes) > 1 else "".join(sizes)


def _spread(group: Group, key: str) -> tuple[float | None, float | None]:
    """Return mean and standard deviation (of the population from which the seeds are drawn)."""
    values = [value for result in group if (value := result.values.get(key)) is not None]
    if len(values) < len(group):
        return None, None
    return statistics.fmean(values), statistics.stdev(values) if len(values) > 1 else None


def _rank(group: Group, order: str) -> tuple[str, bool, float, str]:
    first = group[0]
    value = None if order == "model" else _spread(group, order)[0]
    sign = -1.0 if order in HIGH_FIRST else 1.0
    return first.scene, value is None and order != "model", sign * (value or 0.0), first.model

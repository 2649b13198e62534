"""The summary of all scored views' rows, and its files: `metrics.json` and `metrics.csv`."""

import csv
import statistics
from collections.abc import Collection, Mapping
from pathlib import Path
from typing import Any

from nerf_lightning.compute import ranks
from nerf_lightning.compute.machine import peak_memory
from nerf_lightning.evaluation.lpips import LPIPS_HINT
from nerf_lightning.evaluation.metrics import mean_over_images, median_over_images, worst_of_images
from nerf_lightning.files.atomic import whole_file
from nerf_lightning.files.json_files import write_json
from nerf_lightning.messages.escaping import for_csv

METRICS = ("psnr", "cc_psnr", "ssim", "lpips", "depth_error", "normal_error")
COLUMNS = ("name", *METRICS, "seconds")
PLAINER = {"mean of the pictures' own": "mean over the pictures"}
"""Values that results are compared by, and that stay as they are in files, in plainer words."""


def summary(rows: list[dict[str, Any]]) -> dict[str, Any]:
    """Return mean, median and worst of each metric, the speed of rendering, and the rows themselves.

    `frames_per_second` is that of the median picture in one process; `peak_memory_gigabytes` is a process's peak since
    it started, on a GPU the GPU's.
    """
    values = [{metric: row[metric] for metric in METRICS} for row in rows]
    worst = {
        metric: None if place is None else {"name": rows[place]["name"], "value": rows[place][metric]}
        for metric, place in worst_of_images(values).items()
    }
    seconds = [row["seconds"] for row in rows]
    result = mean_over_images(values) | {
        "num_images": len(rows),
        "median": median_over_images(values),
        "worst": worst,
        "seconds_per_image": statistics.fmean(seconds),
        "frames_per_second": 1.0 / statistics.median(seconds),
        "peak_memory_gigabytes": round(ranks.largest(peak_memory()), 3),
        "per_image": rows,
    }
    return result if result["lpips"] is not None else result | {"lpips_hint": LPIPS_HINT}


def of_captures(rows: list[dict[str, Any]], capture_of: Mapping[str, str], trained: Collection[str]) -> dict[str, Any]:
    """Return, by capture name, the means over its views and whether it was trained on.

    `capture_of` maps view names to capture names; `trained` holds the names of the trained captures.
    """
    by_name: dict[str, list[dict[str, Any]]] = {}
    for row in rows:
        by_name.setdefault(capture_of[row["name"]], []).append({metric: row[metric] for metric in METRICS})
    return {
        name: mean_over_images(own) | {"num_images": len(own), "trained_on": name in trained}
        for name, own in by_name.items()
    }


def write_metrics(folder: Path, result: dict[str, Any]) -> None:
    """Write `metrics.json`, and `metrics.csv` with a row per picture."""
    write_json(folder / "metrics.json", result)
    with whole_file(folder / "metrics.csv") as part, part.open("w", encoding="utf-8", newline="") as file:
        writer = csv.DictWriter(file, COLUMNS, extrasaction="ignore")
        writer.writeheader()
        writer.writerows({key: for_csv(value) for key, value in row.items()} for row in result["per_image"])


def as_text(value: Any) -> str:
    """Return a value of `metrics.json` as readable text: sizes as width x height.

    >>> as_text([[800, 800], [400, 300]]), as_text("white")
    ('800 x 800, 400 x 300', 'white')
    """
    if not isinstance(value, list):
        return PLAINER.get(value, str(value)) if isinstance(value, str) else str(value)
    return ", ".join(" x ".join(map(str, part)) if isinstance(part, list) else str(part) for part in value)

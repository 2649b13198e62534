"""What `metrics.json` holds, as a page shows it, in the columns of `evaluation/metrics_files.py`.

The file may be anybody's: what does not fit is left out.
The main numbers: `evaluation/main_numbers.py`.
"""

from pathlib import Path
from typing import Any

from nerf_lightning.data.pixels.picture_files import read_rgba
from nerf_lightning.evaluation.kept_views import PARTS, picture_name
from nerf_lightning.evaluation.main_numbers import NAMES, in_units
from nerf_lightning.evaluation.metrics_files import COLUMNS, as_text
from nerf_lightning.extensions.report.page import Pairs, ViewOnPage, embedded
from nerf_lightning.files.json_files import mapping, number
from nerf_lightning.files.made_folders import child_of
from nerf_lightning.messages.errors import InputError

ROWS = {
    ("protocol", "split"): "views",
    ("protocol", "split_hash"): "fingerprint of these views",
    ("protocol", "pixels"): "renders rounded to 8 bits",
    ("protocol", "colors"): "colors fitted before scoring",
    ("protocol", "masks"): "masked pixels",
    ("protocol", "downscale"): "photographs shrunk by",
    ("protocol", "filter"): "filter when shrinking",
    ("protocol", "hold_every"): "test views: one in",
    ("origin", "config"): "fingerprint of the config",
    ("origin", "checkpoint"): "fingerprint of the weights",
    ("origin", "commit"): "commit of the code",
    ("origin", "megabytes"): "weights (MB)",
    ("environment", "memory_gigabytes"): "memory (GB)",
}
"""Labels of rows of the tables, by table and key."""
WORDS = {
    ("pixels", "float"): "no",
    ("pixels", "8-bit"): "yes",
    ("cameras", "raw"): "as given",
    ("cameras", "refined"): "refined in training",
    ("colors", "raw"): "no",
    ("masks", "none"): "there are none",
    ("precision", "32-true"): "float32",
    ("precision", "bf16-mixed"): "bfloat16",
}
"""Values in plain words, by key and value."""
WITHOUT_LPIPS = "not computed (evaluation.lpips=alex)"
MOST_VIEWS = 12
MOST_ROWS = 5000
MOST_PAIRS = 60


def per_image(metrics: dict[str, Any]) -> tuple[list[str], list[list[str]]]:
    """Return the columns and the rows of the table of all views; columns that no view has are left out."""
    rows = [row for row in _sequence(metrics.get("per_image")) if isinstance(row, dict)][:MOST_ROWS]
    columns = [column for column in COLUMNS if any(row.get(column) is not None for row in rows)]
    texts = [[str(row.get(c, ""))[:200] if c == "name" else in_units(c, row.get(c)) for c in columns] for row in rows]
    return [_name(column) for column in columns], texts


def tables(metrics: dict[str, Any]) -> list[tuple[str, Pairs]]:
    """Return protocol, origin and environment as pairs of texts."""
    titles = {"protocol": "Protocol", "origin": "Provenance", "environment": "Environment"}
    told = {key: list(mapping(metrics.get(key)).items())[:MOST_PAIRS] for key in titles}
    pairs = {
        key: [(ROWS.get((key, name), _name(name))[:80], _said(name, value)) for name, value in found]
        for key, found in told.items()
    }
    if any(pair[0] == "scene" and pair in pairs["protocol"] for pair in pairs["origin"]):  # the capture has no name
        pairs["protocol"] = [("format" if key == "scene" else key, text) for key, text in pairs["protocol"]]
        pairs["origin"] = [pair for pair in pairs["origin"] if pair[0] != "scene"]
    if pairs["protocol"] and metrics.get("lpips") is None:
        pairs["protocol"] = [*(pair for pair in pairs["protocol"] if pair[0] != "LPIPS"), ("LPIPS", WITHOUT_LPIPS)]
    return [(title, pairs[key]) for key, title in titles.items()]


def views_on_page(metrics: dict[str, Any], images: Path) -> tuple[list[ViewOnPage], list[ViewOnPage], list[str]]:
    """Return the worst views, those of the even spread, and what could not be read."""
    rows = {str(row.get("name")): row for row in _sequence(metrics.get("per_image")) if isinstance(row, dict)}
    worst = [str(name) for name in _sequence(metrics.get("worst_views"))][:MOST_VIEWS]
    named = [(f"worst_{place}", name) for place, name in enumerate(worst, start=1)]
    split = str(mapping(metrics.get("protocol")).get("split"))
    spread = [(picture_name(split, name), name) for name in map(str, _sequence(metrics.get("pictures")))][:MOST_VIEWS]
    missing: list[str] = []
    pages: list[list[ViewOnPage]] = []
    spread = [(folder, name) for folder, name in spread if name not in worst]  # shown once
    for folders in (named, spread):
        pages.append([])
        for folder, name in folders:
            try:
                pages[-1].append(_view(child_of(images, "views", folder), name, rows.get(name, {})))
            except (InputError, OSError) as error:
                missing.append(f"View {name[:80]}: {error}")
    if metrics and not worst and not spread:
        missing.append("Views: none were kept when this was measured; nerf eval keeps some (then measured=eval).")
    return pages[0], pages[1], missing


def _view(folder: Path, name: str, row: dict[str, Any]) -> ViewOnPage:
    files = {part: folder / f"{part}.png" for part in PARTS}
    pixels = {part: read_rgba(file)[..., :3] for part, file in files.items() if part != "true_depth" or file.is_file()}
    # The scales beside depth and error have letters too small for a page, which says what they say.
    width = pixels["truth"].shape[1]
    parts = {part: embedded(picture[:, :width]) for part, picture in pixels.items()}
    known = {metric: in_units(metric, row.get(metric)) for metric in ("psnr", "ssim")}
    numbers = ", ".join(f"{metric.upper()} {text}" for metric, text in known.items() if text)
    return ViewOnPage(name=name[:200], numbers=numbers, **parts)


def depth_scale(metrics: dict[str, Any]) -> str:
    """Return what is known about the colors of depth."""
    scale = mapping(metrics.get("depth_scale"))
    near, far = number(scale.get("near")), number(scale.get("far"))
    if near is None or far is None:
        return ""
    return f"bright: {near:.3g} or nearer, black: {far:.3g} or farther ({str(scale.get('unit', ''))[:40]})"


def _name(key: str) -> str:
    return NAMES.get(key, key.replace("_", " "))


def _said(name: str, value: Any) -> str:
    if (words := WORDS.get((name, str(value)))) is not None:
        return words
    if isinstance(value, int | float) and not isinstance(value, bool):
        return f"{value:,}"
    return "none" if value is None else as_text(value)[:300]


def _sequence(value: object) -> list[Any]:
    return value if isinstance(value, list) else []

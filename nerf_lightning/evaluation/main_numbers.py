"""The main numbers of a run in words: for a page about it, and as lines in the terminal (`metric_lines`)."""

from pathlib import Path
from typing import Any

from nerf_lightning.evaluation.protocol import COLORS
from nerf_lightning.files.json_files import mapping, number
from nerf_lightning.messages.console import spoken

FORMATS = {
    "psnr": "{:.2f} dB",
    "cc_psnr": "{:.2f} dB",
    "ssim": "{:.4f}",
    "lpips": "{:.4f}",
    "depth_error": "{:.4f}",
    "normal_error": "{:.1f}°",
    "seconds": "{:.3f}",
}
NAMES = {"psnr": "PSNR", "cc_psnr": "PSNR with fitted colors", "ssim": "SSIM", "lpips": "LPIPS"}
LABELS = {
    **{metric: name for metric, name in NAMES.items() if metric != "psnr"},
    "depth_error": "mean depth error (scene units)",
    "normal_error": "mean error of surface normals",
}


def main_numbers(metrics: dict[str, Any], note: dict[str, Any]) -> list[tuple[str, str]]:
    """Return the numbers of a run's `metrics.json` and `run.json` as label and text; what does not fit is left out."""
    median, worst = mapping(metrics.get("median")), mapping(mapping(metrics.get("worst")).get("psnr"))
    shown = [
        ("PSNR (mean)", in_units("psnr", metrics.get("psnr"))),
        ("PSNR (median)", in_units("psnr", median.get("psnr"))),
        ("PSNR (worst view)", in_units("psnr", worst.get("value"))),
        *((label, in_units(metric, metrics.get(metric))) for metric, label in LABELS.items()),
    ]
    count, of = number(metrics.get("num_images")), number(metrics.get("split_views"))
    if count is not None and of is not None:
        label = "test views" if mapping(metrics.get("protocol")).get("split") == "test" else "views measured"
        shown.append((label, f"{count:,.0f}" if count == of else f"{count:,.0f} of {of:,.0f}"))
    origin = mapping(metrics.get("origin"))
    trained = number(note.get("training_seconds"))
    shown.append(("training", "" if trained is None else spoken(trained)))
    for label, value, form in (
        ("rendering by the model", metrics.get("frames_per_second"), "{:.3g} frames per second"),
        ("peak memory", metrics.get("peak_memory_gigabytes"), "{:.2f} GB"),
        ("steps", note.get("finished_at_step"), "{:,.0f}"),
        ("parameters", origin.get("parameters"), "{:,.0f}"),
        ("size of the weights", origin.get("megabytes"), "{:.1f} MB"),
    ):
        known = number(value)
        shown.append((label, "" if known is None else form.format(known)))
    return [(label, text) for label, text in shown if text]


def in_units(metric: str, value: Any) -> str:
    """Return a metric as a text with its unit; "" if it is no number."""
    known = number(value)
    return "" if known is None else FORMATS[metric].format(known)


def metric_lines(metrics: dict[str, Any], folder: Path, has_transparency: bool) -> list[str]:
    """Return the lines printed at the end of an evaluation; the background is named if images have transparency."""
    protocol = metrics["protocol"]
    ssim = "not computed" if metrics["ssim"] is None else f"{metrics['ssim']:.4f}"
    halves = "" if protocol.get("colors", COLORS["raw"]) == COLORS["raw"] else f" ({protocol['colors']})"
    background = f", {protocol['background']} background" if has_transparency else ""
    fitted = "" if metrics["cc_psnr"] is None else f"; {metrics['cc_psnr']:.2f} dB with fitted colors (cc_psnr)"
    count, total = metrics["num_images"], metrics["split_views"]
    views = f"{count} views" if count == total else f"{count} of {total} views"
    lines = [
        f"{protocol['split']} PSNR    {metrics['psnr']:.2f} dB   SSIM {ssim}   ({views}{background})",
        f"               median {metrics['median']['psnr']:.2f} dB, worst {metrics['worst']['psnr']['value']:.2f} dB "
        f"({metrics['worst']['psnr']['name']}){fitted}{halves}",
    ]
    if metrics.get("nearest_views") is not None:
        without = metrics["nearest_views"]
        lines.append(
            f"no model     nearest photograph {without['nearest']:.2f} dB, blend of {without['photographs']} "
            f"{without['blend']:.2f} dB; through a plane {without['nearest_on_plane']:.2f} and "
            f"{without['blend_on_plane']:.2f} dB"
        )
    if metrics["depth_error"] is not None:
        normal = metrics["normal_error"]
        angle = "" if normal is None else f"   normal error {normal:.1f} degrees"
        lines.append(f"depth error  {metrics['depth_error']:.4f} scene units{angle}")
    if metrics["lpips"] is not None:
        lines.append(f"LPIPS        {metrics['lpips']:.4f} ({protocol['lpips']})")
    lines.append(
        f"speed        {metrics['frames_per_second']:.3g} frames per second, "
        f"at most {metrics['peak_memory_gigabytes']:.2f} GB of memory"
    )
    return [*lines, f"metrics      {folder / 'metrics.json'}"]

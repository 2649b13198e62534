"""The main numbers of a run in words, for a page about it."""

from typing import Any

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
SHOWN_FIRST = ("PSNR (mean)", "SSIM", "LPIPS", "views measured", "training")
"""Labels of the numbers that a page does not fold or leave out."""
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
        shown.append(("views measured", f"{count:,.0f}" if count == of else f"{count:,.0f} of {of:,.0f}"))
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

"""The summary of an evaluation in the console."""

from pathlib import Path
from typing import Any

from nerf_lightning.evaluation.protocol import COLORS


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

"""Run folders that a test writes: what a finished and measured run leaves, without training one."""

import json
from pathlib import Path
from typing import Any

import yaml

PROTOCOL = {
    "scene": "lego",
    "split": "test",
    "split_hash": "0123456789abcdef",
    "background": "white",
    "resolution": [[800, 800]],
    "pixels": "float",
    "cameras": "raw",
    "masks": "none",
    "psnr": "mean of the pictures' own",
    "ssim": "torchmetrics, Gaussian 11 x 11, sigma 1.5",
    "lpips": None,
}
ORIGIN = {
    "model": "fast",
    "scene": "blender",
    "seed": 0,
    "config": "fedcba9876543210",
    "version": "0.1.0",
    "commit": None,
    "device": "cpu",
    "precision": "32-true",
    "parameters": 1000,
    "megabytes": 0.004,
}


def leave_measured_run(
    folder: Path,
    measured: float | None = 30.0,
    seed: int = 0,
    overrides: tuple[str, ...] = (),
    protocol: dict[str, Any] | None = None,
    origin: dict[str, Any] | None = None,
    **note: Any,
) -> Path:
    """Write run.json, .hydra/overrides.yaml and metrics.json; without `measured` no metrics."""
    (folder / ".hydra").mkdir(parents=True)
    (folder / ".hydra" / "overrides.yaml").write_text(yaml.safe_dump([f"seed={seed}", *overrides]))
    kept = {"started": "2026-01-01T00:00:00", "finished_at_step": 10, "training_seconds": 90.0, "seconds": 100.0}
    (folder / "run.json").write_text(json.dumps(kept | note))
    if measured is not None:
        values = dict.fromkeys(("lpips", "depth_error", "normal_error"), None)
        content = {"psnr": measured, "ssim": 0.9, **values, "frames_per_second": 2.5}
        content["protocol"] = PROTOCOL | (protocol or {})
        content["origin"] = ORIGIN | {"seed": seed} | (origin or {})
        (folder / "metrics.json").write_text(json.dumps(content))
    return folder


def ours(rows: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """Return the rows of a table that nobody has published."""
    return [row for row in rows if not row.get("source")]

"""The machine and the libraries that a result was made with: the `environment` of `metrics.json`."""

import platform
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

import psutil
import torch

from nerf_lightning.compute.cores import num_cores

LIBRARIES = ("torch", "lightning", "hydra-core", "torchmetrics", "numpy", "numba", "triton")


def environment() -> dict[str, Any]:
    """Return a description of the machine, including a GPU if there is one, and the installed versions."""
    gpus = [torch.cuda.get_device_name(number) for number in range(torch.cuda.device_count())]
    return {
        "python": platform.python_version(),
        **{name: found for name in LIBRARIES if (found := _version(name)) is not None},
        "system": platform.platform(),
        "processor": _processor(),
        "cores": num_cores(),
        "memory_gigabytes": round(psutil.virtual_memory().total / 1e9, 1),
        **({"gpus": gpus, "cuda": torch.version.cuda} if gpus else {}),
    }


def _version(name: str) -> str | None:
    try:
        return version(name)
    except PackageNotFoundError:
        return None


def _processor() -> str:
    try:
        lines = Path("/proc/cpuinfo").read_text(encoding="utf-8", errors="replace").splitlines()
    except OSError:
        lines = []
    names = [line.partition(":")[2].strip() for line in lines if line.startswith("model name")]
    return names[0] if names else platform.processor() or platform.machine() or "unknown"

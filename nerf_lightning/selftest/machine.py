"""What the machine is, as far as it may decide the result: instruction sets, GPU, driver, threads."""

import os
import re
import subprocess
from pathlib import Path
from typing import Any

import torch

FLAGS = re.compile(r"\b(sse4_2|avx|avx2|fma|avx512\w*|avx_\w+|amx\w*|asimd\w*|bf16|i8mm|sve\w*)\b")


def machine(device: torch.device) -> dict[str, Any]:
    """Return what a bug report should say of this machine, beside the versions of libraries."""
    return {
        "cpu_capability": torch.backends.cpu.get_cpu_capability(),
        "cpu_flags": _cpu_flags(),
        "threads": _threads(),
        **(_gpu(device) if device.type == "cuda" else {}),
    }


def _cpu_flags() -> str:
    try:
        text = Path("/proc/cpuinfo").read_text(encoding="utf-8", errors="replace")
    except OSError:
        return "unknown"
    line = re.search(r"^(?:flags|Features)\s*:(.*)$", text, re.MULTILINE)
    return " ".join(sorted(set(FLAGS.findall(line.group(1))))) if line else "unknown"


def _threads() -> dict[str, Any]:
    return {"torch": torch.get_num_threads(), "of the machine": os.cpu_count()}


def _gpu(device: torch.device) -> dict[str, Any]:
    properties = torch.cuda.get_device_properties(device)
    free, total = torch.cuda.mem_get_info(device)
    return {
        "gpu": properties.name,
        "gpu_capability": f"{properties.major}.{properties.minor}",
        "gpu_processors": properties.multi_processor_count,
        "gpu_memory_gigabytes": {"total": round(total / 1e9, 1), "free": round(free / 1e9, 1)},
        "driver": _driver(),
        "cuda": torch.version.cuda,
        "cudnn": torch.backends.cudnn.version(),
        "allow_tf32": {
            "matrices": torch.get_float32_matmul_precision(),
            "convolutions": torch.backends.cudnn.allow_tf32,
        },
    }


def _driver() -> str:
    """Return the driver's version: of the kernel module on Linux, else as nvidia-smi says."""
    try:
        found = re.search(r"Module\s+([\d.]+)", Path("/proc/driver/nvidia/version").read_text())
        if found:
            return found.group(1)
    except OSError:
        pass
    try:
        asked = ["nvidia-smi", "--query-gpu=driver_version", "--format=csv,noheader"]
        return subprocess.run(asked, capture_output=True, text=True, timeout=20).stdout.strip() or "unknown"
    except (OSError, subprocess.SubprocessError):
        return "unknown"

"""What the machine is, as far as it may decide the result: instruction sets, GPU, driver, threads."""

import os
import re
from pathlib import Path
from typing import Any

import torch
from torch.utils import collect_env

FLAGS = re.compile(r"\b(sse4_2|avx|avx2|fma|avx512\w*|avx_\w+|amx\w*|asimd\w*|bf16|i8mm|sve\w*)\b")


def machine(device: torch.device) -> dict[str, Any]:
    """Return what a bug report should say of this machine, beside the versions of libraries."""
    known: dict[str, Any] = {
        "cpu_capability": torch.backends.cpu.get_cpu_capability(),
        "cpu_flags": _cpu_flags(),
        "threads": {"torch": torch.get_num_threads(), "of the machine": os.cpu_count()},
    }
    if device.type == "cuda":
        free, total = (round(size / 1e9, 1) for size in torch.cuda.mem_get_info(device))
        known |= {
            "gpu": str(torch.cuda.get_device_properties(device)),
            "gpu_memory_gigabytes": {"total": total, "free": free},
            "driver": collect_env.get_nvidia_driver_version(collect_env.run),
            "cudnn": torch.backends.cudnn.version(),
            "allow_tf32": {
                "matrices": torch.get_float32_matmul_precision(),
                "convolutions": torch.backends.cudnn.allow_tf32,
            },
        }
    return known


def _cpu_flags() -> str:
    try:
        text = Path("/proc/cpuinfo").read_text(encoding="utf-8", errors="replace")
    except OSError:
        return "unknown"
    line = re.search(r"^(?:flags|Features)\s*:(.*)$", text, re.MULTILINE)
    return " ".join(sorted(set(FLAGS.findall(line[1])))) if line else "unknown"

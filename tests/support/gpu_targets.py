"""GPUs that are not here: the triton kernels are compiled for them ahead of time, and their limits are known.

`compiled_for(name)` lets the host code of the kernels run on the CPU as it does on a GPU: types, alignments and options
of a launch are triton's own, and so is its refusal of what needs more shared memory than there is. Nothing is computed.
"""

import importlib
import re
import subprocess
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import pytest

triton = pytest.importorskip("triton", reason="triton is not installed (Linux only)")
GPUTarget = importlib.import_module("triton.backends.compiler").GPUTarget
OutOfResources = triton.runtime.errors.OutOfResources


@dataclass(frozen=True)
class Device:
    """A kind of GPU."""

    backend: str
    arch: int | str
    warp: int
    shared: int
    """Bytes of shared memory that one block may have at most (CUDA's guide, compute capabilities; AMD's LDS)."""


DEVICES = {
    "sm_75": Device("cuda", 75, 32, 65_536),  # T4, RTX 20
    "sm_80": Device("cuda", 80, 32, 166_912),  # A100
    "sm_86": Device("cuda", 86, 32, 101_376),  # RTX 30
    "sm_89": Device("cuda", 89, 32, 101_376),  # RTX 40
    "sm_90": Device("cuda", 90, 32, 232_448),  # H100
    "sm_100": Device("cuda", 100, 32, 232_448),  # B200
    "sm_120": Device("cuda", 120, 32, 101_376),  # RTX 50
    "gfx942": Device("hip", "gfx942", 64, 65_536),  # MI300
}
TENSOR_MEMORY = 512
"""Columns of the memory of Blackwell's tensor cores, which other devices do without."""


@dataclass
class Compiled:
    """What became of the launches."""

    kernels: list[Any] = field(default_factory=list)

    def spilled(self) -> int:
        """Return the most bytes that a thread of any kernel keeps outside of registers."""
        return max(resources(each)[1] for each in self.kernels)


@contextmanager
def compiled_for(name: str, modules: dict[Any, list[str]]) -> Iterator[Compiled]:
    """Compile what is launched for a GPU, and launch nothing.

    Args:
        name: of `DEVICES`.
        modules: modules with triton kernels, and the kernels' names.
    """
    device, made = DEVICES[name], Compiled()
    with pytest.MonkeyPatch.context() as patch:
        driver = triton.runtime.driver
        patch.setattr(driver, "_active", _Driver(name))
        for module, kernels in modules.items():
            for kernel in kernels:
                patch.setattr(module, kernel, _Launcher(getattr(module, kernel), device, made))
        yield made


class _Driver:
    """What triton asks of a driver before it compiles."""

    def __init__(self, name: str):
        self.number, self.device = list(DEVICES).index(name), DEVICES[name]

    def get_current_device(self) -> int:
        return self.number

    def get_current_stream(self, device: int) -> int:
        return 0

    def get_current_target(self) -> Any:
        return GPUTarget(self.device.backend, self.device.arch, self.device.warp)


class _Launcher:
    def __init__(self, kernel: Any, device: Device, made: Compiled):
        self.kernel, self.device, self.made = kernel, device, made

    def __getitem__(self, grid: tuple[int, ...]) -> Any:
        def launch(*arguments: Any, **options: Any) -> None:
            compiled = self.kernel.run(*arguments, grid=grid, warmup=True, **options)
            if compiled.metadata.shared > self.device.shared:
                raise OutOfResources(compiled.metadata.shared, self.device.shared, "shared memory")
            if (getattr(compiled.metadata, "tmem_size", None) or 0) > TENSOR_MEMORY:
                raise OutOfResources(compiled.metadata.tmem_size, TENSOR_MEMORY, "tensor memory")
            self.made.kernels.append(compiled)

        return launch


def resources(compiled: Any) -> tuple[int, int, int]:
    """Return a thread's registers, its bytes that no register had room for, and a block's bytes of shared memory."""
    shared = compiled.metadata.shared
    if "amdgcn" in compiled.asm:
        counts = (re.search(rf"\.vgpr_{what}:\s+(\d+)", compiled.asm["amdgcn"]) for what in ("count", "spill_count"))
        registers, spilled = (int(found[1]) for found in counts)
        return registers, 4 * spilled, shared
    tool = Path(triton.__file__).parent / "backends/nvidia/bin/cuobjdump"
    with tempfile.NamedTemporaryFile(suffix=".cubin") as file:
        file.write(compiled.asm["cubin"])
        file.flush()
        told = subprocess.run([tool, "-res-usage", file.name], capture_output=True, text=True, check=True).stdout
    registers, spilled = re.search(r"REG:(\d+) STACK:(\d+)", told).groups()
    return int(registers), int(spilled), shared

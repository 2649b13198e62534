"""What is said of machines that say little of themselves."""

from types import SimpleNamespace

import pytest
import torch

from nerf_lightning.selftest import machine as module
from nerf_lightning.selftest.machine import machine

CPU = torch.device("cpu")


@pytest.mark.parametrize(
    ("text", "flags"),
    [
        ("flags\t\t: fpu avx2 fma avx512_bf16 wp\n", "avx2 avx512_bf16 fma"),
        ("Features\t: fp asimd bf16 sve2 crc32\n", "asimd bf16 sve2"),
        ("processor : 0\n", "unknown"),
    ],
)
def test_instruction_sets_are_read_where_linux_lists_them(text, flags, monkeypatch):
    monkeypatch.setattr(module.Path, "read_text", lambda *given, **options: text)
    assert machine(CPU)["cpu_flags"] == flags


def test_what_cannot_be_known_is_unknown(monkeypatch):
    def missing(*given, **options):
        raise FileNotFoundError("not on this system")

    monkeypatch.setattr(module.Path, "read_text", missing)
    known = machine(CPU)
    assert known["cpu_flags"] == "unknown"
    assert "gpu" not in known


def test_a_gpu_is_described_with_its_driver(monkeypatch):
    properties = SimpleNamespace(name="Some GPU", major=9, minor=0, multi_processor_count=132)
    monkeypatch.setattr(torch.cuda, "get_device_properties", lambda device: properties)
    monkeypatch.setattr(torch.cuda, "mem_get_info", lambda device: (1_000_000_000, 2_000_000_000))
    monkeypatch.setattr(module.collect_env, "get_nvidia_driver_version", lambda run: "570.1.2")
    known = machine(torch.device("cuda"))
    assert "Some GPU" in known["gpu"]
    assert known["driver"] == "570.1.2"
    assert known["gpu_memory_gigabytes"] == {"total": 2.0, "free": 1.0}

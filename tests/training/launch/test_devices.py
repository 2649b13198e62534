"""Machines that we do not have: GPUs that cannot be used, CPUs that nobody knows."""

import logging
import platform

import pytest
import torch

from nerf_lightning.compute.devices import working_device
from nerf_lightning.config.messages import paragraph
from nerf_lightning.evaluation import protocol as environment
from nerf_lightning.messages.errors import InputError
from nerf_lightning.nerf.matmul_precision import cpu_multiplies_bfloat16

CHOSEN = ("cuda", "Old GPU, found")


def full(*given):
    return 300_000_000, 2_000_000_000


def too_new(*given):
    raise RuntimeError("CUDA error: no kernel image is available\nfor execution on the device")


TROUBLES = {full: "0.3 GB of its 2.0 GB of memory are free", too_new: "no kernel image is available for execution"}


@pytest.mark.parametrize("answer", TROUBLES)
def test_a_gpu_that_cannot_be_used_leaves_the_work_to_the_cpu_unless_it_was_asked_for(answer, monkeypatch, caplog):
    monkeypatch.setattr(torch.cuda, "mem_get_info", answer)
    with caplog.at_level(logging.WARNING):
        assert working_device(CHOSEN, "auto") == ("cpu", "the GPU cannot be used")
    assert TROUBLES[answer] in caplog.text
    assert "The CPU computes instead" in caplog.text
    with pytest.raises(InputError, match="torch sees a GPU here") as refused:
        working_device(CHOSEN, "gpu")
    assert TROUBLES[answer] in str(refused.value)
    assert "trainer=cpu" in str(refused.value)


def test_a_cpu_is_not_tried(monkeypatch):
    monkeypatch.setattr(torch.cuda, "mem_get_info", too_new)
    assert working_device(("cpu", "as asked"), "cpu") == ("cpu", "as asked")


def test_a_cpu_that_torch_does_not_know_has_no_bfloat16(monkeypatch):
    def unknown():
        raise RuntimeError("unsupported CPU")

    monkeypatch.setattr(torch.cpu, "_is_avx512_bf16_supported", unknown)
    monkeypatch.delattr(torch.cpu, "_is_amx_tile_supported")
    assert not cpu_multiplies_bfloat16.__wrapped__()


def test_a_cpu_without_a_name_is_unknown(monkeypatch):
    monkeypatch.setattr(environment.Path, "read_text", lambda *given, **options: "flags: none\n")
    monkeypatch.setattr(platform, "processor", lambda: "")
    monkeypatch.setattr(platform, "machine", lambda: "")
    assert environment.environment()["processor"] == "unknown"


@pytest.mark.parametrize(
    ("error", "reason"),
    [
        (
            torch.OutOfMemoryError("CUDA out of memory. GPU 0 has\n a total"),
            "CUDA out of memory",
        ),
        (MemoryError(), "Python got none"),
        (MemoryError("Unable to allocate 8.00 TiB for an array"), "Unable to allocate 8.00 TiB for an array"),
    ],
)
def test_a_machine_that_runs_out_of_memory_ends_with_one_paragraph(error, reason):
    told = paragraph(error, "train")
    assert told is not None
    assert told.startswith(f"There is no memory for this: {reason}. Use a smaller model")
    assert "\n" not in told
    assert paragraph(RuntimeError("a mistake of ours"), "train") is None

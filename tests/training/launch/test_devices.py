"""Machines that we do not have: GPUs that cannot be used, unknown CPUs, TPUs, and which precision suits them."""

import importlib.util
import logging
import platform
import sys
import warnings

import pytest
import torch
from support.configs import composed
from support.scenes import tiny_model
from support.static_models import MODELS, fast_model

from nerf_lightning.compute import devices, environment, precision, xla_device
from nerf_lightning.compute.devices import working_device
from nerf_lightning.compute.precision import choose_precision
from nerf_lightning.config.error_messages import paragraph
from nerf_lightning.messages.errors import InputError
from nerf_lightning.nerf import matmul_precision
from nerf_lightning.nerf.matmul_precision import cpu_multiplies_bfloat16
from nerf_lightning.nerf.models.ragged_level import RaggedLevel
from nerf_lightning.training.launch import xla
from nerf_lightning.training.launch.processes import num_processes
from nerf_lightning.training.launch.trainer import TrainerSettings

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
    assert "The CPU is used instead" in caplog.text
    with pytest.raises(InputError, match="torch sees a GPU here") as refused:
        working_device(CHOSEN, "gpu")
    assert TROUBLES[answer] in str(refused.value)
    assert "trainer=cpu" in str(refused.value)


def test_a_driver_that_is_too_old_is_named(monkeypatch, caplog):
    old = "The NVIDIA driver on your system is too old (found version 11040)"

    def is_available():
        warnings.warn(f"CUDA initialization: {old}.", UserWarning, stacklevel=1)
        return False

    monkeypatch.setattr(torch.cuda, "is_available", is_available)
    with pytest.raises(InputError, match="torch sees no CUDA device here") as refused:
        devices.choose_device("gpu")
    assert f"here. {old}. Use trainer=cpu" in str(refused.value)
    assert devices.choose_device("auto") == ("cpu", "no GPU found")
    assert caplog.messages == [f"Using the CPU, because torch cannot use the GPU here: {old}."]


def test_a_cpu_is_not_tried_and_one_that_nobody_knows_has_no_bfloat16_and_no_name(monkeypatch):
    monkeypatch.setattr(torch.cuda, "mem_get_info", too_new)
    assert working_device(("cpu", "as asked"), "cpu") == ("cpu", "as asked")

    def unknown():
        raise RuntimeError("unsupported CPU")

    monkeypatch.setattr(torch.cpu, "_is_avx512_bf16_supported", unknown)
    monkeypatch.delattr(torch.cpu, "_is_amx_tile_supported")
    assert not cpu_multiplies_bfloat16.__wrapped__()
    monkeypatch.setattr(environment, "_version", lambda name: None)  # which would be read so, too
    monkeypatch.setattr(environment.Path, "read_text", lambda *given, **options: "flags: none\n")
    monkeypatch.setattr(platform, "processor", lambda: "")
    monkeypatch.setattr(platform, "machine", lambda: "")
    assert environment.environment()["processor"] == "unknown"


@pytest.mark.parametrize(
    ("error", "reason"),
    [
        (torch.OutOfMemoryError("CUDA out of memory. GPU 0 has\n a total"), "CUDA out of memory"),
        (MemoryError(), "Python got none"),
        (MemoryError("Unable to allocate 8.00 TiB for an array"), "Unable to allocate 8.00 TiB for an array"),
    ],
)
def test_a_machine_that_runs_out_of_memory_ends_with_one_paragraph(error, reason):
    told = paragraph(error, "train")
    assert told is not None
    assert told.startswith(f"Not enough memory: {reason}. Use a smaller model")
    assert "\n" not in told
    assert paragraph(RuntimeError("a mistake of ours"), "train") is None


def test_memory_that_cannot_hold_torch_is_named_without_it(monkeypatch):
    monkeypatch.setitem(sys.modules, "nerf_lightning.nerf.models.tiles", None)
    assert str(paragraph(MemoryError(), "train")).startswith("Not enough memory: Python got none.")


@pytest.mark.parametrize("kind", [torch.AcceleratorError, RuntimeError])
def test_a_gpu_that_fails_ends_with_one_paragraph(kind):
    told = paragraph(kind("CUDA error: device-side assert triggered\nCompile with TORCH_USE_CUDA_DSA"), "render")
    assert told is not None
    assert told.startswith("The GPU has failed: CUDA error: device-side assert triggered")
    assert "\n" not in told


@pytest.fixture
def slow_bfloat16(monkeypatch):
    """A CPU that multiplies bfloat16 natively, and wide matrices slower than in float32."""
    monkeypatch.setattr(precision, "cpu_multiplies_bfloat16", lambda: True)
    monkeypatch.setattr(precision, "cpu_gains_by_bfloat16", lambda: False)


def products_of(model):
    return {level.field.matmul_precision for level in model.levels.values()}


def test_wide_layers_take_float32_where_bfloat16_is_slower_unless_it_was_asked_for_or_begun(slow_bfloat16, monkeypatch):
    settings = TrainerSettings(accelerator="cpu")
    assert products_of(settings.prepare(fast_model())) == {"bfloat16"}
    assert products_of(settings.prepare(tiny_model())) == {"float32"}
    assert (settings.precision, "slower for layers as wide as this model's" in settings.describe()) == ("32-true", True)
    assert products_of(settings.prepare(fast_model())) == {"bfloat16"}  # whatever was prepared before
    assert products_of(TrainerSettings(accelerator="cpu", precision="bf16-mixed").prepare(tiny_model())) == {"bfloat16"}
    resumed = TrainerSettings(accelerator="cpu")
    resumed.keep_precision("bf16-mixed")
    assert products_of(resumed.prepare(tiny_model())) == {"bfloat16"}
    monkeypatch.setenv("NERF_LIGHTNING_PRECISION", "bf16-mixed")
    assert products_of(TrainerSettings(accelerator="cpu").prepare(tiny_model())) == {"bfloat16"}


@pytest.mark.parametrize(
    ("name", "native", "amx", "gains"),
    [
        ("Intel Xeon", True, False, False),
        ("Intel Xeon", True, True, True),
        ("AMD EPYC 9004", True, False, True),
        ("Intel Core i7", False, False, False),
    ],
)
def test_who_gains_by_bfloat16(name, native, amx, gains, monkeypatch):
    monkeypatch.setattr(matmul_precision, "cpu_multiplies_bfloat16", lambda: native)
    monkeypatch.setattr(torch.cpu, "_is_amx_tile_supported", lambda: amx)
    monkeypatch.setattr(torch.cpu, "get_capabilities", lambda: {"cpu_name": name}, raising=False)
    assert matmul_precision.cpu_gains_by_bfloat16.__wrapped__() == gains


@pytest.mark.parametrize(("native", "used"), [(False, "32-true"), (True, "bf16-mixed")])
@pytest.mark.parametrize("begun", [False, True])
def test_a_gpu_without_bfloat16_takes_float32_and_says_so_once(native, used, begun, monkeypatch, caplog):
    monkeypatch.setattr(torch.cuda, "is_bf16_supported", lambda including_emulation: native)
    asked = ("bf16-mixed", "as when the run started") if begun else precision.choose_precision("bf16-mixed", "cuda")
    assert precision.suited(*asked, "cuda", tiny_model())[0] == used
    said = ["trainer.precision=bf16-mixed: this device has no native bfloat16, so float32 is used instead."]
    assert caplog.messages == ([] if native or begun else said)


@pytest.fixture
def tpu(monkeypatch):
    monkeypatch.setattr(xla_device, "require_device", lambda: "TPU")


def test_a_missing_torch_xla_is_named_with_the_way_to_install_it_and_a_missing_tpu(monkeypatch):
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: None)
    with pytest.raises(InputError, match=r"torch_xla, which is not installed.*torch 2\.9.*make xla.*trainer=auto"):
        TrainerSettings(accelerator=composed("train", "trainer=tpu").trainer.accelerator)
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: True)
    monkeypatch.setattr(xla_device, "ACCELERATOR", type("None", (), {"is_available": staticmethod(lambda: False)}))
    with pytest.raises(InputError, match="finds no TPU on this machine"):
        TrainerSettings(accelerator="tpu")


def test_a_tpu_takes_one_process_in_bfloat16_and_refuses_what_does_not_fit(tpu):
    with pytest.raises(InputError, match=r"trainer\.compile=true.*XLA compiles"):
        TrainerSettings(accelerator="tpu", compile=True)
    with pytest.raises(InputError, match=r"launched_by=torchrun.*one process drives all cores"):
        TrainerSettings(accelerator="tpu", launched_by="torchrun")
    for model in MODELS.values():
        xla.require_static_shapes(model())
    with pytest.raises(InputError, match="model=fast_dense"):
        xla.require_static_shapes(fast_model(RaggedLevel))
    settings = TrainerSettings(accelerator="tpu", devices=8)
    assert (settings.device_type, settings.precision, settings.measures_tile) == ("xla", "bf16-mixed", False)
    assert choose_precision("32-true", "xla")[0] == "32-true"
    assert num_processes(8, "xla") == num_processes("auto", "xla") == 1

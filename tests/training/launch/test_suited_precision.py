"""Which precision suits a device and a model: CPUs that multiply bfloat16, and are slower at it."""

import pytest
import torch
from support.scenes import tiny_model
from support.static_models import fast_model

from nerf_lightning.compute import devices
from nerf_lightning.nerf import matmul_precision
from nerf_lightning.training.launch.trainer import TrainerSettings


@pytest.fixture
def slow_bfloat16(monkeypatch):
    """A CPU that multiplies bfloat16 natively, and wide matrices slower than in float32."""
    monkeypatch.setattr(devices, "cpu_multiplies_bfloat16", lambda: True)
    monkeypatch.setattr(devices, "cpu_gains_by_bfloat16", lambda: False)


def products_of(model):
    return {level.field.matmul_precision for level in model.levels.values()}


def test_wide_layers_are_multiplied_in_float32_where_bfloat16_is_slower(slow_bfloat16):
    settings = TrainerSettings(accelerator="cpu")
    assert products_of(settings.prepare(fast_model())) == {"bfloat16"}
    assert products_of(settings.prepare(tiny_model())) == {"float32"}
    assert (settings.precision, "slower for layers as wide as this model's" in settings.describe()) == ("32-true", True)
    assert products_of(settings.prepare(fast_model())) == {"bfloat16"}  # whatever was prepared before


def test_what_was_asked_for_or_begun_stays(slow_bfloat16, monkeypatch):
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


def test_a_torch_that_names_no_cpu_takes_bfloat16_where_it_is_native(monkeypatch):
    monkeypatch.setattr(matmul_precision, "cpu_multiplies_bfloat16", lambda: True)
    monkeypatch.setattr(torch.cpu, "_is_amx_tile_supported", lambda: False)
    monkeypatch.delattr(torch.cpu, "get_capabilities", raising=False)
    assert matmul_precision.cpu_gains_by_bfloat16.__wrapped__()


@pytest.mark.parametrize(("native", "used"), [(False, "32-true"), (True, "bf16-mixed")])
@pytest.mark.parametrize("begun", [False, True])
def test_a_gpu_without_bfloat16_takes_float32_and_says_so_once(native, used, begun, monkeypatch, caplog):
    monkeypatch.setattr(torch.cuda, "is_bf16_supported", lambda including_emulation: native)
    asked = ("bf16-mixed", "as the run began") if begun else devices.choose_precision("bf16-mixed", "cuda")
    assert devices.suited(*asked, "cuda", tiny_model())[0] == used
    said = ["trainer.precision=bf16-mixed: this device has no native bfloat16, so float32 is used instead."]
    assert caplog.messages == ([] if native or begun else said)

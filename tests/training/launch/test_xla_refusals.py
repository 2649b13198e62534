"""What is said about TPUs where there is none."""

import importlib.util

import pytest
from support.configs import composed
from support.static_models import MODELS, fast_model

from nerf_lightning.compute import xla_device
from nerf_lightning.compute.precision import choose_precision
from nerf_lightning.messages.errors import InputError
from nerf_lightning.nerf.models.ragged_level import RaggedLevel
from nerf_lightning.training.launch import xla
from nerf_lightning.training.launch.processes import num_processes
from nerf_lightning.training.launch.trainer import TrainerSettings


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


def test_settings_and_models_that_do_not_fit_are_refused(tpu):
    with pytest.raises(InputError, match=r"trainer\.compile=true.*XLA compiles"):
        TrainerSettings(accelerator="tpu", compile=True)
    with pytest.raises(InputError, match=r"launched_by=torchrun.*one process drives all cores"):
        TrainerSettings(accelerator="tpu", launched_by="torchrun")
    for model in MODELS.values():
        xla.require_static_shapes(model())
    with pytest.raises(InputError, match="model=fast_dense"):
        xla.require_static_shapes(fast_model(RaggedLevel))


def test_one_process_multiplies_in_bfloat16_and_tries_no_tiles(tpu):
    settings = TrainerSettings(accelerator="tpu", devices=8)
    assert (settings.device_type, settings.precision, settings.measures_tile) == ("xla", "bf16-mixed", False)
    assert choose_precision("32-true", "xla")[0] == "32-true"
    assert num_processes(8, "xla") == num_processes("auto", "xla") == 1

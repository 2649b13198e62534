import logging

import pytest
import torch

from nerf_lightning.compute import precision
from nerf_lightning.compute.settings import CPU_TILE_POINTS, MOST_CPU_TILE_POINTS
from nerf_lightning.messages.errors import InputError
from nerf_lightning.training.launch.trainer import TrainerSettings


@pytest.fixture
def native(monkeypatch):
    monkeypatch.delenv("NERF_LIGHTNING_PRECISION", raising=False)

    def pretend(answer):
        monkeypatch.setattr(precision, "has_native_bfloat16", lambda device_type: answer)

    return pretend


def test_precision_and_device_follow_the_machine_with_their_reasons(native, monkeypatch):
    native(True)
    assert TrainerSettings(accelerator="cpu").precision == "bf16-mixed"
    assert "native bfloat16" in TrainerSettings(accelerator="cpu").describe()
    native(False)
    assert TrainerSettings(accelerator="cpu").precision == "32-true"
    assert "no native bfloat16" in TrainerSettings(accelerator="cpu").describe()
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    assert "(no GPU found)" in TrainerSettings().describe()
    assert "(as asked)" in TrainerSettings(accelerator="cpu").describe()
    assert precision.has_native_bfloat16("cpu") in (True, False)


def test_the_environment_says_what_auto_means(native, monkeypatch, caplog):
    for answer, meant in ((True, "32-true"), (False, "bf16-mixed")):
        native(answer)
        monkeypatch.setenv("NERF_LIGHTNING_PRECISION", meant)
        settings = TrainerSettings(accelerator="cpu")
        assert (settings.precision, settings.reason) == (meant, "as NERF_LIGHTNING_PRECISION says")
        other = "32-true" if meant == "bf16-mixed" else "bf16-mixed"
        assert "emulated" not in caplog.text  # who tries another machine knows
        assert TrainerSettings(accelerator="cpu", precision=other).precision == other  # what is asked for is taken
    monkeypatch.setenv("NERF_LIGHTNING_PRECISION", "half")
    with pytest.raises(InputError, match=r"NERF_LIGHTNING_PRECISION=half .* use one of auto, 32-true"):
        TrainerSettings(accelerator="cpu")


def test_a_precision_that_is_asked_for_is_taken_with_a_warning_where_it_is_slow(native, caplog):
    native(False)
    with caplog.at_level(logging.WARNING):
        assert TrainerSettings(accelerator="cpu", precision="bf16-mixed").precision == "bf16-mixed"
    assert "no native bfloat16" in caplog.text


def test_the_length_is_the_smaller_of_steps_and_epochs_and_no_steps_at_all_are_refused():
    assert TrainerSettings(max_steps=100).num_steps(1000, 10, 0) == 100
    assert TrainerSettings(max_steps=1000, max_epochs=1).num_steps(1000, 10, 0) == 100
    assert TrainerSettings(max_steps=1000, max_epochs=0.5).num_steps(1001, 10, 0) == 50
    assert TrainerSettings(max_steps=70, max_epochs=3).num_steps(1000, 10, 0) == 70
    assert TrainerSettings(max_epochs=2).num_steps(995, 10, 30) == 229  # the crop is no epoch
    for name, value in (("max_steps", 0), ("val_every_steps", 0), ("clip_norm", -1), ("clip_norm", float("nan"))):
        with pytest.raises(InputError, match=f"trainer.{name}={value}"):
            TrainerSettings(**{name: value})


def test_tiles_can_be_chosen_and_switched_off_and_measured_ones_are_kept_within_reason():
    assert TrainerSettings(accelerator="cpu").tile_points == CPU_TILE_POINTS
    assert TrainerSettings(tile_points=99).tile_points == 99
    whole = TrainerSettings(accelerator="cpu", tile_points=None)
    assert whole.tile_points is None
    assert whole.inference_tile_points == CPU_TILE_POINTS
    measured = TrainerSettings(accelerator="cpu")
    measured.keep_tile(65536)
    assert measured.inference_tile_points == 65536
    measured.keep_tile(1 << 22)  # of a GPU
    assert measured.inference_tile_points == MOST_CPU_TILE_POINTS
    named = TrainerSettings(accelerator="cpu", tile_points=99)
    named.keep_tile(65536)
    assert named.inference_tile_points == 99
    settings = TrainerSettings(accelerator="cpu")
    for found, taken in ((1, 1024), (1 << 31, 1 << 18)):
        settings.keep_tile(found)
        assert settings.tile_points == taken


def test_what_this_machine_lacks_is_refused_with_a_cure(monkeypatch):
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    monkeypatch.setattr(torch.backends.mps, "is_available", lambda: False)
    for settings, words in (
        ({"accelerator": "gpu"}, "torch sees no CUDA device"),
        ({"accelerator": "mps"}, "torch sees no Apple GPU"),
        ({"accelerator": "cpu", "precision": "tf32"}, "trainer.precision=32-true"),
    ):
        with pytest.raises(InputError, match=words):
            TrainerSettings(**settings)

"""Arguments of Lightning's Trainer pass through, but for those that settings of ours say."""

import inspect

import pytest
from lightning import Trainer
from lightning.pytorch.profilers import SimpleProfiler
from support.configs import composed
from support.running import refused

from nerf_lightning.config.compose import compose_config
from nerf_lightning.config.instantiate import build
from nerf_lightning.config.overrides import open_sections
from nerf_lightning.config.setting_rules import LIGHTNING_ARGUMENTS
from nerf_lightning.runs.identity import run_identity, settings_digest
from nerf_lightning.training.launch.lightning_flags import passed_through
from nerf_lightning.training.launch.trainer import TrainerSettings


def trainer(tmp_path, **flags):
    return TrainerSettings(max_steps=7, accelerator="cpu", lightning=flags).build(tmp_path, 7, [], [])


def test_flags_reach_lightnings_trainer_and_every_argument_is_passed_through_or_ours(tmp_path):
    made = trainer(tmp_path, profiler="simple", limit_val_batches=2, num_sanity_val_steps=1, detect_anomaly=True)
    assert isinstance(made.profiler, SimpleProfiler)
    assert (made.limit_val_batches, made.num_sanity_val_steps, made._detect_anomaly) == (2, 1, True)
    assert (made.max_steps, made.max_epochs) == (7, -1)
    plain = trainer(tmp_path)
    assert (plain.limit_val_batches, plain.num_sanity_val_steps, plain.log_every_n_steps) == (1.0, 0, 1)
    known = set(inspect.signature(Trainer).parameters)
    assert known >= LIGHTNING_ARGUMENTS.keys()
    assert known - LIGHTNING_ARGUMENTS.keys() == {
        "fast_dev_run", "limit_val_batches", "num_sanity_val_steps", "log_every_n_steps", "enable_model_summary",
        "benchmark", "inference_mode", "profiler", "detect_anomaly", "enable_autolog_hparams",
    }  # fmt: skip


@pytest.mark.parametrize(("given", "steps"), [(True, 1), (3, 3), (False, 7), (20, 7)])
def test_a_run_that_tries_everything_once_is_as_short(given, steps):
    settings = TrainerSettings(max_steps=7, accelerator="cpu", lightning={"fast_dev_run": given})
    assert settings.num_steps(1000, 10, 0) == steps


@pytest.mark.parametrize("flag", sorted(LIGHTNING_ARGUMENTS))
def test_what_is_ours_to_say_is_refused_with_our_name(flag):
    refused(passed_through, {flag: 1}, parts=(f"trainer.lightning.{flag}=1", LIGHTNING_ARGUMENTS[flag]))


@pytest.mark.parametrize(
    ("flags", "parts"),
    [
        ({"profilr": "simple"}, ("trainer.lightning.profilr=simple", "no such argument", "profiler")),
        ({"limit_val_batches": "abc"}, ("trainer.lightning.limit_val_batches=abc", "number")),
        ({"detect_anomaly": 3}, ("trainer.lightning.detect_anomaly=3", "true or false")),
        ({"profiler": "nonsense"}, ("trainer.lightning", "profiler", "nonsense")),
        (5, ("trainer.lightning=5", "profiler")),
    ],
)
def test_what_lightning_would_not_take_is_refused(flags, parts):
    refused(passed_through, flags, parts=parts)


def test_no_plus_is_needed_and_no_other_run_is_meant():
    """Whatever passes through changes what is shown and measured, but not what is learned."""
    whole, removed = "trainer.lightning={profiler: simple}", "~trainer.lightning"
    assert open_sections([whole, removed, "trainer.lightnings=1"]) == [f"++{whole}", removed, "trainer.lightnings=1"]
    typed = open_sections(["trainer.lightning.profiler=simple", "seed=3", "+trainer.lightning.limit_val_batches=2"])
    config = compose_config("train", typed).config
    assert dict(config.trainer.lightning) == {"profiler": "simple", "limit_val_batches": 2}
    assert config.seed == 3
    without = composed("train", "seed=3")
    assert run_identity(config) == run_identity(without)
    assert settings_digest(config) != settings_digest(without)  # what is left on the disk may differ
    assert isinstance(build(config.trainer), TrainerSettings)

"""Features of Lightning's Trainer that need something of ours: determinism, times, averages of weights."""

import warnings
from datetime import timedelta

import pytest
import torch
from lightning import Trainer
from lightning.pytorch.callbacks import EMAWeightAveraging, Timer
from support.captures import write_npz
from support.configs import composed
from support.running import refused

import nerf_lightning as nl
from nerf_lightning.config.instantiate import build
from nerf_lightning.training import build_step
from nerf_lightning.training.callbacks.time_budget import TimeBudget
from nerf_lightning.training.launch.fitting import require_deterministic


@pytest.fixture
def run(tmp_path):
    capture = write_npz(tmp_path / "capture.npz")
    settings = ("scene=npz", f"scene.path={capture}", "model=nerf_tiny", "trainer=cpu", "data.batch_rays=32")
    return lambda *more: nl.build_run(*settings, *more)


@pytest.fixture
def fitted(tmp_path):
    def fit(run, ckpt_path=None, **settings):
        quiet = {"enable_progress_bar": False, "enable_model_summary": False, "logger": False, "limit_val_batches": 0}
        trainer = Trainer(accelerator="cpu", default_root_dir=tmp_path / "root", **quiet, **settings)
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            trainer.fit(run.system, run.data, ckpt_path=ckpt_path)
        return trainer

    return fit


def test_nobody_promises_the_order_of_atomic_sums(run, monkeypatch):
    tiny, fast = (build(composed("train", f"model={name}").model) for name in ("nerf_tiny", "fast_small"))
    require_deterministic(tiny, "cuda")
    require_deterministic(fast, "cpu")
    parts = ("hash grids", "trainer.deterministic=true", "Trainer(deterministic=True)", "model=nerf")
    refused(require_deterministic, fast, "cuda", parts=parts)
    asked = []
    monkeypatch.setattr(build_step, "require_deterministic", lambda model, device_type: asked.append(device_type))
    run()
    run("trainer.deterministic=true")
    assert asked == ["cpu"]


def test_a_time_that_the_learning_rate_does_not_follow_is_said_once_and_a_budget_is_followed(run, fitted, caplog):
    fitted(run(), max_steps=2, callbacks=Timer(duration=None))  # which only measures
    assert "Timer" not in caplog.text
    rates = {}
    for kind, settings in {
        "timer": {"max_time": timedelta(seconds=1)},
        "budget": {"callbacks": TimeBudget(seconds=1.0, every_steps=1)},
    }.items():
        one = run()
        trainer = fitted(one, max_steps=100_000, **settings)
        assert 1 < trainer.global_step < 100_000, kind
        rates[kind] = one.system.optimizers().param_groups[0]["lr"] / 5e-4
    assert rates["timer"] > 0.99
    assert rates["budget"] < 0.2
    assert [("max_steps" in each, "TimeBudget" in each) for each in caplog.messages if "Timer" in each] == [
        (True, True)
    ]


def test_averaged_weights_are_saved_opened_and_gone_on_with_to_the_bit(run, fitted):
    def averaged(steps, **more):
        one = run("scheduler=constant")
        return one, fitted(one, max_steps=steps, callbacks=EMAWeightAveraging(decay=0.9), **more)

    whole, _ = averaged(6)
    _, first = averaged(3)
    saved = first.checkpoint_callback.best_model_path
    rest, _ = averaged(6, ckpt_path=saved)
    for name, value in whole.system.state_dict().items():
        assert torch.equal(rest.system.state_dict()[name], value), name
    opened, content = nl.load(saved).module.state_dict(), torch.load(saved, weights_only=True)
    assert all(torch.equal(value, content["state_dict"][f"model.{name}"]) for name, value in opened.items())

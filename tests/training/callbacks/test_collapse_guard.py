import logging
import signal
from types import SimpleNamespace

import pytest
import torch
from lightning.pytorch import LightningModule, Trainer

from nerf_lightning.nerf.objective import StepOutput
from nerf_lightning.nerf.types.rays import PixelIndex
from nerf_lightning.training.callbacks import collapse_guard
from nerf_lightning.training.callbacks.collapse_guard import CollapseGuard, is_constant
from nerf_lightning.training.callbacks.stop_signals import StopSignals
from nerf_lightning.training.launch.preemption import stop_signals


class StubTrainer(Trainer):
    global_step, loggers = 0, ()
    datamodule = SimpleNamespace(batches=SimpleNamespace(batch_rays=64, crop_rays=lambda restarts: 64 * 50))

    def __init__(self):
        pass


@pytest.fixture(autouse=True)
def stubs_restart(monkeypatch):
    monkeypatch.setattr(collapse_guard, "restart", lambda train_step, optimizer: train_step.restart())


class StubSystem:
    def __init__(self, alive):
        self.progress = SimpleNamespace(step=0, restarts=0, attempt=0, rays_seen=0)
        self.alive = alive
        self.restarts = 0
        self.train_step = self  # the system's, too

    def optimizers(self):
        return SimpleNamespace(optimizer=None)

    @property
    def seen(self):
        target = torch.rand(64, 3, generator=torch.Generator().manual_seed(0))
        light = target if self.alive(self.restarts) else torch.zeros(64, 3)
        number, level = torch.zeros(64, dtype=torch.int64), torch.zeros(1)
        pixels = PixelIndex(number, number, number)
        return {"step": StepOutput(level, {}, level, light, light, target, torch.ones(64), pixels)}

    def restart(self):
        self.restarts += 1
        self.progress.restarts += 1
        self.progress.attempt += 1
        self.progress.step = self.progress.rays_seen = 0


def run(guard, system, steps):
    trainer = StubTrainer()
    for _ in range(steps):
        trainer.global_step += 1
        system.progress.step += 1
        system.progress.rays_seen += 64
        guard.on_train_batch_end(trainer, system, system.seen, None, 0)


def test_a_dead_run_is_restarted_and_says_so(caplog):
    system = StubSystem(alive=lambda restarts: restarts == 1)
    with caplog.at_level(logging.WARNING):
        run(CollapseGuard(), system, 1000)
    assert system.restarts == 1
    assert "Step 150: the renders are constant while the photographs are not" in caplog.text
    assert "attempt 2 of at most 4" in caplog.text


def test_a_living_run_is_left_alone():
    system = StubSystem(alive=lambda restarts: True)
    run(CollapseGuard(), system, 1000)
    assert system.restarts == 0


def test_it_gives_up_after_the_set_number(caplog):
    system = StubSystem(alive=lambda restarts: False)
    with caplog.at_level(logging.WARNING):
        run(CollapseGuard(max_restarts=2, until_step=300), system, 2000)
    assert system.restarts == 2
    assert "after 2 restarts" in caplog.text


def test_the_end_of_the_crop_is_watched_too():
    """A run may die when it first sees the mostly empty whole pictures."""
    system = StubSystem(alive=lambda restarts: restarts > 0 or system.progress.step < 300)
    run(CollapseGuard(), system, 560)
    assert system.restarts == 1


def test_constant_photographs_are_no_collapse_and_a_random_background_does_not_hide_one():
    flat = torch.full((64, 3), 0.5)
    assert not is_constant({"target": flat, "foreground": torch.zeros(64, 3), "weight": torch.ones(64)}, 0.02)
    # The rendered color varies with the background; the field's own light does not.
    step = {"target": torch.rand(64, 3), "foreground": torch.full((64, 3), 0.3), "weight": torch.ones(64)}
    assert is_constant(step, 0.02)


class Line(LightningModule):
    def __init__(self):
        super().__init__()
        self.layer = torch.nn.Linear(1, 1)

    def training_step(self, batch, index):
        return self.layer(batch).sum()

    def configure_optimizers(self):
        return torch.optim.SGD(self.parameters(), lr=0.1)


class Batches:
    def __len__(self):
        return 3

    def __iter__(self):
        return iter([torch.ones(1)] * 3)


def test_after_a_training_every_signal_does_what_it_did_before(tmp_path):
    before = {number: signal.getsignal(number) for number in stop_signals()}
    trainer = Trainer(
        default_root_dir=tmp_path, max_steps=2, accelerator="cpu", logger=False, callbacks=[StopSignals()],
        enable_checkpointing=False, enable_progress_bar=False, enable_model_summary=False,
    )  # fmt: skip
    trainer.fit(Line(), Batches())
    assert trainer.global_step == 2
    assert {number: signal.getsignal(number) for number in stop_signals()} == before

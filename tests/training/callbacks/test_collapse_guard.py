import logging
from types import SimpleNamespace

import pytest
import torch
from lightning.pytorch import Trainer

from nerf_lightning.nerf.objective import StepOutput
from nerf_lightning.nerf.types.rays import PixelIndex
from nerf_lightning.training.callbacks import collapse_guard
from nerf_lightning.training.callbacks.collapse_guard import CollapseGuard, is_constant


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
    living, system = StubSystem(alive=lambda restarts: True), StubSystem(alive=lambda restarts: restarts == 1)
    with caplog.at_level(logging.WARNING):
        run(CollapseGuard(), system, 1000)
        run(CollapseGuard(), living, 1000)
    assert (living.restarts, system.restarts) == (0, 1)
    assert "Step 150: the renders are constant while the photographs are not" in caplog.text
    assert "attempt 2 of at most 4" in caplog.text


def test_it_gives_up_after_the_set_number_and_watches_the_end_of_the_crop_too(caplog):
    system = StubSystem(alive=lambda restarts: False)
    with caplog.at_level(logging.WARNING):
        run(CollapseGuard(max_restarts=2, until_step=300), system, 2000)
    assert system.restarts == 2
    assert "after 2 restarts" in caplog.text
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

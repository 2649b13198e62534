import os
import signal
import time
from types import SimpleNamespace
from unittest.mock import create_autospec

import pytest
from lightning.pytorch import Trainer

from nerf_lightning.training.callbacks.time_budget import TimeBudget


def trainer():
    return create_autospec(Trainer, instance=True, estimated_stepping_batches=200_000)


def a_system(step):
    return SimpleNamespace(step=SimpleNamespace(progress=SimpleNamespace(step=step), num_steps=200_000))


def test_a_resumed_run_takes_up_its_schedule_at_once():
    """The fault: until the next estimate the learning rate would jump back to its start."""
    budget = TimeBudget(seconds=10.0)
    budget.load_state_dict({"used": 5.0})
    system = a_system(step=103)
    budget.on_train_start(trainer(), system)
    assert system.step.num_steps == 206


def test_a_new_run_keeps_its_length_until_its_speed_is_known():
    system = a_system(step=0)
    TimeBudget(seconds=10.0).on_train_start(trainer(), system)
    assert system.step.num_steps == 200_000


@pytest.mark.skipif(not hasattr(signal, "SIGCONT"), reason="no process is stopped there")
def test_a_stopped_process_uses_no_time(monkeypatch):
    now = [100.0]
    monkeypatch.setattr(time, "perf_counter", lambda: now[0])
    budget, system = TimeBudget(seconds=10.0), a_system(step=1)
    former = signal.getsignal(signal.SIGCONT)
    budget.on_train_start(trainer(), system)
    for passed, woken in ((1.0, False), (3600.0, True), (1.0, False)):
        now[0] += passed
        if woken:
            os.kill(os.getpid(), signal.SIGCONT)
            now[0] += 2.0
        budget.on_train_batch_end(trainer(), system, None, None, 0)
    assert budget.used == 1.0 + 2.0 + 1.0
    budget.teardown(trainer(), system, "fit")
    assert signal.getsignal(signal.SIGCONT) == former

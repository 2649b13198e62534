from types import SimpleNamespace
from unittest.mock import create_autospec

from lightning.pytorch import Trainer

from nerf_lightning.callbacks.time_budget import TimeBudget


def trainer():
    return create_autospec(Trainer, instance=True, max_steps=200_000)


def test_a_resumed_run_takes_up_its_schedule_at_once():
    """The fault: until the next estimate the learning rate would jump back to its start."""
    budget = TimeBudget(seconds=10.0)
    budget.load_state_dict({"used": 5.0})
    system = SimpleNamespace(progress=SimpleNamespace(step=103), num_steps=200_000)
    budget.on_train_start(trainer(), system)
    assert system.num_steps == 206


def test_a_new_run_keeps_its_length_until_its_speed_is_known():
    system = SimpleNamespace(progress=SimpleNamespace(step=0), num_steps=200_000)
    TimeBudget(seconds=10.0).on_train_start(trainer(), system)
    assert system.num_steps == 200_000

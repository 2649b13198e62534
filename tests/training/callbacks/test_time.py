"""Training time is that of the steps: no set-up, no pause; a budget of it ends a run, and days are said."""

import json
import os
import signal
import time
from types import SimpleNamespace
from unittest.mock import create_autospec

import pytest
import torch
from filelock import FileLock
from lightning.pytorch import Trainer

from nerf_lightning.messages.errors import InputError
from nerf_lightning.runs import run_folder as folders
from nerf_lightning.runs.run_folder import RunFolder
from nerf_lightning.training.callbacks import time_budget
from nerf_lightning.training.callbacks.progress_bar import TrainingProgress
from nerf_lightning.training.callbacks.time_budget import Clocked, TimeBudget, TrainingTime
from nerf_lightning.training.launch.trainer import MOST_STEPS


def test_steps_are_counted_and_pauses_are_not(monkeypatch):
    now = [100.0]
    monkeypatch.setattr(time_budget.time, "monotonic", lambda: now[0])
    clock = TrainingTime()
    assert isinstance(clock, Clocked)
    trainer = create_autospec(Trainer, instance=True)
    clock.on_train_start(trainer, None)
    for passed, paused in ((2.0, 0.0), (62.0, 60.0)):
        now[0] += passed
        clock.leave_out(paused)
        clock.on_train_batch_end(trainer, None, None, None, 0)
    now[0] += 30.0
    assert clock.seconds == 4.0


def test_set_up_stands_beside_training_and_a_run_that_goes_on_counts_on(monkeypatch, tmp_path):
    now = [0.0]
    monkeypatch.setattr(folders.time, "monotonic", lambda: now[0])
    (tmp_path / "run.json").write_text("{}")
    for _ in range(2):
        run = RunFolder(tmp_path, FileLock(tmp_path / "lock"), None, began=now[0])
        now[0] += 29.5
        run.trained(20.0)
        now[0] += 5.0
        run.note(finished_at_step=10)
    note = json.loads((tmp_path / "run.json").read_text())
    assert (note["training_seconds"], note["setup_seconds"], note["seconds"]) == (40.0, 19.0, 69.0)


def trainer():
    return create_autospec(Trainer, instance=True, estimated_stepping_batches=200_000)


def a_system(step):
    return SimpleNamespace(train_step=SimpleNamespace(progress=SimpleNamespace(step=step), num_steps=200_000))


def test_a_resumed_run_takes_up_its_schedule_at_once_and_a_new_one_keeps_its_length():
    # The fault: until the next estimate the learning rate would jump back to its start.
    budget = TimeBudget(seconds=10.0)
    budget.load_state_dict({"used": 5.0})
    system = a_system(step=103)
    budget.on_train_start(trainer(), system)
    assert system.train_step.num_steps == 206
    system = a_system(step=0)
    TimeBudget(seconds=10.0).on_train_start(trainer(), system)
    assert system.train_step.num_steps == 200_000


def test_a_run_that_had_no_budget_has_all_of_it_from_where_it_is_gone_on_with(monkeypatch):
    now = [0.0]
    monkeypatch.setattr(time, "perf_counter", lambda: now[0])
    budget, system = TimeBudget(seconds=10.0, every_steps=1), a_system(step=500)
    budget.on_train_start(trainer(), system)
    for step in (501, 502, 503):  # the first is not counted
        now[0] += 1.0
        system.train_step.progress.step = step
        budget.on_train_batch_end(trainer(), system, None, None, 0)
    assert system.train_step.num_steps == 500 + 3 * 10.0 / 2.0
    resumed = TimeBudget(seconds=20.0)
    resumed.load_state_dict(budget.state_dict())
    resumed.on_train_start(trainer(), system)
    assert system.train_step.num_steps == 500 + 3 * 20.0 / 2.0


def test_several_processes_stop_together_and_compare_their_clocks_only_at_times(monkeypatch):
    now, compared = [0.0], []
    monkeypatch.setattr(time, "perf_counter", lambda: now[0])
    monkeypatch.setattr(time_budget.ranks, "world_size", lambda: 2)
    # The other process is a second slower each time.
    monkeypatch.setattr(time_budget.ranks, "largest", lambda used: compared.append(used) or used + 1.0)
    budget, system, run = TimeBudget(seconds=20.0, every_steps=10), a_system(step=0), trainer()
    run.should_stop = False
    budget.on_train_start(run, system)
    stops = []
    for step in range(1, 31):
        now[0] += 1.0
        system.train_step.progress.step = step
        budget.on_train_batch_end(run, system, None, None, 0)
        stops.append(run.should_stop)
    assert compared == [9.0, 20.0, 31.0]
    assert stops.index(True) + 1 == 20
    budget.teardown(run, system, "fit")


@pytest.mark.skipif(not hasattr(signal, "SIGCONT"), reason="no process is stopped there")
def test_a_stopped_process_uses_no_time(monkeypatch):
    now = [100.0]
    monkeypatch.setattr(time, "perf_counter", lambda: now[0])
    budget, system = TimeBudget(seconds=10.0), a_system(step=1)
    former = signal.getsignal(signal.SIGCONT)
    budget.on_train_start(trainer(), system)
    # The first step may compile kernels, and is not counted.
    for passed, woken in ((30.0, False), (1.0, False), (3600.0, True), (1.0, False)):
        now[0] += passed
        if woken:
            os.kill(os.getpid(), signal.SIGCONT)
            now[0] += 2.0
        budget.on_train_batch_end(trainer(), system, None, None, 0)
    assert budget.used == 1.0 + 2.0 + 1.0
    budget.teardown(trainer(), system, "fit")
    assert signal.getsignal(signal.SIGCONT) == former


def lines_of(monkeypatch, caplog, seconds_of_steps, num_steps):
    """Return the lines of a run whose length is `num_steps` after each step; MOST_STEPS is its bound."""
    now = [0.0]
    monkeypatch.setattr(time, "perf_counter", lambda: now[0])
    caplog.set_level("INFO")
    progress, system = TrainingProgress(line_seconds=0.0), a_system(step=0)
    system.train_step.progress.rays_seen = 0
    output = {"step": SimpleNamespace(losses=torch.ones(1), color_errors=torch.ones(1))}
    progress.on_train_start(create_autospec(Trainer, instance=True, global_step=0), system)
    for step, (passed, system.train_step.num_steps) in enumerate(zip(seconds_of_steps, num_steps, strict=True), 1):
        now[0] += passed
        taken = create_autospec(Trainer, instance=True, global_step=step, estimated_stepping_batches=max(num_steps))
        progress.on_train_batch_end(taken, system, output, None, 0)
    return [" ".join(each.split("  ")[i] for i in (0, -1)) for each in caplog.messages]


def test_the_time_left_is_told_after_a_twentieth_of_a_run_and_without_the_first_step(monkeypatch, caplog):
    lines = lines_of(monkeypatch, caplog, [100.0, *[1.0] * 99], [100] * 100)
    assert lines[:3] == [f"step {step}/100 0 rays/s" for step in (2, 3, 4)]
    assert lines[5] == "step 7/100 about 1 min 33 s left"
    assert lines[-1] == "step 100/100 about 0 s left"


def test_a_run_with_a_budget_is_never_at_its_estimated_end(monkeypatch, caplog):
    lines = lines_of(monkeypatch, caplog, [1.0] * 43, [*[MOST_STEPS] * 9, *[42] * 34])
    assert lines[0] == "step 2 0 rays/s"
    assert lines[8] == "step 10/42 about 32 s left"
    assert lines[-2:] == ["step 42/43 about 1 s left", "step 43/44 about 1 s left"]


@pytest.mark.parametrize("seconds", [0.0, float("nan"), float("inf")])
def test_a_budget_that_is_no_time_is_refused(seconds):
    with pytest.raises(InputError, match=f"budget.seconds={seconds}: give a positive time"):
        TimeBudget(seconds)

"""Training time is that of the steps: not what comes before the first and after the last, and no pause."""

import json
from unittest.mock import create_autospec

from filelock import FileLock
from lightning.pytorch import Trainer

from nerf_lightning.commands.train_job.live_view import Clocked
from nerf_lightning.runs import folder as folders
from nerf_lightning.runs.folder import RunFolder
from nerf_lightning.training.callbacks import training_time
from nerf_lightning.training.callbacks.training_time import TrainingTime


def test_steps_are_counted_and_pauses_are_not(monkeypatch):
    now = [100.0]
    monkeypatch.setattr(training_time.time, "monotonic", lambda: now[0])
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
        run.finish(10)
    note = json.loads((tmp_path / "run.json").read_text())
    assert (note["training_seconds"], note["setup_seconds"], note["seconds"]) == (40.0, 19.0, 69.0)

"""Replayed steps that Lightning does not see one by one leave the run that they leave one by one."""

import pytest
import torch
from lightning.pytorch.callbacks import Callback, LambdaCallback
from support.running import FAST, saved
from support.tape import steps_on_tape
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

from nerf_lightning.training import steps_in_a_row
from nerf_lightning.training.callbacks.folder_guard import FolderGuard
from nerf_lightning.training.callbacks.monitor import Monitor

STEPS = 24


@pytest.fixture
def train(nerf, capture, tmp_path):
    """Train with so many steps in a row at most; return the folder, and the steps after which callbacks are called."""

    def run(most, *changes):
        called, folder = [], tmp_path / f"most_{most}"
        with steps_on_tape(), pytest.MonkeyPatch.context() as patch:
            patch.setattr(FolderGuard, "on_train_batch_end", lambda _, trainer, *__: called.append(trainer.global_step))
            patch.setattr(steps_in_a_row, "MOST", most)
            result = nerf(
                "train", "scene=npz", f"scene.path={capture}", *FAST, "data.prefetch=false", "final.evaluate=false",
                "final.video=false", "trainer.precision=32-true", "callbacks.validation_pictures.every_steps=1000",
                f"trainer.max_steps={STEPS}", "trainer.val_every_steps=7",
                "callbacks.checkpoints.every_steps=23", *changes, f"paths.output_dir={folder}",
            )  # fmt: skip
        assert result.code == 0, result.err
        return folder, called

    return run


def rows(folder, name):
    return [(each.step, each.value) for each in EventAccumulator(str(folder / "tensorboard")).Reload().Scalars(name)]


def test_the_run_is_that_of_single_steps_to_the_bit_and_lightning_has_counted_them(train):
    (one, every), (several, some) = train(1), train(16)
    assert every == list(range(1, STEPS + 1))
    # Scalars come after every fifth step, validations after every seventh, a checkpoint after the 23rd.
    assert some == [5, 7, 10, 14, 15, 20, 21, 23, 24]
    ours, theirs = saved(several), saved(one)
    assert ours["global_step"] == STEPS
    assert ours["loops"] == theirs["loops"]
    assert all(torch.equal(ours["state_dict"][name], value) for name, value in theirs["state_dict"].items())
    for name in ("Training loss/sum", "PSNR/validation"):
        assert rows(several, name) == rows(one, name)
        assert len(rows(one, name)) > 2


def test_a_callback_of_somebody_elses_is_called_after_each_step(train, monkeypatch):
    monkeypatch.delattr(FolderGuard, "is_due")
    _, called = train(16)
    assert called == list(range(1, STEPS + 1))


class Impatient(Monitor):
    def on_train_batch_end(self, *given):
        """Does something after each step."""


class Patient(Impatient):
    def is_due(self, trainer, pl_module):
        return False


@pytest.mark.parametrize(
    ("callback", "says"),
    [
        (Callback(), True),
        (Monitor(), True),
        (Impatient(), False),
        (Patient(), True),
        (LambdaCallback(on_train_end=print), True),
        (LambdaCallback(on_train_batch_end=print), False),
    ],
)
def test_who_wrote_what_is_called_after_steps_has_to_say_when_it_acts(callback, says):
    assert steps_in_a_row._says_when(callback) is says


def test_a_row_is_short_where_nobody_looks(train):
    _, called = train(4, "callbacks.monitor.every_steps=12")
    assert called == [4, 7, 10, 12, 14, 18, 20, 21, 23, 24]

"""Numbers that are not finite: the run says where, and stops, or goes back and on at a lower rate."""

import logging
from functools import partial

import pytest
import torch
from lightning.pytorch import Trainer
from support.scenes import ball_scene, tiny_model
from support.steps import rays_of

from nerf_lightning.checkpoints.record import make_record
from nerf_lightning.data.datamodule import RayDataModule
from nerf_lightning.messages.errors import InputError
from nerf_lightning.nerf.losses.mse import MeanSquaredError
from nerf_lightning.nerf.objective import Objective
from nerf_lightning.nerf.optimizers.schedule import ExponentialDecay
from nerf_lightning.nerf.types.progress import Progress
from nerf_lightning.training.attempts import draw_weights
from nerf_lightning.training.callbacks.checkpoints import Checkpoints
from nerf_lightning.training.callbacks.nan_guard import NanGuard
from nerf_lightning.training.launch.checkpoint_io import AtomicCheckpointIO
from nerf_lightning.training.step import TrainStep
from nerf_lightning.training.step_guard import first_not_finite
from nerf_lightning.training.system import RadianceFieldSystem


class BreaksAtStep(MeanSquaredError):
    """The fine level's loss is not a number in some steps, while the learning rate is above a limit."""

    step, until, limit, holder = 0, 0, 0.0, ()  # the holder hides the system, whose part the loss is

    def __call__(self, renderings, target):
        coarse, fine = super().__call__(renderings, target)["color"]
        rate = self.holder[0].optimizers().param_groups[0]["lr"]
        broken = self.step <= self.holder[0].train_step.progress.step < self.until and rate > self.limit
        return {"color": torch.stack([coarse, fine * float("nan") if broken else fine])}


def run(folder, guard, step=12, until=10**6, limit=0.0, max_steps=30, every_steps=5, resume=None, optimizer=None):
    """Train with a rate of 0.01 and no decay, breaking from `step` on while the rate is above `limit`."""
    scene, progress, loss = ball_scene(), Progress(), BreaksAtStep()
    record = make_record(scene, "", {}) | {"precision": "32-true"}
    optimizer = optimizer or partial(torch.optim.Adam, lr=0.01)
    schedule = ExponentialDecay(decay_rate=1.0, decay_steps=1)
    model = tiny_model(density_bias=0.5)
    train_step = TrainStep(Objective(model, rays_of(scene), loss, "white"), optimizer, schedule, progress, 0)
    draw_weights(train_step)
    system = RadianceFieldSystem(train_step, record)
    loss.step, loss.until, loss.limit, loss.holder = step, until, limit, (system,)
    data = RayDataModule(scene, progress, 0, batch_rays=16, crop_steps=3, val_rays=16)
    folder.mkdir(exist_ok=True)
    trainer = Trainer(
        default_root_dir=folder, max_steps=max_steps, max_epochs=-1, accelerator="cpu", logger=False,
        callbacks=[guard, Checkpoints(every_steps=every_steps)], plugins=[AtomicCheckpointIO()],
        enable_checkpointing=False, enable_progress_bar=False, enable_model_summary=False, num_sanity_val_steps=0,
        val_check_interval=max_steps, check_val_every_n_epoch=None,
    )  # fmt: skip
    trainer.fit(system, data, ckpt_path=resume, weights_only=True)
    return system


def last(folder):
    return torch.load(folder / "checkpoints" / "last.ckpt", weights_only=True)


def test_the_run_stops_and_says_step_module_and_last_good_checkpoint(tmp_path):
    with pytest.raises(InputError) as stop:
        run(tmp_path, NanGuard(patience=4))
    message = str(stop.value)
    assert "not finite numbers since step 13 (4 steps in a row" in message
    assert "first in the gradient of levels.fine.field." in message
    assert f"The last good checkpoint is {tmp_path}/checkpoints/last.ckpt" in message
    assert f"resume={tmp_path} callbacks.nan_guard.on_nan=rollback" in message
    assert f"init_from={tmp_path}/checkpoints/last.ckpt" in message
    assert "smaller optimizer.lr" in message
    assert last(tmp_path)["global_step"] == 10


def test_without_a_checkpoint_it_says_so_and_settings_that_make_no_sense_are_refused(tmp_path):
    with pytest.raises(InputError, match="No checkpoint was saved yet: begin anew with a smaller"):
        run(tmp_path, NanGuard(patience=4), step=2)
    for settings, words in (({"factor": 1.5}, "nan_guard.factor=1.5"), ({"patience": 0}, "patience=0")):
        with pytest.raises(InputError, match=words):
            NanGuard(**settings)


def test_a_few_bad_steps_are_left_out_and_no_more(tmp_path, caplog):
    system = run(tmp_path, NanGuard(patience=4), until=15)
    assert system.train_step.guard.state() == [3, 0]
    assert system.trainer.global_step == 30
    assert "Rolled back" not in caplog.text


def test_nothing_is_saved_amid_bad_steps(tmp_path):
    """The 11th step is left out, so the run stays at step 10, at which saves fall due."""
    with pytest.raises(InputError, match="since step 11"):
        run(tmp_path, NanGuard(patience=4), step=10)
    assert last(tmp_path)["nerf_lightning"]["bad_steps"] == [0, 0]
    assert last(tmp_path)["nerf_lightning"]["progress"]["step"] == 10


def test_a_rollback_goes_on_from_the_last_good_checkpoint_as_it_was_saved_at_a_lower_rate(
    tmp_path, caplog, monkeypatch
):
    seen = []
    real = NanGuard._roll_back

    def look(self, trainer, system, good):
        saved = last(tmp_path)
        real(self, trainer, system, good)
        moments = system.optimizers().optimizer.state_dict()["state"]
        assert all(torch.equal(value, saved["state_dict"][key]) for key, value in system.state_dict().items())
        for number, kept in saved["optimizer_states"][0]["state"].items():
            assert all(torch.equal(torch.as_tensor(moments[number][name]), kept[name]) for name in kept)
        seen.append((system.train_step.progress.step, system.train_step.progress.rays_seen))

    monkeypatch.setattr(NanGuard, "_roll_back", look)
    with caplog.at_level(logging.WARNING):
        system = run(tmp_path, NanGuard(on_nan="rollback", patience=4), limit=0.006)
    assert seen == [(10, 160)]
    assert system.trainer.global_step == 30
    progress = system.train_step.progress
    assert (progress.attempt, progress.rollbacks, progress.restarts) == (1, 1, 0)
    assert progress.step == 10 + 30 - 12, "12 steps were taken before it went back to the 10th"
    assert [group["lr"] for group in system.optimizers().param_groups] == [pytest.approx(0.005)]
    assert system.train_step.guard.state() == [4, 0]
    assert first_not_finite(system.train_step.objective.named_weights()) is None
    assert "since step 13" in caplog.text
    assert f"Rolled back to the checkpoint {tmp_path}/checkpoints/last.ckpt" in caplog.text
    assert "attempt 2, rollback 1 of at most 3, base learning rate 0.005" in caplog.text


def test_the_rate_falls_with_every_rollback_and_they_are_counted(tmp_path, caplog):
    with pytest.raises(InputError, match="run stops") as stop:
        run(tmp_path, NanGuard(on_nan="rollback", patience=2, max_rollbacks=3))
    assert "on_nan=rollback" not in str(stop.value), "that has just been tried"
    rates = [message.rpartition(" ")[2] for message in caplog.messages if "Rolled back" in message]
    assert rates == ["0.005.", "0.0025.", "0.00125."], "each time from the same checkpoint, of the full rate"


def test_a_rollback_without_a_checkpoint_begins_anew_at_a_lower_rate(tmp_path, caplog):
    system = run(tmp_path, NanGuard(on_nan="rollback", patience=2), step=2, limit=0.006)
    assert (system.train_step.progress.attempt, system.train_step.progress.rollbacks) == (1, 1)
    assert system.optimizers().param_groups[0]["lr"] == pytest.approx(0.005)
    assert "Rolled back to the beginning, with new weights" in caplog.text


@pytest.mark.filterwarnings("ignore:.*your dataloader is not resumable.*")
def test_a_resume_keeps_the_lowered_rate_and_the_attempt(tmp_path):
    """It stops at the first save after the rollback, which happened after 12 steps."""
    guard = partial(NanGuard, on_nan="rollback", patience=4)
    whole = run(tmp_path / "whole", guard(), limit=0.006)
    run(tmp_path / "parts", guard(), limit=0.006, max_steps=15)
    resumed = run(tmp_path / "parts", guard(), limit=0.006, resume=tmp_path / "parts" / "checkpoints" / "last.ckpt")
    assert resumed.train_step.progress == whole.train_step.progress
    assert resumed.optimizers().param_groups[0]["lr"] == whole.optimizers().param_groups[0]["lr"]
    assert all(torch.equal(value, whole.state_dict()[key]) for key, value in resumed.state_dict().items())


def test_weights_that_are_not_finite_are_noticed_and_never_saved(tmp_path, caplog):
    """The optimizer spoils a weight of the coarse level, whose loss is told nothing of it."""

    class Spoils(torch.optim.Adam):
        def step(self, closure=None):
            super().step(closure)
            if self.param_groups[0]["lr"] > 0.006 and self.state and self.moments() == 13:
                self.param_groups[0]["params"][0].data[0] = float("inf")

        def moments(self):
            return int(next(iter(self.state.values()))["step"])

    guard = NanGuard(on_nan="rollback", patience=50, every_steps=7)
    system = run(tmp_path, guard, step=1000, optimizer=partial(Spoils, lr=0.01), max_steps=25)
    assert "The weights of step 14 are not finite numbers (first those of levels.coarse.field" in caplog.text
    assert first_not_finite(system.train_step.objective.named_weights()) is None
    assert system.train_step.progress.rollbacks == 1

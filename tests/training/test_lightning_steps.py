"""What users of Lightning expect of a module: metrics from validate, test and predict, losses on the bar, any saver."""

import csv
import warnings
from pathlib import Path

import pytest
import torch
from lightning import Callback, Trainer
from lightning.pytorch.callbacks import EarlyStopping, ModelCheckpoint
from lightning.pytorch.callbacks.progress.tqdm_progress import TQDMProgressBar
from lightning.pytorch.loggers import CSVLogger
from support.captures import write_npz
from support.running import FAST
from support.tape import steps_on_tape

import nerf_lightning as nl
from nerf_lightning import RadianceFieldSystem, build_run
from nerf_lightning.evaluation.evaluator import Scoring
from nerf_lightning.nerf.models.render_image import Picture, render_picture
from nerf_lightning.training.launch.trainer import TrainerSettings

pytestmark = pytest.mark.filterwarnings("ignore:Checkpoint directory .* exists")
WATCHED = [each for each in FAST if each.startswith(("model", "data"))]


class Bar(TQDMProgressBar):
    """Lightning's own bar, silent, which remembers what it would show."""

    shown: set[str]

    def on_train_batch_end(self, trainer, pl_module, outputs, batch, batch_idx):
        self.shown = {*getattr(self, "shown", ()), *self.get_metrics(trainer, pl_module)}


class Outputs(Callback):
    def __init__(self):
        self.train, self.val = [], []

    def on_train_batch_end(self, trainer, pl_module, outputs, batch, batch_idx):
        self.train.append(outputs["loss"])

    def on_validation_batch_end(self, trainer, pl_module, outputs, batch, batch_idx, dataloader_idx=0):
        self.val.append(outputs)


def made_run(folder):
    capture = write_npz(folder / "capture.npz")
    return build_run("scene=npz", f"scene.path={capture}", "trainer=cpu", "trainer.precision=32-true", *WATCHED)


def quiet(**settings):
    silent = {"enable_model_summary": False, "enable_progress_bar": False, "logger": False, "log_every_n_steps": 1}
    return Trainer(**({"accelerator": "cpu"} | silent | settings))


def fit(trainer, system, data, **options):
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # Lightning's advice about saving with manual optimization
        trainer.fit(system, data, **options)


@pytest.fixture(scope="module")
def fitted(tmp_path_factory):
    """A run that Lightning's own Trainer has fitted, with Lightning's own logger, bar and callbacks."""
    folder = tmp_path_factory.mktemp("fitted")
    run, bar, outputs = made_run(folder), Bar(), Outputs()
    callbacks = [bar, outputs, EarlyStopping("val/loss"), ModelCheckpoint(monitor="val/psnr", mode="max")]
    logger = CSVLogger(folder)
    shown = {"enable_progress_bar": True, "logger": logger, "callbacks": callbacks}
    trainer = quiet(max_steps=3, val_check_interval=3, default_root_dir=folder, **shown)
    fit(trainer, run.system, run.data)
    return run, trainer, bar, outputs, folder


def test_losses_are_on_the_bar_and_in_lightnings_own_logger_and_validation_returns_and_logs_its_own(fitted):
    run, trainer, bar, outputs, _ = fitted
    assert {"train/loss", "train/psnr"} <= bar.shown
    assert "val/psnr" in trainer.progress_bar_metrics
    rows = list(csv.DictReader((Path(trainer.logger.log_dir) / "metrics.csv").read_text().splitlines()))
    logged = [float(row["train/loss"]) for row in rows if row.get("train/loss")]
    assert logged == pytest.approx([float(loss) for loss in outputs.train])
    assert float(trainer.callback_metrics["train/loss"]) == pytest.approx(logged[-1])
    assert outputs.val
    assert all(float(each["psnr"]) == pytest.approx(-10 * torch.log10(each["loss"]).item()) for each in outputs.val)
    (metrics,) = quiet().validate(run.system, run.data, verbose=False)
    assert metrics["val/psnr"] == pytest.approx(float(trainer.callback_metrics["val/psnr"]))
    assert metrics["val/loss"] == pytest.approx(10 ** (-metrics["val/psnr"] / 10))


def test_the_test_is_that_of_nerf_eval_and_rays_alone_are_no_picture_to_test(fitted, tmp_path):
    run, *_ = fitted
    (metrics,) = quiet().test(run.system, run.data, verbose=False)
    with torch.no_grad():
        ours = Scoring().score(run.system.model, run.scene, run.scene.background, 8192, tmp_path)
    assert metrics["test/psnr"] == pytest.approx(ours["psnr"], abs=1e-4)
    assert metrics["test/cc_psnr"] == pytest.approx(ours["cc_psnr"], abs=1e-4)
    with pytest.raises(nl.InputError, match=r"whole views.*datamodule=run\.data"):
        quiet().test(run.system, dataloaders=run.data.val_dataloader(), verbose=False)


def test_predictions_are_pictures_of_the_test_views(fitted):
    run, *_ = fitted
    pictures = quiet().predict(run.system, run.data)
    views = run.scene.splits["test"]
    assert len(pictures) == len(views)
    assert all(isinstance(picture, Picture) for picture in pictures)
    own = render_picture(run.system.model.eval(), run.system.rays, views[0], run.scene.background, 8192)
    assert torch.equal(pictures[0].rgb, own.rgb)


@pytest.mark.parametrize("weights_only", [False, True])
def test_what_a_plain_trainer_saves_is_opened(fitted, weights_only):
    run, trainer, _, _, folder = fitted
    path = folder / f"saved_{weights_only}.ckpt"
    trainer.save_checkpoint(path, weights_only=weights_only)
    with torch.no_grad():
        expected = run.system.model.eval().state_dict()
    assert all(torch.equal(value, expected[name]) for name, value in nl.load(path).module.state_dict().items())
    loaded = RadianceFieldSystem.load_from_checkpoint(path)
    (metrics,) = quiet().test(loaded, run.data, verbose=False)
    assert metrics["test/psnr"] > 0


def test_what_a_subclass_of_somebody_saves_is_opened(tmp_path):
    class Theirs(RadianceFieldSystem):
        def __init__(self, step, record, note="mine"):
            super().__init__(step, record)
            self.save_hyperparameters("note")

    other = made_run(tmp_path)
    system = Theirs(other.system.train_step, other.system.record)
    trainer = quiet(max_steps=1, default_root_dir=tmp_path)
    fit(trainer, system, other.data)
    trainer.save_checkpoint(tmp_path / "theirs.ckpt")
    assert nl.load(tmp_path / "theirs.ckpt").checkpoint.step == 1
    longer, again = quiet(max_steps=2, default_root_dir=tmp_path), made_run(tmp_path)
    theirs = Theirs(again.system.train_step, again.system.record)
    fit(longer, theirs, again.data, ckpt_path=tmp_path / "theirs.ckpt")
    assert longer.global_step == 2


class Hooks(Callback):
    def __init__(self):
        self.updates = self.backwards = 0

    def on_before_optimizer_step(self, trainer, pl_module, optimizer):
        self.updates += 1

    def on_after_backward(self, trainer, pl_module):
        self.backwards += 1


def test_steps_of_a_trainer_of_ones_own_are_replayed(tmp_path):
    losses = []
    for records in (False, True):
        outputs, hooks = Outputs(), Hooks()
        with steps_on_tape() as replays, pytest.MonkeyPatch.context() as patch:
            patch.setattr(TrainerSettings, "records", lambda settings, train_step, records=records: records)
            run = made_run(tmp_path)
            more = {"callbacks": [outputs, hooks], "enable_checkpointing": False}
            fit(quiet(max_steps=4, limit_val_batches=0, **more), run.system, run.data)
        assert len(replays) == 4 * records
        assert (hooks.updates, hooks.backwards > 0) == (4, not records)
        assert not run.system.train_step.gradients.replays  # a system can be copied
        losses.append(torch.stack(outputs.train))
    assert torch.equal(*losses)

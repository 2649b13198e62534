"""Lightning's own Trainer trains our module and our data, resumes to the bit, and its checkpoints can be used."""

import csv
import subprocess
import sys
import warnings
from pathlib import Path

import pytest
import torch
from hydra.core.global_hydra import GlobalHydra
from hydra.initialize import initialize_config_dir
from lightning import Callback, Trainer
from lightning.pytorch.callbacks import (
    BatchSizeFinder,
    GradientAccumulationScheduler,
    LearningRateFinder,
    ModelCheckpoint,
    ModelPruning,
)
from lightning.pytorch.loggers import CSVLogger
from lightning.pytorch.strategies import SingleDeviceStrategy
from support.captures import write_npz
from support.configs import composed, options
from support.running import FAST, FAST_PATH, refused

import nerf_lightning
from nerf_lightning import RadianceFieldSystem, build_run
from nerf_lightning.checkpoints.reading import read_checkpoint
from nerf_lightning.config.hydra_versions import DEFAULTS
from nerf_lightning.config.instantiate import build
from nerf_lightning.files.folders import conf_folder
from nerf_lightning.messages.errors import InputError
from nerf_lightning.training.callbacks.checkpoints import Checkpoints
from nerf_lightning.training.callbacks.nan_guard import NanGuard
from nerf_lightning.training.callbacks.time_budget import TimeBudget
from nerf_lightning.training.launch.checkpoint_io import AtomicCheckpointIO

pytestmark = [
    # Lightning's advice to whoever trains twice below one folder, or saves within an epoch.
    pytest.mark.filterwarnings("ignore:Checkpoint directory .* exists"),
    pytest.mark.filterwarnings("ignore:Using ModelCheckpoint with manual optimization"),
]
RAYS_OF_AN_EPOCH = 8 * 24  # eight of the ten pictures of 6 x 4 pixels train
STEPS_OF_AN_EPOCH = 6  # of 32 rays each
LAST_LEVELS = "model.levels.fine.field.position_encoder.level_weights"


@pytest.fixture
def capture(tmp_path):
    return write_npz(tmp_path / "capture.npz")


@pytest.fixture
def run(capture):
    def make(*overrides):
        return build_run(
            "scene=npz", f"scene.path={capture}", "model=nerf_tiny", "trainer=cpu", "trainer.precision=32-true",
            "data.batch_rays=32", "data.crop_steps=0", "data.val_rays=32", *overrides,
        )  # fmt: skip

    return make


@pytest.fixture
def trainer(tmp_path):
    def make(**settings):
        quiet = {"enable_progress_bar": False, "enable_model_summary": False, "logger": False}
        return Trainer(**({"accelerator": "cpu", "default_root_dir": tmp_path / "root"} | quiet | settings))

    return make


@pytest.fixture
def saved(run, trainer):
    """Two steps of a run have been taken; return it, and the checkpoint that Lightning wrote of it."""
    one, first = run(), trainer(max_steps=2)
    first.fit(one.system, one.data)
    return one, kept(first)


def kept(trainer):
    """Where Lightning's own ModelCheckpoint has left its file."""
    return trainer.checkpoint_callback.best_model_path


def whole_and_resumed(make, trainer, stop, steps):
    """A run that was never stopped, one that goes on from where a third has stopped, and the file of that."""
    whole, begun, rest = make(), make(), make()
    trainer(max_steps=steps).fit(whole.system, whole.data)
    first = trainer(max_steps=stop)
    first.fit(begun.system, begun.data)
    trainer(max_steps=steps).fit(rest.system, rest.data, ckpt_path=kept(first))
    return whole, rest, kept(first)


def assert_equal(ours, theirs):
    ours, theirs = ours.system, theirs.system
    for name, value in theirs.state_dict().items():
        assert torch.equal(ours.state_dict()[name], value), name
    ours, theirs = ours.optimizers().optimizer.state_dict(), theirs.optimizers().optimizer.state_dict()
    assert ours["param_groups"] == theirs["param_groups"]
    for number, moments in theirs["state"].items():
        for name, value in moments.items():
            assert torch.equal(torch.as_tensor(ours["state"][number][name]), torch.as_tensor(value)), name


class Lengths(Callback):
    """Remember the learning rates, which say how long the run is taken to be."""

    def __init__(self):
        self.rates = []

    def on_train_batch_end(self, trainer, pl_module, outputs, batch, batch_idx):
        self.rates.append(pl_module.optimizers().param_groups[0]["lr"])


def test_what_the_package_offers_is_loaded_when_it_is_asked_for():
    code = "import sys, nerf_lightning; print([m for m in ('torch', 'lightning', 'hydra') if m in sys.modules])"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "[]"
    assert {"RadianceFieldSystem", "RayDataModule", "build_run", "__version__"} <= set(dir(nerf_lightning))
    assert all(hasattr(package, name) for package in (nerf_lightning, nerf_lightning.nerf) for name in dir(package))
    with pytest.raises(AttributeError, match="no attribute 'build_runs'"):
        _ = nerf_lightning.build_runs


def test_a_run_has_the_settings_of_nerf_train(run, capture):
    made = run("optimizer.lr=0.002", "seed=3")
    assert made.system.configure_optimizers().param_groups[0]["lr"] == 0.002
    assert made.system.train_step.seed == 3
    assert made.data.scene.view_names == made.scene.view_names
    assert made.system.record["choices"]["model"] == "nerf_tiny"
    assert "batch_rays: 32" in made.system.record["config"]


def test_whoever_uses_hydra_keeps_it(run):
    with initialize_config_dir(str(conf_folder()), **DEFAULTS):
        theirs = GlobalHydra.instance().hydra
        run()
        assert GlobalHydra.instance().hydra is theirs
    run()


@pytest.mark.parametrize(
    ("overrides", "parts"),
    [
        (["optimizer.lrr=1"], ("optimizer.lr",)),
        (["model=nerff"], ("nerff",)),
        (["trainer.max_steps=7"], ("trainer.max_steps=7", "Trainer(max_steps=...)")),
        (["callbacks.monitor.every_steps=7"], ("callbacks.monitor.every_steps=7", "Trainer(callbacks=[...])")),
        (["+trainer.lightning.profiler=simple"], ("trainer.lightning.profiler", "Lightning's Trainer")),
        (["resume=auto"], ("resume=auto", "ckpt_path")),
    ],
)
def test_what_makes_no_run_is_told_in_words(run, overrides, parts):
    refused(run, *overrides, parts=parts)


def test_a_number_of_steps_is_the_length_of_the_run(run, trainer):
    one, lengths = run(), Lengths()
    fit = trainer(max_steps=10, callbacks=[lengths])
    fit.fit(one.system, one.data)
    assert (fit.global_step, one.system.train_step.progress.step, one.system.train_step.num_steps) == (10, 10, 10)
    assert lengths.rates == pytest.approx([5e-4 * 0.1 ** (step / 10) for step in range(10)])
    assert fit.callback_metrics["val/psnr"] > 0


@pytest.mark.parametrize(
    ("settings", "steps"),
    [
        ({"max_epochs": 2}, 2 * STEPS_OF_AN_EPOCH),
        ({"max_epochs": 2, "max_steps": 9}, 9),
        ({"max_epochs": 3, "limit_train_batches": 4}, 12),
        ({"fast_dev_run": 3}, 3),
    ],
)
def test_an_epoch_is_every_training_ray_once(run, trainer, settings, steps):
    one = run()
    assert len(one.data.batches.whole) == RAYS_OF_AN_EPOCH
    fit = trainer(**settings)
    fit.fit(one.system, one.data)
    assert (one.system.train_step.progress.step, one.system.train_step.num_steps) == (steps, steps)


def test_runs_without_end_and_on_several_devices_without_a_strategy_that_adds_once_are_refused(
    run, trainer, monkeypatch
):
    one = run()
    refused(trainer(max_steps=-1, max_epochs=-1).fit, one.system, one.data, parts=("max_steps", "max_epochs"))
    # Lightning's own adds them up in each tile's backward, and takes their mean.
    one, fit = run(), trainer(max_steps=2)
    monkeypatch.setattr(Trainer, "world_size", 2)
    parts = ("several devices", "trainer=ddp", "strategy=OneSumPerStep()")
    refused(fit.fit, one.system, one.data, parts=parts)


def test_lightnings_look_before_training_is_no_validation(run, trainer, tmp_path):
    one, logger = run(), CSVLogger(tmp_path)
    trainer(max_steps=4, num_sanity_val_steps=1, logger=logger, log_every_n_steps=1).fit(one.system, one.data)
    rows = list(csv.DictReader((Path(logger.log_dir) / "metrics.csv").read_text().splitlines()))
    assert [row["step"] for row in rows if row["val/psnr"]] == ["4"]


@pytest.mark.parametrize(
    ("settings", "parts"),
    [
        ({"precision": "bf16-mixed"}, ("precision=bf16-mixed", "trainer.precision=bf16-mixed")),
        ({"precision": "64-true"}, ("precision=64-true", "32-true, tf32, bf16-mixed")),
        ({"overfit_batches": 1}, ("overfit_batches=1", "scene.frames")),
        ({"gradient_clip_val": 0.5}, ("gradient_clip_val=0.5", "trainer.clip_norm=0.5")),
        ({"accumulate_grad_batches": 2}, ("accumulate_grad_batches", "data.batch_rays")),
        ({"callbacks": [GradientAccumulationScheduler({0: 2})]}, ("GradientAccumulationScheduler", "data.batch_rays")),
        ({"callbacks": [BatchSizeFinder()]}, ("BatchSizeFinder", "data.batch_rays")),
        ({"callbacks": [LearningRateFinder()]}, ("LearningRateFinder", "optimizer.lr")),
        ({"callbacks": [ModelPruning("l1_unstructured", amount=0.1)]}, ("ModelPruning", "model=fast_small")),
    ],
)
def test_what_would_be_computed_otherwise_than_it_says_is_refused(run, trainer, settings, parts):
    one = run()
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        refused(trainer(max_steps=2, **settings).fit, one.system, one.data, parts=parts)


def test_what_a_gpu_sums_in_any_order_is_not_called_deterministic(run, trainer, monkeypatch):
    monkeypatch.setattr(SingleDeviceStrategy, "root_device", torch.device("cuda"))
    try:
        one, fit = run(*FAST_PATH), trainer(max_steps=2, deterministic=True)
        refused(fit.fit, one.system, one.data, parts=("deterministic=True", "model=nerf"))
    finally:
        torch.use_deterministic_algorithms(False)


@pytest.mark.parametrize("settings", [(), FAST_PATH, ("field.batch_norm=true",), ("loss=robust", "loss.patch=4")])
def test_a_run_goes_on_from_the_checkpoint_that_lightning_wrote(run, trainer, settings):
    whole, rest, found = whole_and_resumed(lambda: run(*settings, "scheduler=constant"), trainer, stop=12, steps=24)
    assert found.endswith("step=12.ckpt")
    assert rest.system.train_step.progress.step == 24
    assert_equal(rest, whole)
    if "loss=robust" in settings:
        assert 0 < float(whole.system.state_dict()["loss.threshold"]) < 1


def test_cameras_and_levels_that_are_on_their_way_go_on_too(run, trainer):
    learning = (*FAST_PATH, "refinement=se3_lens", "encoder.blend_in=0.8")
    whole, rest = run(*learning), run(*learning)
    saves = ModelCheckpoint(every_n_train_steps=5, save_top_k=-1)
    trainer(max_steps=12, callbacks=[saves]).fit(whole.system, whole.data)
    found = next(Path(saves.dirpath).glob("*step=5.ckpt"))
    assert 0.0 < float(torch.load(found, weights_only=True)["state_dict"][LAST_LEVELS][-2]) < 1.0
    saves = ModelCheckpoint(every_n_train_steps=5, save_top_k=-1)
    trainer(max_steps=12, callbacks=[saves]).fit(rest.system, rest.data, ckpt_path=found)
    assert float(rest.system.rays.refinement.rotation.detach().abs().max()) > 0
    assert_equal(rest, whole)
    refined = read_checkpoint(found).scene.cameras
    assert not torch.equal(refined.c2w, rest.scene.cameras.c2w)
    assert not torch.equal(refined.focal, rest.scene.cameras.focal)


@pytest.mark.parametrize("option", [each for each in options("correction") if each not in ("auto", "none")])
def test_a_run_with_a_correction_goes_on_to_the_bit(run, trainer, option):
    def corrected():
        return run(f"correction={option}", "scheduler=constant")

    whole, rest, found = whole_and_resumed(corrected, trainer, stop=4, steps=8)
    assert_equal(rest, whole)
    names = [name for name in whole.system.state_dict() if name.startswith("correction.")]
    assert names
    loaded = RadianceFieldSystem.load_from_checkpoint(found)
    assert not [name for name in loaded.state_dict() if name.startswith("correction.")]


def test_checkpoints_of_other_runs_programs_and_strangers_are_refused(run, trainer, saved, tmp_path):
    _, found = saved
    other = run("field=nerf_mlp_small")
    with pytest.raises(InputError, match=r"state_dict\..*Training cannot go on"):
        trainer(max_steps=4).fit(other.system, other.data, ckpt_path=found)
    content = torch.load(found, weights_only=True)
    del content["nerf_lightning"]
    torch.save(content, tmp_path / "other.ckpt")
    again = run()
    with pytest.raises(InputError, match="not a checkpoint of nerf_lightning"):
        trainer(max_steps=4).fit(again.system, again.data, ckpt_path=tmp_path / "other.ckpt")
    damaged = bytearray(Path(saved[1]).read_bytes())
    damaged[len(damaged) // 2] ^= 1  # which Lightning's own reader does not notice
    (tmp_path / "damaged.ckpt").write_bytes(damaged)
    with pytest.raises(InputError, match="wrong checksum"):
        trainer(max_steps=4).fit(again.system, again.data, ckpt_path=tmp_path / "damaged.ckpt")
    content = torch.load(saved[1], weights_only=True)
    content["nerf_lightning"]["config"] = "model: {_target_: os.system, command: touch here}"
    torch.save(content, tmp_path / "stranger.ckpt")
    refused(RadianceFieldSystem.load_from_checkpoint, tmp_path / "stranger.ckpt", parts=("os.system",))
    refused(RadianceFieldSystem.load_from_checkpoint, tmp_path / "missing.ckpt", parts=("no checkpoint at",))


def test_what_was_fitted_loaded_or_belongs_to_another_run_is_not_fitted(run, trainer, saved):
    one, found = saved
    loaded = RadianceFieldSystem.load_from_checkpoint(found)
    for system, data, parts in (
        (one.system, one.data, ("2 steps", "ckpt_path", "build_run")),
        (loaded, run().data, ("loaded from a checkpoint", "build_run", "ckpt_path")),
        (run().system, run().data, ("same run",)),
    ):
        refused(trainer(max_steps=4).fit, system, data, parts=parts)


def test_the_callbacks_of_nerf_train_work_there_too(run, trainer, capture, tmp_path):
    chosen = composed("train", "scene=npz", f"scene.path={capture}", *FAST).callbacks
    watching = [each for each in build(chosen).values() if not isinstance(each, (Checkpoints, NanGuard))]
    one = run()
    fit = trainer(max_epochs=2, callbacks=[*watching, TimeBudget(60.0)], enable_progress_bar=True)
    fit.fit(one.system, one.data)
    assert one.system.train_step.progress.step == 2 * STEPS_OF_AN_EPOCH
    assert (tmp_path / "root" / "images" / "validation" / "step_0000012.png").is_file()  # after the last step


@pytest.mark.parametrize("callback", [Checkpoints, NanGuard])
def test_a_callback_that_needs_our_writer_says_so(run, trainer, callback, tmp_path):
    one = run()
    parts = (callback.__name__, "plugins=[AtomicCheckpointIO()]", "ModelCheckpoint")
    refused(trainer(max_steps=2, callbacks=[callback()]).fit, one.system, one.data, parts=parts)
    (tmp_path / "root").mkdir(exist_ok=True)
    again = run()
    settings = {"plugins": [AtomicCheckpointIO()], "enable_checkpointing": False}
    with_writer = [callback()] if callback is Checkpoints else [callback(), Checkpoints()]
    trainer(max_steps=2, callbacks=with_writer, **settings).fit(again.system, again.data)
    assert read_checkpoint(tmp_path / "root" / "checkpoints" / "last.ckpt").step == 2

"""Runs that are trained step by step: guarded, saved, resumed to the bit, rendered on the way."""

import json
from dataclasses import replace
from functools import partial

import numpy as np
import pytest
import torch
from lightning import Trainer
from support.orbit import LENS, SIZE, orbit_cameras, orbit_masks, orbit_scene
from support.running import FAST, FAST_PATH, refused

import nerf_lightning as nl
from nerf_lightning.nerf.types.rays import KnownDepths, PixelIndex
from nerf_lightning.notebook import run as notebook_run
from nerf_lightning.training.callbacks import nan_guard

SMALL = ("model=nerf_tiny", "trainer=cpu", "data.batch_rays=64", "data.crop_steps=3")


@pytest.fixture(params=[False, True], ids=["radial_tangential", "fisheye"])
def scene(request):
    return orbit_scene(orbit_cameras(distortion=torch.tensor(LENS), fisheye=request.param), masks=orbit_masks(6, SIZE))


@pytest.fixture
def pinholes():
    return orbit_scene()


@pytest.fixture
def trainer(tmp_path):
    def make(steps):
        quiet = {"enable_progress_bar": False, "enable_model_summary": False, "logger": False}
        return Trainer(max_steps=steps, accelerator="cpu", default_root_dir=tmp_path / "root", **quiet)

    return make


def weights(run):
    return run.system.state_dict()


def equal(one, other):
    torch.testing.assert_close(one, other, rtol=0, atol=0)
    return True


@pytest.mark.parametrize("settings", [SMALL, ("trainer=cpu", *FAST_PATH)], ids=["dense", "ragged"])
def test_a_resumed_run_has_the_weights_of_one_that_never_stopped(settings, scene, tmp_path):
    whole, file = nl.build_run(*settings, scene=scene), tmp_path / "saved.ckpt"
    for metrics in whole.steps(6):
        assert metrics.keys() == {"step", "loss", "psnr", "num_rays"}
        if metrics["step"] == 2:
            whole.save(file)
            whole.model.render(0)  # leaves no trace
    rest = nl.build_run(*settings, scene=scene, resume=file)
    assert rest.num_steps == 2
    assert [metrics["step"] for metrics in rest.steps(6)] == [3, 4, 5, 6]
    assert equal(weights(whole), weights(rest))
    assert equal(whole.optimizer.state_dict()["state"], rest.optimizer.state_dict()["state"])


def test_a_run_goes_on_with_the_depths_that_it_has_learned_from(pinholes, tmp_path):
    at, view = torch.arange(8), torch.tensor(pinholes.splits["train"][:1]).expand(8)
    depths, file = KnownDepths(PixelIndex(view, at, at), torch.ones(8), torch.ones(8)), tmp_path / "a.ckpt"
    one, other = (replace(pinholes, depths=replace(depths, distance=depths.distance * n)) for n in (1, 2))
    for loss in ("mse", "depth"):
        run = nl.build_run(*SMALL, f"loss={loss}", scene=one)
        next(run.steps(1))
        run.save(file)
        again = partial(nl.build_run, *SMALL, f"loss={loss}", scene=other, resume=file)
        if loss == "mse":
            assert again().num_steps == 1
    refused(again, parts=("the depths (of sparse points or depth maps) of 1 of 6 photographs",))


@pytest.mark.filterwarnings("ignore:Checkpoint directory", "ignore:Using ModelCheckpoint", "ignore:Be aware")
def test_lightnings_trainer_takes_the_same_steps_and_either_goes_on_from_the_others_file(pinholes, trainer, tmp_path):
    def begin(**more):
        return nl.build_run(*SMALL, "scheduler=constant", scene=pinholes, **more)

    ours, theirs, file = begin(), begin(), tmp_path / "ours.ckpt"
    for metrics in ours.steps(6):
        if metrics["step"] == 3:
            ours.save(file)
    fit = trainer(6)
    fit.fit(theirs.system, theirs.data)
    assert equal(weights(ours), weights(theirs))
    refused(theirs.save, tmp_path / "not.ckpt", parts=("Trainer", "save_checkpoint"))
    later = begin()
    trainer(6).fit(later.system, later.data, ckpt_path=file, weights_only=True)
    assert equal(weights(ours), weights(later))
    half, last = begin(), trainer(3)
    last.fit(half.system, half.data)
    last.save_checkpoint(tmp_path / "theirs.ckpt", weights_only=False)
    rest = begin(resume=tmp_path / "theirs.ckpt")
    list(rest.steps(6))
    assert equal(weights(ours), weights(rest))


def test_the_file_is_a_checkpoint_and_cameras_are_the_users_own(scene, tmp_path):
    run = nl.build_run(*SMALL, scene=scene)
    list(run.steps(2))
    run.save(tmp_path / "run.ckpt")
    loaded = nl.load(tmp_path / "run.ckpt", "trainer=cpu")
    camera = orbit_cameras(distortion=torch.tensor(LENS), fisheye=scene.cameras.lens_model == "fisheye")[4]
    view, seen = run.model.render(4), loaded.render(camera)
    torch.testing.assert_close(seen.rgb, view.rgb, rtol=0, atol=1e-3)
    torch.testing.assert_close(loaded.render("view_0004").depth, view.depth)
    unit = float(torch.linalg.det(scene.to_user[:3, :3])) ** (1 / 3)
    assert float(view.depth.max()) <= unit * float(scene.far.max()) * (1 + 1e-5)
    assert float(view.depth.max()) > float(scene.far.max())
    torch.testing.assert_close(loaded.path(num_frames=2).c2w.norm(dim=1).mean(dim=0)[:3], torch.ones(3).double())


def test_the_guards_restart_a_collapsed_run_and_end_a_broken_one(pinholes, monkeypatch):
    run = nl.build_run(*SMALL, scene=pinholes)
    guard = run.collapse_guard
    guard.every_steps, guard.patience, guard.ratio = 1, 2, 1e9
    counted = [(metrics["step"], run.system.train_step.progress.attempt) for metrics in run.steps(5)]
    assert counted == [(1, 0), (2, 1), (3, 1), (4, 2), (5, 2)]
    broken = nl.build_run(*SMALL, scene=pinholes)
    broken.nan_guard.patience = 3
    for module in (nan_guard, notebook_run):
        monkeypatch.setattr(module, "first_not_finite", lambda named: "fine.field")
    broken.nan_guard.every_steps = 2
    refused(lambda: list(broken.steps(9)), parts=("step 2", "fine.field", "run stops", "optimizer.lr"))
    refused(broken.save, "never.ckpt", parts=("fine.field", "not saved"))


@pytest.mark.parametrize("override", ["scene=bricks", "scene.near=1"])
def test_a_scene_is_given_or_named_and_not_both(override, pinholes):
    refused(lambda: nl.build_run(*SMALL, override, scene=pinholes), parts=(override, "given"))


def test_a_whole_training_of_a_given_scene_without_validation_and_test_views(pinholes, tmp_path):
    folder, small = f"paths.output_dir={tmp_path / 'run'}", (*FAST, "trainer=cpu", "final.video=false")
    run = nl.train(folder, *small, scene=pinholes)
    assert (run.metrics, run.psnr) == ({}, None)
    assert json.loads((tmp_path / "run" / "run.json").read_text())["finished_at_step"] == 4
    assert np.isfinite(run.model.render(0).rgb.numpy()).all()
    longer = nl.train(f"resume={tmp_path / 'run'}", "trainer.max_steps=6", scene=pinholes)
    assert longer.model.checkpoint.step == 6
    refused(nl.train, f"resume={tmp_path / 'run'}", parts=("given from Python", "scene=scene"))

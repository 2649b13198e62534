"""Parts of one's own, in files outside of the package: trained with, and opened again by whoever trusts them."""

import shlex
from pathlib import Path

import pytest
from support import extensions
from support.planted import in_config, write_checkpoint
from support.running import FAST, NO_LAYOUT, done, refused, said

from nerf_lightning.checkpoints.reading import read_checkpoint
from nerf_lightning.commands.train_job.fit import resume_command
from nerf_lightning.config.compose import composed_job
from nerf_lightning.config.load_model import load_model

MODULE = "support.extensions.voxel_model"
SEARCHED = f"hydra.searchpath=[file://{Path(extensions.__file__).parent / 'conf'}]"
VOXELS = ("model=voxels", "model.resolution=8", "sampler@model.sampler=stratified_16")


def test_yamls_of_ones_own_are_found_where_the_model_is_left_open(nerf, capture, tmp_path):
    """The fault: the config was composed again without them, once the model was chosen."""
    where = f"--config-dir={Path(extensions.__file__).parent / 'conf'}"
    scene = ("scene=npz", f"scene.path={capture}", f"paths.output_dir={tmp_path}/run")
    small = ("encoder.first.log2_table_size=8", "data.batch_rays=64", "trainer.max_steps=2", "trainer.tile_points=8192")
    small += (NO_LAYOUT, "data.val_rays=64", "model.levels.fine.sampler.resolution=16")
    done(nerf("train", where, *scene, *small, "encoder=joined", "final.video=false", "final.evaluate=false"))


@pytest.fixture
def own_run(nerf, capture, tmp_path):
    run = tmp_path / "run"
    fast = [each for each in FAST if not each.startswith("model=")]
    scene = ("scene=npz", f"scene.path={capture}")
    left = done(nerf("train", SEARCHED, *scene, *fast, *VOXELS, "final.video=false", f"paths.output_dir={run}"))
    return run, left.out + left.err


def test_what_is_ones_own_is_told_at_the_start_and_opened_where_it_is_trusted(nerf, own_run, tmp_path):
    run, output = own_run
    assert f"commands that open its checkpoints need trust={MODULE}" in " ".join(output.split())
    assert f"view ckpt={run} trust={MODULE}\n" in output
    said(nerf("eval", f"ckpt={run}"), "VoxelModel", f"If it is your own, add trust={MODULE};")
    where = f"paths.output_dir={tmp_path}/out"
    measured = done(nerf("eval", f"ckpt={run}", f"trust={MODULE}", "evaluation.max_views=1", where))
    assert "dB" in measured.out
    done(nerf("export", f"ckpt={run}", "what=images", "what.max_views=1", "trust=[support]", where))
    said(nerf("render", f"ckpt={run}", "trust=no such module"), "trust=no such module", "a Python module")


def test_where_ones_own_yamls_and_modules_lie_is_said_or_asked_for(tmp_path):
    with composed_job("train", [SEARCHED, "model=voxels"]):
        assert resume_command(Path("run")) == f"nerf train resume=run {shlex.quote(SEARCHED)}"
    elsewhere = {"_target_": "gone.VoxelModel"}
    file = write_checkpoint(tmp_path / "a.ckpt", in_config(lambda config: config.update(model=elsewhere)))
    refused(load_model, read_checkpoint(file), ["gone"], parts=("gone.VoxelModel", "PYTHONPATH=FOLDER"))

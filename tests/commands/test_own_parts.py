"""Parts of one's own, in files outside of the package: trained with, and opened again by whoever trusts them."""

from pathlib import Path

import pytest
from support import extensions
from support.planted import in_config, write_checkpoint
from support.running import FAST, refused, said

from nerf_lightning.checkpoints.reading import read_checkpoint
from nerf_lightning.config.load_model import load_model

MODULE = "support.extensions.voxel_model"
SEARCHED = f"hydra.searchpath=[file://{Path(extensions.__file__).parent / 'conf'}]"
VOXELS = ("model=voxels", "model.resolution=8", "sampler@model.sampler=stratified_16")


@pytest.fixture
def own_run(nerf, capture, tmp_path):
    run = tmp_path / "run"
    fast = [each for each in FAST if not each.startswith("model=")]
    scene = ("scene=npz", f"scene.path={capture}")
    done = nerf("train", SEARCHED, *scene, *fast, *VOXELS, "final.video=false", f"paths.output_dir={run}")
    assert done.code == 0, done.err
    return run, done.out + done.err


def test_what_is_ones_own_is_told_at_the_start_and_opened_where_it_is_trusted(nerf, own_run, tmp_path):
    run, output = own_run
    assert f"builds them only with trust={MODULE}" in " ".join(output.split())
    said(nerf("eval", f"ckpt={run}"), "VoxelModel", f"If it is your own, add trust={MODULE};")
    measured = nerf(
        "eval", f"ckpt={run}", f"trust={MODULE}", "evaluation.max_views=1", f"paths.output_dir={tmp_path}/m"
    )
    assert measured.code == 0, measured.err
    assert "dB" in measured.out
    points = nerf(
        "export",
        f"ckpt={run}",
        "what=points",
        "what.num_points=50",
        "what.max_views=1",
        "trust=[support]",
        f"paths.output_dir={tmp_path}/p",
    )
    assert points.code == 0, points.err
    said(nerf("render", f"ckpt={run}", "trust=no such module"), "trust=no such module", "a Python module")


def test_a_module_that_python_does_not_find_is_told(tmp_path):
    elsewhere = {"_target_": "gone.VoxelModel"}
    file = write_checkpoint(tmp_path / "a.ckpt", in_config(lambda config: config.update(model=elsewhere)))
    refused(load_model, read_checkpoint(file), ["gone"], parts=("gone.VoxelModel", "PYTHONPATH=FOLDER"))

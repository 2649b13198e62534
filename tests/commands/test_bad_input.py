"""What a person reads when the input is bad: one paragraph that names the thing and the cure, exit code 2."""

import pytest
import torch
from support.posed_captures import Known, write_colmap
from support.running import FAST, said

from nerf_lightning.checkpoints.format import FORMAT


@pytest.fixture
def last(finished_run):
    return finished_run / "checkpoints" / "last.ckpt"


def test_files_that_are_no_checkpoint_to_use_are_named(nerf, last, tmp_path):
    for command in ("eval", "render"):
        missing = nerf(command, f"ckpt={tmp_path}/none.ckpt")
        said(missing, "There is no checkpoint at", "none.ckpt", "last.ckpt or best.ckpt")
    (tmp_path / "cut.ckpt").write_bytes(last.read_bytes()[:5000])
    said(nerf("render", f"ckpt={tmp_path}/cut.ckpt"), "cut.ckpt is damaged", "train again")
    content = torch.load(last, weights_only=True)
    content["nerf_lightning"]["format"] = 99
    torch.save(content, tmp_path / "changed.ckpt")
    path = f"ckpt={tmp_path}/changed.ckpt"
    said(nerf("render", path), "has checkpoint format 99", f"reads format {FORMAT}", "Use the version that wrote it")
    torch.save({"state_dict": {}}, tmp_path / "other.ckpt")
    said(nerf("render", f"ckpt={tmp_path}/other.ckpt"), "not a checkpoint of nerf_lightning")
    said(nerf("export", "what=cameras", "ckpt=[1]"), "is not valid: it must be a path")


def test_weights_that_do_not_fit(train, last):
    said(train("field.width=48", f"init_from={last}", "trainer.max_steps=1"), "size mismatch", "overrides.yaml")


def test_an_output_folder_that_cannot_be_written(nerf, last, capture, tmp_path):
    (tmp_path / "file").write_text("")
    for command in (("train", "scene=npz", f"scene.path={capture}", *FAST), ("eval", f"ckpt={last}")):
        said(nerf(*command, f"paths.output_dir={tmp_path}/file/run"), "cannot be written", "paths.output_dir=DIR")


@pytest.mark.parametrize(
    ("override", "words"),
    [
        ("scene.near=7.0", "near"),
        ("scene.near=close", "scene.near=close is not valid: it must be a number"),
        ("trainer.precision=16-mixed", "it must be auto, 32-true, tf32, bf16-mixed"),
        ("callbacks.validation_pictures.every_steps=0", "every_steps=0: give 1 or more"),
        ("path=photographs path.views=-1", "path.views=-1 is not valid: it must be a list or null"),
        ("path=keyframes path.file=none.yaml", "none.yaml does not exist"),
        ("evaluation.max_views=0", "evaluation.max_views=0"),
        ("model.levels.coarse.sampler.num_samples=2", "at least 3 samples"),
        ("data.batch_rays=0", "data.batch_rays=0"),
        ("init_from=nowhere.ckpt", "There is no checkpoint at nowhere.ckpt"),
        ("trainer.max_epochs=inf", "trainer.max_epochs=inf: give a positive number up to"),
        ("scene._target_=5", "See nerf train --help"),
        ("trainer.num_threads=0", "trainer.num_threads=0: give a number from 1 to 4096"),
        ("trainer.devices=1000000000", "trainer.devices=1000000000: give a number from 1 to 1024"),
        ("model.levels.coarse.field=-1", "model.levels.coarse.field=-1 is not valid: it must be a Field, chosen by"),
        ("optimizer.lr=-1", "The optimizer refuses its settings: Invalid learning rate: -1. Fix optimizer.*"),
        ("callbacks.monitor=5", "callbacks.monitor=5 is not a callback. To remove one, add ~callbacks.monitor."),
        ("budget=null", "budget=None is not valid: it holds settings, such as budget.seconds=VALUE"),
        ("data.batch_rays=1000000000000", "data.batch_rays=1000000000000, which takes"),
        ("scene.far=1e300", "scene.near=2.0 and scene.far=1e+300: rays need 0 <= near < far <= 1e+09"),
        ("loss=robust loss.patch=32 data.batch_rays=1024", "loss.patch=32 draws squares of 32 x 32 pixels"),
        ("loss=robust loss.patch=4 data.batch_rays=40", "data.batch_rays=40 is not a multiple of that. Give"),
        ("loss=robust loss.share=0", "share=0: give 0.01 to 1.0"),
        ("model=fast_small data.crop_steps=0 encoder.log2_table_size=30 encoder.max_resolution=9999", "GiB"),
        ("model=fast_small data.sample_budget=100 data.crop_steps=5", "data.sample_budget=100"),
        ("model=fast_small data.crop_steps=0 encoder.log2_table_size=34", "log2_table_size=34"),
        (
            "model=fast_small data.crop_steps=0 encoder@direction_encoder=hash_grid",
            "directions do not lie in the unit cube",
        ),
        ("field=null", "A group was given something other than the name of one of its options"),
    ],
)
def test_a_bad_setting_is_named_before_a_folder_is_taken(train, tmp_path, override, words):
    said(train(*override.split()), words)
    assert not (tmp_path / "run").exists()


def test_no_ffmpeg_is_said_before_the_training(train, tmp_path, monkeypatch):
    monkeypatch.setenv("IMAGEIO_FFMPEG_EXE", str(tmp_path / "none"))
    said(train(), "ffmpeg")
    assert not (tmp_path / "run").exists()


def test_transparent_pictures_need_a_background(nerf, tmp_path):
    small = ("scene.resolution=4", "scene.num_train=1", "scene.num_val=1", "scene.num_test=1")
    where = (f"scene.cache_dir={tmp_path}", f"paths.output_dir={tmp_path}/run")
    result = nerf("train", *small, *where, "scene.background=none", *FAST)
    said(result, "transparent pixels", "scene.background=none", "white, black or random")


def test_a_part_that_is_not_found_says_where_python_looks_and_a_misnamed_one_of_ours_that_there_is_none(nerf, capture):
    given = ("train", "scene=npz", f"scene.path={capture}", "model=nerf_tiny")
    result = nerf(*given, "loss._target_=my_losses.L1")
    said(result, "loss cannot be built: No module named 'my_losses'", "PYTHONPATH=FOLDER before nerf train")
    said(nerf(*given, "loss._target_=nerf_lightning.nerf.losses.mse.L1"), "has no such class or function")


def test_a_broken_capture_is_one_paragraph_and_leaves_nothing(nerf, tmp_path):
    """That each broken file of each format is named with its cure: tests/data/readers/test_malformed.py."""
    path = write_colmap(tmp_path / "capture", Known()) / "sparse" / "0" / "images.bin"
    path.write_bytes(path.read_bytes()[:100])
    where = (f"scene.root={tmp_path}/capture", f"scene.cache_dir={tmp_path}/cache", f"paths.output_dir={tmp_path}/run")
    result = nerf("train", "scene=colmap", *where, *FAST)
    said(result, "images.bin cannot be read", "has 100 bytes", "nerf poses images=DIR")
    assert not (tmp_path / "run").exists()
    assert not list(tmp_path.rglob("*.pixels"))


def test_a_setting_that_the_chosen_part_does_not_have_names_what_removes_it(nerf):
    result = nerf("train", "experiment=lego_article", "scene=bricks")
    said(result, "scene.downscale is set, but the chosen scene has no such setting", "remove it with ~scene.downscale")

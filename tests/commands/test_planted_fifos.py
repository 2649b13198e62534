"""An archive can carry FIFOs: in no folder that is read does the program wait for one."""

import logging
import os
from pathlib import Path

import numpy as np
import pytest
from support.captures import write_blender
from support.malformed import WRITERS
from support.measured_runs import leave_measured_run
from support.posed_captures import read
from support.running import said
from support.waiting import fifo, within

from nerf_lightning.data.bricks.reader import BricksReader
from nerf_lightning.data.readers.blender import BlenderReader
from nerf_lightning.data.readers.npz import NpzReader
from nerf_lightning.data.sfm.photograph_folder import find_photographs
from nerf_lightning.data.sfm.video_frames import require_video
from nerf_lightning.evaluation.lpips import load_lpips
from nerf_lightning.files.tensor_files import load_tensors
from nerf_lightning.files.yaml_files import read_plain_yaml
from nerf_lightning.messages.errors import InputError
from nerf_lightning.report.curves import read_curves
from nerf_lightning.report.embedding import embedded_file, embedded_video
from nerf_lightning.runs.folder import log_file
from nerf_lightning.runs.sweep_job import read_records

pytestmark = pytest.mark.skipif(os.name != "posix", reason="FIFOs are posix's")
SECONDS = 20


@pytest.mark.parametrize("name", ["run.json", "metrics.json", ".hydra/hydra.yaml", ".hydra/overrides.yaml"])
def test_a_table_leaves_them_out(table, tmp_path, name):
    for run in "ab":
        leave_measured_run(tmp_path / "runs" / run, overrides=(f"model={run}",))
    fifo(tmp_path / "runs" / "a" / name)
    with within(SECONDS):
        result, rows = table("published=false", "force=true")
    assert result.code == 0, result.err
    assert rows


@pytest.mark.parametrize("name", ["run.json", "metrics.json", ".hydra/config.yaml", "images/validation/step_1.png"])
def test_a_report_leaves_them_out(nerf, tmp_path, name):
    run = leave_measured_run(tmp_path / "run")
    fifo(run / name)
    with within(SECONDS):
        result = nerf("report", run)
    if name == "run.json":
        said(result, "no run.json")
    else:
        assert result.code == 0, result.err


def test_a_log_is_not_written_into_one(tmp_path):
    fifo(tmp_path / "train.log")
    with within(SECONDS), pytest.raises(InputError, match=r"train\.log is a named pipe"), log_file(tmp_path):
        logging.getLogger().warning("a line")


def test_curves_are_not_read_from_one(tmp_path):
    fifo(tmp_path / "events.out.tfevents.1")
    (tmp_path / "events.out.tfevents.2").touch()
    with within(SECONDS), pytest.raises(InputError, match=r"tfevents\.1 is a named pipe"):
        read_curves(tmp_path)


def test_a_record_of_a_job_is_not_read_from_one(tmp_path):
    fifo(tmp_path / ".hydra" / "jobs" / "0.json")
    with within(SECONDS), pytest.raises(InputError, match=r"0\.json is a named pipe"):
        read_records(tmp_path)


FILES = {
    "llff": ("images/p_3.png", "poses_bounds.npy"),
    "colmap": ("images/p_3.png", "sparse/0/cameras.bin", "sparse/0/images.bin", "sparse/0/points3D.bin"),
    "text": ("sparse/0/cameras.txt", "sparse/0/images.txt", "sparse/0/points3D.txt"),
    "transforms": ("images/p_3.png", "transforms.json"),
}


@pytest.mark.parametrize(("kind", "name"), [(kind, name) for kind, names in FILES.items() for name in names])
def test_a_capture_with_one_is_refused_or_read_without_it(tmp_path, caplog, kind, name):
    root = WRITERS[kind](tmp_path / "capture")
    fifo(root / name)
    with within(SECONDS):
        if name != "images/p_3.png":
            with pytest.raises(InputError, match=Path(name).name.partition(".")[0]):
                read("colmap" if kind == "text" else kind, root)
        else:
            assert len(read("colmap" if kind == "text" else kind, root).view_names) == 8
            assert "p_3.png" in caplog.text


def test_a_blender_capture_with_one_is_refused_or_read_without_it(tmp_path):
    root = write_blender(tmp_path / "capture", {"train": 3, "val": 1, "test": 1})
    fifo(root / "train" / "r_1.png")
    with within(SECONDS):
        assert len(BlenderReader(str(root)).read().view_names) == 4
    fifo(root / "transforms_train.json")
    with within(SECONDS), pytest.raises(InputError, match="transforms_train"):
        BlenderReader(str(root)).read()


def test_masks_that_are_one_are_refused(tmp_path):
    root = WRITERS["llff"](tmp_path / "capture")
    for number in range(20):
        fifo(root / "masks" / f"p_{number}.png")
    with within(SECONDS), pytest.raises(InputError, match=r"p_0\.png"):
        read("llff", root, masks="masks")


@pytest.mark.parametrize(
    "open_",
    [
        lambda path: NpzReader(str(path)).read(),
        lambda path: load_lpips(str(path)),
        load_tensors,
        read_plain_yaml,
        require_video,
        embedded_file,
        lambda path: embedded_video(path, 1000),
    ],
    ids=["npz", "lpips", "tensors", "yaml", "video", "picture in a report", "film in a report"],
)
def test_other_files_that_are_one_are_refused(tmp_path, open_):
    with within(SECONDS), pytest.raises(InputError, match=r"it\.npz"):
        open_(fifo(tmp_path / "it.npz"))


def test_photographs_that_are_one_are_refused(tmp_path):
    for number in range(3):
        fifo(tmp_path / f"{number}.jpg")
    with within(SECONDS), pytest.raises(InputError, match=r"0\.jpg is a named pipe"):
        find_photographs(tmp_path)


def test_a_cache_with_one_is_made_anew(tmp_path):
    small = BricksReader(resolution=8, num_train=1, num_val=0, num_test=0, cache_dir=str(tmp_path / "cache"))
    first = small.read()
    (path,) = (tmp_path / "cache").glob("*.npz")
    fifo(path)
    with within(SECONDS):
        assert np.array_equal(small.read().pixels.rgba, first.pixels.rgba)


@pytest.mark.parametrize("ending", [".json", ".pixels"])
def test_kept_photographs_that_are_one_are_read_anew(tmp_path, ending):
    root = WRITERS["llff"](tmp_path / "capture")
    first = read("llff", root)
    (path,) = (tmp_path / "cache").glob(f"*{ending}")
    fifo(path)
    with within(SECONDS):
        assert np.array_equal(read("llff", root).pixels.rgba, first.pixels.rgba)

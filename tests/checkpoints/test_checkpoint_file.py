"""A checkpoint file is whole at every moment, the one before stays, and what goes wrong is said."""

import os

import pytest
import torch
from lightning.pytorch import Trainer

from nerf_lightning.checkpoints.writing import write_checkpoint
from nerf_lightning.files.atomic import MACHINE
from nerf_lightning.messages.errors import InputError
from nerf_lightning.training.callbacks.checkpoints import Checkpoints
from nerf_lightning.training.launch.checkpoint_io import AtomicCheckpointIO


def steps(folder):
    return {path.name: torch.load(path, weights_only=True)["step"] for path in sorted(folder.iterdir())}


def test_the_last_two_are_kept_also_where_files_cannot_be_linked(tmp_path, monkeypatch):
    def refuse(*names):
        raise OSError(1, "Operation not permitted")

    for step in (1, 2, 3):
        write_checkpoint({"step": step}, tmp_path / "last.ckpt")
        write_checkpoint({"step": 10 * step}, tmp_path / "best.ckpt")
    assert steps(tmp_path) == {"best.ckpt": 30, "last.ckpt": 3, "previous.ckpt": 2}
    monkeypatch.setattr(os, "link", refuse)
    for step in (4, 5):
        write_checkpoint({"step": step}, tmp_path / "last.ckpt")
    assert steps(tmp_path) == {"best.ckpt": 30, "last.ckpt": 5, "previous.ckpt": 4}


def test_what_a_killed_writer_left_goes_also_where_no_step_is_left(tmp_path):
    trainer = Trainer(
        default_root_dir=tmp_path, plugins=[AtomicCheckpointIO()], enable_checkpointing=False, logger=False
    )
    Checkpoints().setup(trainer, None, "fit")  # no folder yet
    (tmp_path / "checkpoints").mkdir()
    (tmp_path / "checkpoints" / f".best.999999999_{MACHINE}.nerf_lightning.part.ckpt").write_text("half")
    (tmp_path / "checkpoints" / "best.ckpt").write_text("whole")
    Checkpoints().setup(trainer, None, "fit")
    assert [path.name for path in (tmp_path / "checkpoints").iterdir()] == ["best.ckpt"]


@pytest.mark.parametrize("function", ["fsync", "unlink", "link", "replace"])
def test_whatever_fails_the_former_one_is_there(tmp_path, monkeypatch, function):
    for step in (1, 2):
        write_checkpoint({"step": step}, tmp_path / "last.ckpt")
    real, calls = getattr(os, function), []

    def fails_once(*arguments, **options):
        calls.append(1)
        if len(calls) == 1:
            raise OSError(5, "Input/output error")
        return real(*arguments, **options)

    monkeypatch.setattr(os, function, fails_once)
    try:
        write_checkpoint({"step": 3}, tmp_path / "last.ckpt")
    except InputError:
        assert steps(tmp_path)["last.ckpt"] == 2
    else:
        assert steps(tmp_path) == {"last.ckpt": 3, "previous.ckpt": 2}


def test_a_save_that_fails_says_where_and_how_to_go_on(tmp_path, monkeypatch):
    def full(handle):
        raise OSError(28, "No space left on device")

    (tmp_path / "other").mkdir()
    last = tmp_path / "other" / "checkpoints" / "last.ckpt"
    write_checkpoint({"step": 1}, last)
    (tmp_path / "run").write_text("a file")
    with pytest.raises(InputError, match=r"run/checkpoints is writable, then continue with resume="):
        write_checkpoint({"a": 1}, tmp_path / "run" / "checkpoints" / "last.ckpt")
    monkeypatch.setattr(os, "fsync", full)
    with pytest.raises(
        InputError, match=r"No space left on device.*last\.ckpt is intact\. Free some space, then continue"
    ):
        write_checkpoint({"step": 2}, last)
    assert steps(last.parent) == {"last.ckpt": 1}


def test_a_run_folder_that_is_gone_does_not_come_back(tmp_path):
    with pytest.raises(InputError, match=r"could not be saved: .*No such file"):
        write_checkpoint({"a": 1}, tmp_path / "run" / "checkpoints" / "last.ckpt")
    assert not (tmp_path / "run").exists()

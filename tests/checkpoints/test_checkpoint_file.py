"""A checkpoint file is whole at every moment, the one before stays, and what goes wrong is said."""

import os

import pytest
import torch
from lightning.pytorch import Trainer
from support.running import start_code
from support.systems import POSIX

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


@pytest.mark.minutes
@POSIX
def test_a_full_disk_leaves_the_former_checkpoint(tmp_path):
    """A real limit on the size of files, in a process of its own."""
    path = tmp_path / "checkpoints" / "last.ckpt"
    write_checkpoint({"step": 1}, path)
    code = (
        "import resource, signal, torch, sys, pathlib\n"
        "from nerf_lightning.checkpoints.writing import write_checkpoint\n"
        "from nerf_lightning.messages.errors import InputError\n"
        "signal.signal(signal.SIGXFSZ, signal.SIG_IGN)\n"
        "resource.setrlimit(resource.RLIMIT_FSIZE, (50_000, 50_000))\n"
        "try:\n"
        f"    write_checkpoint({{'step': torch.zeros(1_000_000)}}, pathlib.Path({str(path)!r}))\n"
        "except InputError as error:\n"
        "    print(error); sys.exit(2)\n"
    )
    process = start_code(code)
    output, errors = process.communicate(timeout=300)
    assert process.returncode == 2, errors
    assert "could not be saved" in output
    assert f"The previous checkpoint {path} is intact" in output
    assert steps(path.parent) == {"last.ckpt": 1}


def test_a_save_that_fails_says_where_and_how_to_go_on(tmp_path, monkeypatch):
    def full(handle):
        raise OSError(28, "No space left on device")

    (tmp_path / "run").write_text("a file")
    with pytest.raises(InputError, match=r"run/checkpoints is writable, then continue with resume="):
        write_checkpoint({"a": 1}, tmp_path / "run" / "checkpoints" / "last.ckpt")
    monkeypatch.setattr(os, "fsync", full)
    (tmp_path / "other").mkdir()
    with pytest.raises(InputError, match=r"No space left on device.*Free some space, then continue with resume="):
        write_checkpoint({"a": 1}, tmp_path / "other" / "checkpoints" / "last.ckpt")


def test_what_a_killed_process_left_is_swept_and_a_persons_file_stays(tmp_path):
    folder = tmp_path / "checkpoints"
    folder.mkdir()
    for name in (f".last.999999999_{MACHINE}.nerf_lightning.part.ckpt", ".mine.ckpt.123.tmp"):
        (folder / name).write_text("half")
    write_checkpoint({"a": 1}, folder / "last.ckpt")
    assert {file.name for file in folder.iterdir()} == {"last.ckpt", ".mine.ckpt.123.tmp"}


def test_a_run_folder_that_is_gone_does_not_come_back(tmp_path):
    with pytest.raises(InputError, match=r"could not be saved: .*No such file"):
        write_checkpoint({"a": 1}, tmp_path / "run" / "checkpoints" / "last.ckpt")
    assert not (tmp_path / "run").exists()

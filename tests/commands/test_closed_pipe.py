"""Readers that leave before the end, and disks that are full."""

import os
import subprocess
from pathlib import Path

import pytest
from support.running import start

from nerf_lightning.cli.process import ends_quietly
from nerf_lightning.messages.exit_codes import READER_LEFT


def unread(*arguments, buffered=True, merged=False):
    """Run a command whose reader left before the first word; return its exit code and what stderr says."""
    ours, theirs = os.pipe()
    os.close(ours)
    process = begin(*arguments, stdout=theirs, stderr=theirs if merged else subprocess.PIPE, buffered=buffered)
    os.close(theirs)
    _, told = process.communicate(timeout=300)
    return process.returncode, told


def begin(*arguments, buffered=True, **streams):
    return start(*arguments, env={"PYTHONUNBUFFERED": "" if buffered else "1"}, **streams)


@pytest.mark.parametrize(("arguments", "buffered"), [(["--version"], False), (["eval", "--cfg", "job"], True)])
def test_help_that_nobody_reads_to_its_end_says_nothing(arguments, buffered):
    assert unread(*arguments, buffered=buffered) == (READER_LEFT, "")
    assert unread(*arguments, buffered=buffered, merged=True)[0] == READER_LEFT


def test_a_command_that_nobody_reads_ends_without_a_word(capture, tmp_path):
    code, told = unread("doctor", "scene=npz", f"scene.path={capture}", f"paths.output_dir={tmp_path}/out")
    assert code == READER_LEFT, told
    assert "Traceback" not in told
    assert "Broken pipe" not in told


def test_bad_input_is_told_though_nobody_reads_stdout():
    assert unread("trian")[1].startswith("nerf: There is no command 'trian'.")


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="needs a disk that is always full")
@pytest.mark.parametrize("buffered", [True, False])
def test_a_full_disk_is_told_once(buffered):
    with open("/dev/full", "w") as full:
        process = begin("train", "--help", stdout=full, stderr=subprocess.PIPE, buffered=buffered)
        _, told = process.communicate(timeout=300)
    assert process.returncode == 2
    assert told.startswith("nerf: No space left on device.")
    assert len(told.splitlines()) == 1


def test_another_pipe_that_breaks_is_an_error_and_exit_codes_pass():
    with pytest.raises(BrokenPipeError), ends_quietly():
        raise BrokenPipeError(32, "the encoder has ended")
    with pytest.raises(SystemExit, match=r"^3$"), ends_quietly():
        raise SystemExit(3)

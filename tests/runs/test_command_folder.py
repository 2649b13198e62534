"""A run's folder vanishes where a command is refused before it writes; every start adds to its train.log."""

import errno
import logging

import pytest
from support.running import refused, start_code
from support.systems import POSIX

from nerf_lightning.messages.errors import InputError
from nerf_lightning.runs import command_folder
from nerf_lightning.runs.command_folder import filled_folder
from nerf_lightning.runs.run_folder import log_file


@pytest.fixture(autouse=True)
def no_sweep(monkeypatch):
    monkeypatch.setattr(command_folder, "job_folder", lambda: None)


def begun(wanted):
    with filled_folder(str(wanted), wanted) as folder:
        assert folder.is_dir()
        raise InputError("refused")


def test_what_was_made_and_stays_empty_is_removed_and_what_holds_something_or_was_there_stays(tmp_path):
    there = tmp_path / "there"
    there.mkdir()
    refused(begun, there / "a" / "b", parts=("refused",))
    assert list(there.iterdir()) == []
    with filled_folder(None, tmp_path / "a" / "b") as folder:
        (folder / "written").write_text("")
    assert (tmp_path / "a" / "b" / "written").is_file()
    with filled_folder(str(tmp_path), tmp_path):
        pass
    assert tmp_path.is_dir()


def test_a_full_disk_is_said_of_the_folder(tmp_path):
    with pytest.raises(OSError, match=r"No space left on device: '.*/out'"), filled_folder(None, tmp_path / "out"):
        raise OSError(errno.ENOSPC, "No space left on device")


def test_every_start_adds_its_lines(tmp_path):
    for word in ("first", "second\x1b[2J\nERROR"):
        with log_file(tmp_path):
            logging.getLogger("a.b").warning("the %s start", word)
    logging.getLogger("a.b").warning("after it")
    first, second = (tmp_path / "train.log").read_text(encoding="utf-8").splitlines()
    assert first.endswith(" WARNING a.b: the first start")
    assert second.endswith(r" WARNING a.b: the second\x1b[2J\nERROR start")


FULL = """
import logging, pathlib, resource, signal, sys
from nerf_lightning.runs.run_folder import log_file
signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
resource.setrlimit(resource.RLIMIT_FSIZE, (60, 60))
with log_file(pathlib.Path(sys.argv[1])):
    for number in range(5):
        logging.warning("line %d", number)
print("went on")
"""


@POSIX
def test_a_full_disk_costs_lines_alone(tmp_path):
    process = start_code(FULL, str(tmp_path))
    output, errors = process.communicate(timeout=300)
    assert (process.returncode, output, errors) == (0, "went on\n", "")
    assert (tmp_path / "train.log").stat().st_size == 60

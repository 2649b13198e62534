"""A folder is made for what is written, and vanishes where a command is refused before it writes."""

import errno

import pytest
from support.running import refused

from nerf_lightning.messages.errors import InputError
from nerf_lightning.runs import output_folder
from nerf_lightning.runs.output_folder import filled_folder


@pytest.fixture(autouse=True)
def no_sweep(monkeypatch):
    monkeypatch.setattr(output_folder, "job_folder", lambda: None)


def begun(wanted):
    with filled_folder(str(wanted), wanted) as folder:
        assert folder.is_dir()
        raise InputError("refused")


def test_what_was_made_and_stays_empty_is_removed(tmp_path):
    there = tmp_path / "there"
    there.mkdir()
    refused(begun, there / "a" / "b", parts=("refused",))
    assert list(there.iterdir()) == []


def test_what_holds_something_stays(tmp_path):
    with filled_folder(None, tmp_path / "a" / "b") as folder:
        (folder / "written").write_text("")
    assert (tmp_path / "a" / "b" / "written").is_file()


def test_an_empty_folder_that_was_there_stays(tmp_path):
    with filled_folder(str(tmp_path), tmp_path):
        pass
    assert tmp_path.is_dir()


def test_a_full_disk_is_said_of_the_folder(tmp_path):
    with pytest.raises(OSError, match=r"No space left on device: '.*/out'"), filled_folder(None, tmp_path / "out"):
        raise OSError(errno.ENOSPC, "No space left on device")

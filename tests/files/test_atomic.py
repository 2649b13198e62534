"""Files that are whole or not there, and what processes that were killed leave of them."""

import errno
import os
import sys

import pytest
from support.running import start_code

from nerf_lightning.files import atomic
from nerf_lightning.files.atomic import NO_ROOM, full_disk_named, whole_file

LEFT = f".a.999999999_{atomic.MACHINE}.nerf_lightning.part.txt"  # of no process
KILLED = """
import os, signal, sys
from pathlib import Path
from nerf_lightning.files.atomic import whole_file

with whole_file(Path(sys.argv[1])) as part:
    part.write_text("half")
    os.kill(os.getpid(), signal.SIGKILL)
"""


@pytest.mark.skipif(atomic.fcntl is None, reason="files have no owners there that could be asked for")
def test_what_killed_processes_left_is_removed(tmp_path):
    for name in ("video.mp4", "video.mp4", "metrics.json"):
        with start_code(KILLED, tmp_path / name) as process:
            assert process.wait() == -9
    assert len(list(tmp_path.iterdir())) in (1, 2)  # each removes what was left before
    with whole_file(tmp_path / "other.txt") as part:
        part.write_text("whole")
    assert [file.name for file in tmp_path.iterdir()] == ["other.txt"]


def test_what_is_being_written_stays(tmp_path):
    with whole_file(tmp_path / "a.txt") as ours:
        ours.write_text("whole")
        atomic.remove_leftovers.cache_clear()  # as another process
        with whole_file(tmp_path / "b.txt") as theirs:
            theirs.write_text("whole")
    assert sorted(file.name for file in tmp_path.iterdir()) == ["a.txt", "b.txt"]


def test_what_a_person_has_beside_it_stays(tmp_path):
    kept = (".notes.part.txt", "a.12.part.txt", ".profile", ".12.party", ".holiday.2024.part.zip", ".backup.001.part")
    kept += (".thesis.3.part.docx", ".a.12.nerf_lightning.part.txt", ".nerf_lightning.part")
    for name in kept:
        (tmp_path / name).write_text("mine")
    (tmp_path / LEFT).mkdir()
    with whole_file(tmp_path / "a.txt") as part:
        part.write_text("whole")
    assert {file.name for file in tmp_path.iterdir()} == {*kept, LEFT, "a.txt"}


def test_a_failed_block_leaves_what_was_there_and_its_error_names_the_file(tmp_path):
    (tmp_path / "a.txt").write_text("former")
    with pytest.raises(OSError, match=r"No space left on device: .*/a.txt"):
        write_half(tmp_path / "a.txt")
    assert [file.read_text() for file in tmp_path.iterdir()] == ["former"]
    with pytest.raises(OSError, match="broken") as caught, whole_file(tmp_path / "a.txt"):
        raise OSError(errno.EIO, "broken")
    assert caught.value.filename == str(tmp_path / "a.txt")
    with pytest.raises(ConnectionRefusedError) as caught:
        fail_in(tmp_path, ConnectionRefusedError(errno.ECONNREFUSED, "refused"))
    assert caught.value.filename is None


def test_a_file_that_another_process_has_open_is_replaced_once_it_is_closed(tmp_path, monkeypatch):
    """On Windows, where it is not permitted until then."""
    waits, replace = [], os.replace

    def refuse_twice(part, path):
        if len(waits) < 2:
            raise PermissionError(errno.EACCES, "Access is denied", str(path))
        replace(part, path)

    monkeypatch.setattr(atomic.time, "sleep", waits.append)
    monkeypatch.setattr(os, "replace", refuse_twice)
    with whole_file(tmp_path / "a.txt") as part:
        part.write_text("whole")
    assert [file.read_text() for file in tmp_path.iterdir()] == ["whole"]
    assert len(waits) == 2


def write_half(path):
    with whole_file(path) as part:
        part.write_text("half")
        raise OSError(errno.ENOSPC, "No space left on device")


@pytest.mark.parametrize("number", NO_ROOM)
def test_a_full_disk_is_said_of_what_is_written(tmp_path, number):
    cases = {
        (): tmp_path,  # something was written, and nobody knows what
        (str(tmp_path / "a"),): tmp_path / "a",
        ("read.jpg", None, str(tmp_path / "copy.jpg")): tmp_path / "copy.jpg",
    }
    for names, said in cases.items():
        with pytest.raises(OSError, match="full") as caught:
            fail_in(tmp_path, OSError(number, "full", *names))
        assert (caught.value.filename, caught.value.filename2) == (str(said), None)


def fail_in(folder, error):
    with full_disk_named(folder):
        raise error


@pytest.mark.skipif(sys.platform == "win32", reason="symbolic links need rights there")
def test_no_link_is_written_through(tmp_path):
    (tmp_path / "precious").write_text("precious")
    (tmp_path / "a.txt").symlink_to(tmp_path / "precious")
    with whole_file(tmp_path / "a.txt") as part:
        part.write_text("first")
    part.symlink_to(tmp_path / "precious")
    with whole_file(tmp_path / "a.txt") as part:
        part.write_text("second")
    assert (tmp_path / "precious").read_text() == "precious"
    assert (tmp_path / "a.txt").read_text() == "second"

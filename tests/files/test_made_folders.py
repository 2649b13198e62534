"""Folders are made and emptied in one place, which takes nothing of somebody else's."""

import ast
import sys

import pytest
from support.running import refused

from nerf_lightning.files.folders import PACKAGE
from nerf_lightning.files.made_folders import (
    LOCK,
    MARK,
    ScratchFolder,
    child_of,
    empty_ours,
    make_folder,
    make_ours,
    remove_empty,
)

links = pytest.mark.skipif(sys.platform == "win32", reason="symbolic links need rights there")

CHANGES = {"mkdir", "makedirs", "rmdir", "removedirs", "rmtree", "unlink", "mkdtemp"}
OF_OS = {"remove"}  # lists have one, too
ALLOWED = {
    "files/made_folders.py": {"mkdir", "rmdir", "rmtree", "unlink"},
    "files/atomic.py": {"unlink"},  # of temporary files that nobody holds, and its own
    "nerf/kernels/backends.py": {"makedirs"},  # the same; this part imports nothing of the program
    "data/pixels/mapped_store.py": {"unlink"},  # of a header in a cache, before its pixels are replaced
    "checkpoints/writing.py": {"mkdir", "unlink"},  # no run folder that is gone; of a checkpoint in its own folder
    "runs/sweep.py": {"unlink"},  # of records of jobs, by their names
    "video/paths/recorded_path.py": {"unlink"},  # of a file that it has just made
}


def files():
    return (file for file in PACKAGE.rglob("*.py") if "tests" not in file.relative_to(PACKAGE).parts)


def test_nothing_else_makes_or_removes_folders_or_removes_files():
    found = {}
    for file in sorted(files()):
        for node in ast.walk(ast.parse(file.read_text(encoding="utf-8"))):
            if isinstance(node, ast.Call) and isinstance(node.func, ast.Attribute):
                name, of = node.func.attr, getattr(node.func.value, "id", None)
                if name in CHANGES or (name in OF_OS and of == "os"):
                    found.setdefault(file.relative_to(PACKAGE).as_posix(), set()).add(name)
    assert found == ALLOWED


@links
def test_below_a_named_folder_nothing_is_reached_through_a_link(tmp_path):
    (tmp_path / "disk" / "a").mkdir(parents=True)
    (tmp_path / "named").symlink_to(tmp_path / "disk")
    assert make_folder(tmp_path / "named", "a", "b").is_dir()
    (tmp_path / "disk" / "a" / "link").symlink_to("b")
    (tmp_path / "disk" / "nowhere").symlink_to("nothing")
    for names in (("a", "link"), ("a", "link", "c"), ("nowhere",)):
        for call in (child_of, make_folder, make_ours):
            refused(call, tmp_path / "named", *names, parts=("is a symbolic link to", "Remove the link"))
    assert [path.name for path in (tmp_path / "disk" / "a").iterdir()] in (["b", "link"], ["link", "b"])
    assert list((tmp_path / "disk" / "a" / "b").iterdir()) == []


def test_what_is_ours_is_emptied_and_what_is_not_stays(tmp_path):
    (tmp_path / "theirs").mkdir()
    (tmp_path / "theirs" / "frame_1.png").touch()
    refused(make_ours, tmp_path, "theirs", parts=(f"{tmp_path}/theirs holds frame_1.png, not made by this program",))
    empty_ours(tmp_path / "theirs")
    assert [path.name for path in (tmp_path / "theirs").iterdir()] == ["frame_1.png"]
    ours = make_ours(tmp_path, "theirs", files="*.exr")
    for name in ("frame_1.exr", "frame_2.exr", LOCK):
        (ours / name).touch()
    empty_ours(make_ours(tmp_path, "theirs", files="*.exr"), "*.exr")
    assert {path.name for path in ours.iterdir()} == {"frame_1.png", LOCK, MARK}
    empty_ours(ours)
    assert {path.name for path in ours.iterdir()} == {LOCK, MARK}


@links
def test_links_in_a_folder_of_ours_go_and_what_they_lead_to_stays(tmp_path):
    ours, thesis = make_ours(tmp_path, "ours"), make_folder(tmp_path, "thesis")
    (thesis / "1.tex").touch()
    (ours / "folder").symlink_to(thesis)
    (ours / "file").symlink_to(thesis / "1.tex")
    (make_folder(ours, "deep") / "folder").symlink_to(thesis)
    empty_ours(ours)
    assert [path.name for path in ours.iterdir()] == [MARK]
    (tmp_path / "link").symlink_to(ours)
    (ours / "more").touch()
    empty_ours(tmp_path / "link")
    assert (ours / "more").exists()
    assert (thesis / "1.tex").exists()


def test_a_scratch_folder_is_held_by_one_and_vanishes(tmp_path):
    one, other = (ScratchFolder(tmp_path / "out", ".part", "works") for _ in range(2))
    one.hold()
    (one.path / "half").touch()
    refused(other.hold, parts=(f"{tmp_path}/out is in use by another process that works there",))
    one.release()
    other.hold()
    assert (other.path / "half").exists()
    other.remove()
    assert list((tmp_path / "out").iterdir()) == []


def test_a_new_folder_is_nobody_elses_and_only_empty_ones_are_removed(tmp_path):
    (tmp_path / "theirs").mkdir()
    with pytest.raises(FileExistsError):
        make_folder(tmp_path, "theirs", new=True)
    make_folder(tmp_path, "a", "new", new=True)
    (tmp_path / "theirs" / "file").touch()
    remove_empty(tmp_path / "none", tmp_path / "theirs", tmp_path / "a" / "new", tmp_path / "a")
    assert [path.name for path in tmp_path.iterdir()] == ["theirs"]

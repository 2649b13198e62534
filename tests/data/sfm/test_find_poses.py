"""What finding poses may remove and write: its own unfinished work, in no folder that a link leads to."""

import errno
import os
import shutil
import sys

import numpy as np
import pytest
from PIL import Image
from support.running import refused

from nerf_lightning.data.sfm import find_poses
from nerf_lightning.data.sfm.find_poses import UNFINISHED, from_photographs, require_new_capture
from nerf_lightning.data.sfm.reconstruction import SparseModel
from nerf_lightning.data.sfm.settings import SfmSettings

links = pytest.mark.skipif(sys.platform == "win32", reason="symbolic links need rights there")


@pytest.fixture
def capture(tmp_path, monkeypatch):
    """A folder with photographs in it, whose poses are found at once."""
    images = tmp_path / "cap" / "images"
    images.mkdir(parents=True)
    for number in range(3):
        pixels = np.random.default_rng(number).integers(0, 255, (80, 96, 3), dtype=np.uint8)
        Image.fromarray(pixels).save(images / f"{number}.png")

    def find_cameras(photographs, images, work, sparse, settings):
        sparse.mkdir(parents=True)
        (sparse / "cameras.bin").touch()
        return SparseModel(tuple(each.path.name for each in photographs), (), (), 0, 1, 0.0)

    monkeypatch.setattr(find_poses, "find_cameras", find_cameras)
    return tmp_path / "cap"


def found(folder, source=None):
    source = source or folder / "images"
    require_new_capture(folder, source, is_video=False)
    from_photographs(source, folder, SfmSettings())
    return sorted(str(path.relative_to(folder)) for path in folder.rglob("*") if path.is_file())


PICTURES = ["images/0.png", "images/1.png", "images/2.png"]
CAPTURE = [*PICTURES, "sparse/0/cameras.bin"]


def test_nothing_stays_beside_a_capture_and_what_a_killed_process_left_is_removed(capture, tmp_path, monkeypatch):
    assert found(tmp_path / "other", capture / "images") == CAPTURE
    with monkeypatch.context() as killed:
        killed.setattr(find_poses.ScratchFolder, "remove", lambda scratch: scratch.release())
        killed.setattr(find_poses, "find_cameras", lambda photographs, images, work, *_: (work / "models").mkdir())
        with pytest.raises(FileNotFoundError):
            found(capture)
    assert (capture / UNFINISHED / "models").is_dir()
    assert found(capture) == CAPTURE


@links
@pytest.mark.parametrize("within", [False, True])
@pytest.mark.parametrize("name", [UNFINISHED, "sparse"])
def test_a_link_is_not_written_or_emptied_through(capture, tmp_path, name, within):
    thesis = (capture if within else tmp_path) / "thesis"
    (thesis / "chapters").mkdir(parents=True)
    (thesis / "chapters" / "1.tex").write_text("precious")
    (capture / name).symlink_to(thesis)
    refused(found, capture, parts=(f"{capture / name} is a symbolic link to {thesis}", "paths.output_dir=DIR"))
    assert [path.name for path in thesis.rglob("*")] == ["chapters", "1.tex"]


def test_a_folder_of_somebody_elses_is_not_emptied(capture):
    (capture / UNFINISHED / "chapters").mkdir(parents=True)
    refused(found, capture, parts=(f"{capture / UNFINISHED} holds chapters", "not made by this program"))
    assert (capture / UNFINISHED / "chapters").is_dir()


@links
def test_photographs_may_lie_behind_a_link_that_is_only_read(capture, tmp_path):
    """Many a capture's folder has such a link to where the photographs are kept."""
    (capture / "images").rename(tmp_path / "photographs")
    (capture / "images").symlink_to(tmp_path / "photographs")
    assert "sparse/0/cameras.bin" in found(capture, tmp_path / "photographs")
    assert len(list((tmp_path / "photographs").iterdir())) == 3


def full(*names):
    return OSError(errno.ENOSPC, "No space left on device", *names)


def test_a_full_disk_is_said_of_the_folder_that_is_written(capture, tmp_path, monkeypatch):
    """Not of the photograph, which is sound."""

    def unlinked(*arguments):
        raise OSError(errno.EXDEV, "another disk")

    def copy(source, target):
        raise full(str(source), None, str(target))

    def save(image, *arguments, **options):
        raise full()

    monkeypatch.setattr(os, "link", unlinked)
    monkeypatch.setattr(shutil, "copyfile", copy)
    with pytest.raises(OSError, match=f"No space left on device: '{tmp_path}/out/{UNFINISHED}/images/0.png'"):
        found(tmp_path / "out", capture / "images")
    turned = Image.open(capture / "images" / "0.png").convert("RGB")
    turned.getexif()[0x0112] = 6
    turned.save(capture / "images" / "0.png", exif=turned.getexif())
    monkeypatch.setattr(Image.Image, "save", save)
    with pytest.raises(OSError, match=f"No space left on device: '{tmp_path}/out'"):
        found(tmp_path / "out", capture / "images")
    assert not (tmp_path / "out").exists()

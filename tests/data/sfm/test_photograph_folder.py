import os

import numpy as np
import pytest
from PIL import Image

from nerf_lightning.data.sfm.photograph_folder import find_photographs, put_upright
from nerf_lightning.data.sfm.reconstruction import _camera_groups
from nerf_lightning.messages.errors import InputError

MODEL, FOCAL_LENGTH, ORIENTATION, EXIF = 0x0110, 0x920A, 0x0112, 0x8769


def save(path, width=96, height=64, orientation=None, focal=None, seed=0):
    pixels = np.random.default_rng(seed).integers(0, 255, (height // 8, width // 8, 3), dtype=np.uint8)
    picture = Image.fromarray(pixels).resize((width, height))
    exif = Image.Exif()
    if orientation:
        exif[ORIENTATION] = orientation
    if focal:
        exif[MODEL] = "Camera"
        exif.get_ifd(EXIF)[FOCAL_LENGTH] = focal
    picture.save(path, exif=exif)
    return picture


def test_photographs_come_sorted_and_hidden_files_and_folders_are_passed_over(tmp_path):
    for name in ("b.JPG", "a.png", "c.tiff", "._b.jpg", "notes.txt"):
        save(tmp_path / name) if name != "notes.txt" else (tmp_path / name).touch()
    (tmp_path / "inside.jpg").mkdir()
    found = find_photographs(tmp_path)
    assert [p.path.name for p in found] == ["a.png", "b.JPG", "c.tiff"]
    assert {(p.width, p.height, p.upright) for p in found} == {(96, 64, True)}


def test_raw_files_without_a_jpeg_are_one_line(tmp_path, caplog):
    for name in ("a.jpg", "b.jpg", "c.jpg"):
        save(tmp_path / name)
    for name in ("a.NEF", "d.nef"):
        (tmp_path / name).touch()
    find_photographs(tmp_path)
    (raw,) = caplog.messages
    assert raw.startswith("1 files are left out: d.nef. RAW is not read. Develop")


def test_cameras_are_told_apart_by_size_and_focal_length(tmp_path):
    for number, changes in enumerate([{}, {}, {"width": 104}, {"focal": 5.0}, {"focal": 5.0}, {"focal": 7.5}]):
        save(tmp_path / f"{number}.jpg", **changes)
    cameras = [p.camera for p in find_photographs(tmp_path)]
    assert cameras[0] == cameras[1]
    assert cameras[3] == cameras[4]
    assert len(set(cameras)) == 4
    with pytest.raises(InputError, match=r"camera_mode=single.*5 of 96 x 64, 1 of 104 x 64.*camera_mode=auto"):
        _camera_groups(find_photographs(tmp_path), "single")


@pytest.mark.parametrize("orientation", range(2, 9))
def test_a_turned_photograph_is_put_upright_and_keeps_its_focal_length(tmp_path, orientation):
    for number in range(3):
        save(tmp_path / f"{number}.jpg", orientation=orientation, focal=5.0)
    first = find_photographs(tmp_path)[0]
    assert not first.upright
    (tmp_path / "out").mkdir()
    put_upright(first, tmp_path / "out")
    with Image.open(tmp_path / "out" / "0.jpg") as written:
        assert written.size == (first.width, first.height) == ((64, 96) if orientation > 4 else (96, 64))
        assert ORIENTATION not in written.getexif()
        assert written.getexif().get_ifd(EXIF)[FOCAL_LENGTH] == 5.0
        with Image.open(first.path) as stored:
            corner = {2: (1, 0), 3: (1, 1), 4: (0, 1), 5: (0, 0), 6: (0, 1), 7: (1, 1), 8: (1, 0)}[orientation]
            column, row = corner[0] * 95, corner[1] * 63
            # The pixel that EXIF calls the visual top left (https://exiv2.org/tags.html, Exif.Image.Orientation).
            assert np.abs(np.subtract(stored.getpixel((column, row)), written.getpixel((0, 0)))).max() < 12


def test_upright_photographs_are_linked_else_copied(tmp_path, monkeypatch):
    for number in range(3):
        save(tmp_path / f"{number}.jpg")
    (tmp_path / "link.jpg").symlink_to(tmp_path / "0.jpg")
    (tmp_path / "out").mkdir()
    found = find_photographs(tmp_path)
    put_upright(found[0], tmp_path / "out")
    put_upright(found[3], tmp_path / "out")
    assert (tmp_path / "out" / "0.jpg").samefile(tmp_path / "0.jpg")
    assert not (tmp_path / "out" / "link.jpg").is_symlink()

    def refuse(*_):
        raise OSError("another disk")

    monkeypatch.setattr(os, "link", refuse)
    put_upright(found[1], tmp_path / "out")
    assert not (tmp_path / "out" / "1.jpg").samefile(tmp_path / "1.jpg")
    assert (tmp_path / "out" / "1.jpg").read_bytes() == (tmp_path / "1.jpg").read_bytes()

"""Captures that a stranger made to be opened: headers that no parser takes, equal names, endless files."""

import inspect
import io
import re
import struct
import sys
import zipfile

import numpy as np
import pytest
from PIL import Image
from support import malformed
from support.budget import budget
from support.captures import write_blender, write_npz
from support.malformed import WRITERS, edit_json
from support.posed_captures import Known, read, write_colmap
from support.running import refused

from nerf_lightning.data.captures.checks import check_step
from nerf_lightning.data.captures.find_pictures import pictures_below
from nerf_lightning.data.pixels.picture_files import MOST_SCANS, image_size, jpeg_scans, read_rgba
from nerf_lightning.data.readers.blender import BlenderReader
from nerf_lightning.data.readers.npz import NpzReader
from nerf_lightning.data.sfm.photograph_folder import find_photographs
from nerf_lightning.files.json_files import read_json
from nerf_lightning.messages.errors import InputError

HEADERS = {
    "negative": "{'descr': '<f8', 'fortran_order': False, 'shape': (-9, -17)}",
    "beyond": "{'descr': '<f8', 'fortran_order': False, 'shape': (0, 10000000000000000000000)}",
    "flag": "{'descr': '<f8', 'fortran_order': False, 'shape': (True, 17)}",
    "deep": "{'descr': '<f8', 'fortran_order': False, 'shape': (" + "-" * 9000 + "1,)}",
    "open": "{'descr': '<f8', 'fortran_order': False, 'shape': (1,",
    "indented": "   {\n x",
}


def npy(header):
    start = header.encode() + b"\n"
    return b"\x93NUMPY\1\0" + len(start).to_bytes(2, "little") + start + bytes(9 * 17 * 8)


@pytest.mark.parametrize("name", HEADERS)
def test_headers_of_arrays_that_no_parser_takes(tmp_path, name):
    for key in ("images", "focal"):
        path = write_npz(tmp_path / f"{key}.npz", **{key: None})
        with zipfile.ZipFile(path, "a") as archive:
            archive.writestr(f"{key}.npy", npy(HEADERS[name]))
        refused(NpzReader(str(path)).read, parts=(f"{key}.npz cannot be read", "Remove it, and copy"))
    root = WRITERS["llff"](tmp_path / "llff")
    (root / "poses_bounds.npy").write_bytes(npy(HEADERS[name]))
    refused(read, "llff", root, parts=("llff",))


@pytest.mark.skipif(sys.platform != "linux", reason="a file that can be opened and not read lies in /proc")
def test_an_archive_that_cannot_be_read(tmp_path):
    (tmp_path / "a.npz").symlink_to("/proc/self/mem")
    refused(NpzReader(str(tmp_path / "a.npz")).read, parts=("a.npz cannot be read", "Remove it, and copy"))


def test_folders_within_folders_without_end(tmp_path):
    """As deep as names can be given; the limit is lowered, since what takes the folders away goes down by recursion."""
    deepest = tmp_path.joinpath(*"abcdefghij" * 12)
    deepest.mkdir(parents=True)
    (deepest / "x.PNG").touch()
    (deepest / "back").symlink_to(tmp_path)
    before = sys.getrecursionlimit()
    sys.setrecursionlimit(len(inspect.stack()) + 60)
    try:
        found = pictures_below(tmp_path)
    finally:
        sys.setrecursionlimit(before)
    assert found == [deepest / "x.PNG"]


def test_a_folder_whose_name_is_none(tmp_path):
    refused(BlenderReader("x" * 5000).read, parts=("does not exist",))
    refused(NpzReader("x" * 5000).read, parts=("does not exist",))


@pytest.mark.parametrize("times", [1e17, 1e-1])
def test_a_focal_length_that_is_possible_for_another_picture_alone(tmp_path, times):
    root = WRITERS["transforms"](tmp_path / "capture")
    focal = 1.0 if times > 1 else 5e8
    size = {key: times * value for key, value in {"w": 16, "h": 12, "cx": 8, "cy": 6}.items()}
    edit_json(root, lambda content: content | size | {"fl_x": focal, "fl_y": focal})
    refused(read, "transforms", root, parts=("the view images/p_0.png has a focal length of", "lens has"))


def test_points_of_a_text_are_counted_too(tmp_path, caplog):
    root = WRITERS["text"](tmp_path / "capture")
    with budget(points=50):
        assert len(read("colmap", root).points) == 0
    assert "more points than the limit of 50" in caplog.text
    assert "add budgets.points=100" in caplog.text
    with budget(points=60):
        assert len(read("colmap", root).points) == 60


def test_photographs_are_counted_before_each_is_looked_at(tmp_path):
    root = WRITERS["llff"](tmp_path / "capture")
    (tmp_path / "elsewhere.png").touch()
    (root / "images" / "more.png").symlink_to(tmp_path / "elsewhere.png")
    refused(read, "llff", root, parts=("has 9 poses, but", "has 10 photographs"))
    with budget(views=9):
        refused(find_photographs, root / "images", parts=("has 10 photographs, more than the limit of 9",))


@pytest.mark.parametrize("step", [0, 1.5, None, "x", True])
def test_a_step_that_is_none(step):
    refused(check_step, "skip.train", step, parts=(f"scene.skip.train is {step}, but it must be 1",))


def test_a_tiff_with_the_cameras_settings(tmp_path):
    exif = Image.Exif()
    exif[0x0110] = "X100"
    exif.get_ifd(0x8769)[0x920A] = 35.0
    for name in ("a.tif", "b.tif", "c.tif"):
        Image.new("RGB", (80, 80)).save(tmp_path / name, exif=exif.tobytes())
    assert [photograph.lens for photograph in find_photographs(tmp_path)] == [("X100", "35.0", "", "")] * 3


def jpeg(**settings):
    content = io.BytesIO()
    Image.fromarray(np.random.default_rng(0).integers(0, 256, (64, 64, 3), np.uint8)).save(
        content, format="JPEG", **settings
    )
    return content.getvalue()


def test_the_passes_of_a_jpeg_are_counted():
    thumbnail = Image.Exif()
    thumbnail[0x010E] = "\xff\xda"
    assert jpeg_scans(jpeg()) == 1
    assert jpeg_scans(jpeg(exif=thumbnail)) == 1
    assert jpeg_scans(jpeg(progressive=True)) == 10
    assert jpeg_scans(jpeg() + jpeg()) == 1
    assert jpeg_scans(jpeg(progressive=True)[:3000]) >= 1
    assert jpeg_scans(b"\xff\xd8\xff\xda") == 1


def endless_jpeg(hidden=b""):
    """Return a JPEG of 110 passes, each but the first behind `hidden`."""
    sound = jpeg(progressive=True)
    last = sound.rfind(b"\xff\xda")
    return sound[:-2] + MOST_SCANS * (hidden + sound[last:-2]) + b"\xff\xd9"


# TEM, RST1 and, to decoders, all below SOF0 have no length: two bytes of 255 behind them skip nothing.
@pytest.mark.parametrize("marker", [0x01, 0xD1, 0x02, 0xBF])
def test_passes_behind_markers_without_a_length_are_counted(marker):
    assert jpeg_scans(endless_jpeg(bytes([0xFF, marker, 0xFF]))) == 10 + MOST_SCANS


def test_a_jpeg_that_goes_over_its_pixels_without_end(tmp_path):
    """A pass can be a few bytes and takes a tenth of a second where the picture is large."""
    (tmp_path / "a.jpg").write_bytes(endless_jpeg())
    refused(image_size, tmp_path / "a.jpg", parts=("a.jpg draws its pixels in 110 passes",))


def test_a_jpeg_of_fewer_bits_than_blocks_was_cut_short(tmp_path):
    """A decoder makes up the rest, and 1000 bytes become hundreds of megapixels of gray."""
    stream = io.BytesIO()
    Image.fromarray(np.zeros((12, 16), np.uint8)).save(stream, "JPEG")
    small = stream.getvalue()
    (tmp_path / "a.jpg").write_bytes(small.replace(struct.pack(">HH", 12, 16), struct.pack(">HH", 9000, 9000), 1))
    for read_picture in (image_size, read_rgba):
        with pytest.raises(InputError, match=r"a.jpg claims 9000 x 9000 pixels, and has .* bytes.*cut short"):
            read_picture(tmp_path / "a.jpg")
    for progressive in (False, True):
        Image.fromarray(np.zeros((3000, 4000, 3), np.uint8)).save(tmp_path / "b.jpg", progressive=progressive)
        assert image_size(tmp_path / "b.jpg") == (4000, 3000)


@pytest.mark.parametrize("unit", ["[],", "{},", '{"":1},', "[1],"])
def test_a_json_of_brackets_is_refused_before_they_fill_the_memory(tmp_path, unit):
    path = tmp_path / "transforms.json"
    path.write_text(f"[{unit * 3_000_000}0]")
    with pytest.raises(InputError, match=r"has [69],000,001 separators .* add budgets\.json_values=[69]000001"):
        read_json(path)


@pytest.mark.parametrize(
    ("name", "record", "count", "said"),
    [
        ("points3D", 51, 3 * 10**7, "30,000,000 points, more than the limit of 10,000,000"),
        ("cameras", 48, 10**7, "10,000,000 views, more than the limit of 200,000.* add budgets.views=10000000"),
        ("images", 73, 10**7, "10,000,000 views, more than the limit of 200,000"),
    ],
)
def test_millions_of_records_of_colmap(tmp_path, caplog, name, record, count, said):
    """What the records hold costs nothing on the disk."""
    root = write_colmap(tmp_path / "capture", Known())
    with (root / "sparse" / "0" / f"{name}.bin").open("wb") as file:
        file.write(struct.pack("<Q", count))
        file.truncate(8 + record * count)
    if name == "points3D":  # they are not needed
        assert len(read("colmap", root).points) == 0
        assert re.search(said, caplog.text)
    else:
        malformed.refused("colmap", root, rf"{name}\.bin has {said}")


def test_ten_million_cameras_in_other_files(tmp_path):
    root = WRITERS["llff"](tmp_path / "llff")
    header = io.BytesIO()
    np.lib.format.write_array_header_1_0(header, {"descr": "<f4", "fortran_order": False, "shape": (10**7, 17)})
    with (root / "poses_bounds.npy").open("wb") as file:
        file.write(header.getvalue())
        file.truncate(len(header.getvalue()) + 4 * 17 * 10**7)
    malformed.refused("llff", root, r"poses_bounds\.npy has .* bytes, more than")
    with budget(views=8):
        malformed.refused("transforms", WRITERS["transforms"](tmp_path / "transforms"), r"transforms\.json has 9 views")
        malformed.refused("llff", WRITERS["llff"](tmp_path / "nine"), r"poses_bounds\.npy has 9 views")
        malformed.refused("text", WRITERS["text"](tmp_path / "text"), r"cameras\.txt has more views than .* of 8")
        write_blender(tmp_path / "blender", {"train": 9, "val": 1, "test": 1})
        with pytest.raises(InputError, match=r"transforms_train\.json has 9 views"):
            BlenderReader(str(tmp_path / "blender")).read()
        with pytest.raises(InputError, match=r"a\.npz has 10 views"):
            NpzReader(str(write_npz(tmp_path / "a.npz"))).read()

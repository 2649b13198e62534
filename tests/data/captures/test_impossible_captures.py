"""Captures whose every number is one, and whose scene no checkpoint could keep: refused where they are read."""

import io
import struct
from dataclasses import replace

import numpy as np
import pytest
from PIL import Image
from support.budget import budget
from support.captures import write_blender, write_npz
from support.malformed import WRITERS, refused
from support.posed_captures import Known, write_colmap

from nerf_lightning.data.captures import reader as capture_reader
from nerf_lightning.data.pixels.images import image_size, read_rgba
from nerf_lightning.data.readers.blender import BlenderReader
from nerf_lightning.data.readers.npz import NpzReader
from nerf_lightning.files.json_files import read_json
from nerf_lightning.messages.errors import InputError


def test_a_jpeg_of_fewer_bits_than_blocks_was_cut_short(tmp_path):
    """A decoder makes up the rest, and 1000 bytes become hundreds of megapixels of grey."""
    stream = io.BytesIO()
    Image.fromarray(np.zeros((12, 16), np.uint8)).save(stream, "JPEG")
    small = stream.getvalue()
    (tmp_path / "a.jpg").write_bytes(small.replace(struct.pack(">HH", 12, 16), struct.pack(">HH", 9000, 9000), 1))
    for read_picture in (image_size, read_rgba):
        with pytest.raises(InputError, match=r"a.jpg announces 9000 x 9000 pixels, and has .* bytes.*cut short"):
            read_picture(tmp_path / "a.jpg")
    for progressive in (False, True):
        Image.fromarray(np.zeros((3000, 4000, 3), np.uint8)).save(tmp_path / "b.jpg", progressive=progressive)
        assert image_size(tmp_path / "b.jpg") == (4000, 3000)


@pytest.mark.parametrize("unit", ["[],", '{"":1},'])
def test_a_json_of_brackets_is_refused_before_they_fill_the_memory(tmp_path, unit):
    path = tmp_path / "transforms.json"
    path.write_text(f"[{unit * 3_000_000}0]")
    with pytest.raises(InputError, match=r"has 3,000,001 lists and objects, .* add budgets\.json_lists=3000001"):
        read_json(path)


def colmap_of_many(root, name, record, count=10**7):
    """Put so many records into a file of a model; what they hold costs nothing on the disk."""
    write_colmap(root, Known())
    path = root / "sparse" / "0" / f"{name}.bin"
    with path.open("wb") as file:
        file.write(struct.pack("<Q", count))
        file.truncate(8 + record * count)
    return root


def test_thirty_million_points_of_colmap(tmp_path):
    root = colmap_of_many(tmp_path / "capture", "points3D", 51, 3 * 10**7)
    refused("colmap", root, r"points3D\.bin has 30,000,000 points, and more than 10,000,000")


@pytest.mark.parametrize(("name", "record"), [("cameras", 48), ("images", 73)])
def test_ten_million_cameras_of_colmap(tmp_path, name, record):
    root = colmap_of_many(tmp_path / "capture", name, record)
    refused("colmap", root, rf"{name}\.bin has 10,000,000 views, and more than 200,000 .* add budgets\.views=10000000")


def test_ten_million_cameras_in_other_files(tmp_path):
    root = WRITERS["llff"](tmp_path / "llff")
    header = io.BytesIO()
    np.lib.format.write_array_header_1_0(header, {"descr": "<f4", "fortran_order": False, "shape": (10**7, 17)})
    with (root / "poses_bounds.npy").open("wb") as file:
        file.write(header.getvalue())
        file.truncate(len(header.getvalue()) + 4 * 17 * 10**7)
    refused("llff", root, r"poses_bounds\.npy has .* bytes, and more than")
    with budget(views=8):
        refused("transforms", WRITERS["transforms"](tmp_path / "transforms"), r"transforms\.json has 9 views")
        refused("llff", WRITERS["llff"](tmp_path / "nine"), r"poses_bounds\.npy has 9 views")
        refused("text", WRITERS["text"](tmp_path / "text"), r"cameras\.txt has more than 8 views")
        write_blender(tmp_path / "blender", {"train": 9, "val": 1, "test": 1})
        with pytest.raises(InputError, match=r"transforms_train\.json has 9 views"):
            BlenderReader(str(tmp_path / "blender")).read()
        with pytest.raises(InputError, match=r"a\.npz has 10 views"):
            NpzReader(str(write_npz(tmp_path / "a.npz"))).read()


def test_kept_pixels_of_other_sizes_than_the_photographs(tmp_path, monkeypatch):
    """As many numbers, in rows of another length: a cache that somebody else wrote."""
    real = capture_reader.read_photographs

    def turned(*arguments, **options):
        pixels = real(*arguments, **options)
        return replace(pixels, width=pixels.height, height=pixels.width)

    root = WRITERS["transforms"](tmp_path / "capture")
    monkeypatch.setattr(capture_reader, "read_photographs", turned)
    refused("transforms", root, "pixels that were kept of .* have other sizes than its photographs")

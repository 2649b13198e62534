"""Captures whose every number is one, and whose scene no checkpoint could keep: refused where they are read."""

import io
import struct
from dataclasses import replace

import numpy as np
import pytest
from PIL import Image
from support.budget import budget
from support.captures import write_blender, write_npz
from support.malformed import WRITERS, Cases, edit_json, edit_rows, refused, refused_when_damaged
from support.posed_captures import Known, ring, write_colmap

from nerf_lightning.data.captures import reader as capture_reader
from nerf_lightning.data.pixels.images import image_size, read_rgba
from nerf_lightning.data.readers.blender import BlenderReader
from nerf_lightning.data.readers.npz import NpzReader
from nerf_lightning.files.json_files import read_json
from nerf_lightning.messages.errors import InputError

cases = Cases()
REACH = "the content .* would reach .* the cameras' distance from the middle.* remove"


@cases("llff", REACH)
def one_bound_at_the_end_of_the_world(root):
    edit_rows(root, lambda rows: np.concatenate([rows[:, :16], np.full((9, 1), 1e12)], axis=1))


@cases("transforms", "in a frame whose unit is 4.6.*e-18 .* applied_scale")
def tiny_units(root):
    edit_json(root, lambda content: content | {"applied_scale": 1e18})


@cases("transforms", "in a frame whose unit is .* applied_scale")
def huge_units(root):
    edit_json(root, lambda content: content | {"applied_scale": 1e-18})


@cases("transforms", REACH, space="bounded")
def a_huge_box(root):
    edit_json(root, lambda content: content | {"aabb_scale": 1e12})


@pytest.mark.parametrize(("kind", "damage", "message", "settings"), cases.params)
def test_refused(tmp_path, kind, damage, message, settings):
    refused_when_damaged(tmp_path, kind, damage, message, settings)


def test_sparse_points_that_are_mistakes(tmp_path):
    known = Known(c2w=ring() * [1.0, 1.0, 1.0, 1e-3])
    points = 1e-4 * known.points[:20]  # of few points, the outermost ones count
    points[0] = known.c2w[0] @ [0.0, 0.0, -5e8, 1.0]
    refused("colmap", write_colmap(tmp_path / "capture", replace(known, points=points)), REACH, space="contracted")


def test_a_name_that_no_file_system_takes(tmp_path):
    root = write_blender(tmp_path / "a", {"train": 3, "val": 1, "test": 1})
    path = root / "transforms_train.json"
    path.write_text(path.read_text().replace("./train/r_1", "x" * 5000))
    with pytest.raises(InputError, match=r"names 1 image\(s\) that do not exist"):
        BlenderReader(str(root)).read()


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


@pytest.mark.parametrize("unit", ["[],", "{},", '{"":1},', "[1],"])
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


def test_names_that_no_frame_has_stay_in_one_line(tmp_path):
    root = WRITERS["transforms"](tmp_path / "capture")
    edit_json(root, lambda content: content | {"test_filenames": ["a\nb"]})
    refused("transforms", root, r"test_filenames lists a\\nb, which no frame has")


def test_kept_pixels_of_other_sizes_than_the_photographs(tmp_path, monkeypatch):
    """As many numbers, in rows of another length: a cache that somebody else wrote."""
    real = capture_reader.read_photographs

    def turned(*arguments, **options):
        pixels = real(*arguments, **options)
        return replace(pixels, width=pixels.height, height=pixels.width)

    root = WRITERS["transforms"](tmp_path / "capture")
    monkeypatch.setattr(capture_reader, "read_photographs", turned)
    refused("transforms", root, "pixels that were kept of .* have other sizes than its photographs")

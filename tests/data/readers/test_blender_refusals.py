"""Blender captures that are refused, with where, what, and the cure; damaged pictures: test_picture_files.py."""

import json
import os
import re

import pytest
from PIL import Image
from support.captures import picture, pose, write_blender
from support.waiting import fifo, within

from nerf_lightning.data.readers.blender import BlenderReader
from nerf_lightning.messages.errors import InputError


@pytest.fixture
def root(tmp_path):
    return write_blender(tmp_path / "scene", {"train": 9, "val": 2, "test": 3})


def refused(root, message, **settings):
    with pytest.raises(InputError, match=message):
        BlenderReader(str(root), **settings).read()


FRAME = {"file_path": "train/r_0", "transform_matrix": pose(0)}


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"downscale": 0}, r"scene.downscale is 0, but it must be 1"),
        ({"skip": {"test": 0}}, r"scene.skip.test is 0, but it must be 1"),
        ({"skip": {"tset": 2}}, r"scene.skip names the split 'tset'; the splits are train, val, test"),
        ({"near": 6.0}, r"scene.near=6.0 and scene.far=6.0: rays need 0 <= near < far"),
        ({"near": -1.0}, r"rays need 0 <= near < far"),
        ({"far": float("nan")}, r"rays need 0 <= near < far"),
        ({"background": "pink"}, r"background is 'pink'; choose one of white, black, random, white_or_random"),
        ({"aabb_half": 0.0}, r"scene.aabb_half=0.0"),
        ({"space": "ndc"}, r"scene.space=ndc has coordinates of its own. Use scene.coordinates=fitted"),
        (
            {"aabb_half": None},
            r"scene.coordinates=given needs .*train.json does not give them. Set scene.near, .*aabb_half",
        ),
    ],
)
def test_refuses_settings(root, settings, message):
    refused(root, message, **settings)


def test_names_what_a_wrong_folder_holds(tmp_path):
    refused(tmp_path / "none", r"The folder .*none does not exist. Set scene.root")
    refused(tmp_path, r"transforms_train.json does not exist; the folder holds nothing. Put the file")
    (tmp_path / "transforms.json").touch()
    refused(tmp_path, r"the folder holds transforms.json. Put the file")


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (b'{\n"frames": [,]}', r"transforms_val.json is not valid json: .* at line 2, column 12. Export it again"),
        (b"\x89PNG", r"transforms_val.json is not a text file \(byte 0 is not UTF-8\)"),
        ({}, r"lacks frames; it has nothing. The Blender format needs"),
        ([], r"transforms_val.json must be a json object with the keys .*, but it is list"),
        ({"camera_angle_x": 1, "frames": {}}, r"frames must be a list of views, but it is dict"),
    ],
)
def test_refuses_json_of_another_shape(root, content, message):
    written = content if isinstance(content, bytes) else json.dumps(content).encode()
    (root / "transforms_val.json").write_bytes(written)
    refused(root, message)


@pytest.mark.parametrize(
    ("content", "message"),
    [
        ({"frames": [FRAME]}, r"frames\[0\] \(train/r_0\) has no focal length: neither fl_x"),
        ({"camera_angle_x": 4, "frames": [FRAME]}, r"camera_angle_x is 4.0, but it must lie between 0 and pi radians"),
        ({"camera_angle_x": "1", "frames": [FRAME]}, r"camera_angle_x is '1', but it must be a number"),
        ({"camera_angle_x": True, "frames": [FRAME]}, r"camera_angle_x is True, but it must be a number"),
        ({"camera_angle_x": 1, "frames": [{}]}, r"frames\[0\] lacks file_path, transform_matrix; it has nothing"),
        ({"camera_angle_x": 1, "frames": [7]}, r"frames\[0\] must be a json object"),
        ({"camera_angle_x": 1, "frames": [FRAME | {"file_path": None}]}, r"file_path is None, but it must be a path"),
        ({"camera_angle_x": 1, "frames": [FRAME | {"file_path": "x" * 5000}]}, r"more than 1024 characters"),
        (
            {"camera_angle_x": 1, "frames": [FRAME | {"transform_matrix": [[2.0, 0, 0, 0], *pose(0)[1:]]}]},
            r"the view \S+r_0 has a pose that is not a rotation and a center",
        ),
    ],
)
def test_leaves_out_a_view_that_cannot_be_used(root, caplog, content, message):
    (root / "transforms_val.json").write_text(json.dumps(content))
    kept = len(BlenderReader(str(root)).read().view_names)
    assert re.search(message, caplog.text)
    assert caplog.text.count("views are left out: ") == 1
    assert kept in (11, 12)  # the picture is one of those to learn from, too


def test_refuses_too_few_views(tmp_path, root):
    refused(write_blender(tmp_path / "one", {"train": 1}), "leaves 0 for training and 1 for evaluation")
    (root / "transforms_train.json").write_text('{"camera_angle_x": 1, "frames": []}')
    refused(root, "transforms_train.json lists no training view that exists")


def test_images_that_are_absent_are_left_out_and_named_once(tmp_path, caplog):
    root = write_blender(tmp_path, {"train": 14})
    for view in range(1, 5):
        (root / "train" / f"r_{view}.png").unlink()
    assert len(BlenderReader(str(root)).read().view_names) == 10
    assert "4 of 14 views are left out: train/r_1, train/r_2, train/r_3 and 1 more. The first:" in caplog.text
    for view in range(5, 14):
        (root / "train" / f"r_{view}.png").unlink()
    refused(root, r"r_1 does not exist,.* 13 of the 14 views of \S+ cannot be used .* and 3 must remain")


def test_images_of_another_size_are_left_out(root, caplog):
    Image.fromarray(picture(0, 6, 4)).save(root / "val" / "r_1.png")
    assert len(BlenderReader(str(root)).read().view_names) == 13
    assert re.search(r"must all have one size. Most are 8 x 8, but \S+val/r_1.png is 6 x 4. Render", caplog.text)


@pytest.mark.skipif(os.name != "posix", reason="FIFOs are posix's")
def test_a_fifo_in_the_place_of_the_training_views_is_called_one(tmp_path):
    fifo(tmp_path / "transforms_train.json")
    with within(5):
        refused(tmp_path, r"transforms_train.json is a named pipe \(FIFO\), and only regular files")

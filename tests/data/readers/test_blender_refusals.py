import json

import numpy as np
import pytest
from PIL import Image
from support.captures import picture, pose, write_blender

from nerf_lightning.data.readers.blender import BlenderReader
from nerf_lightning.messages.errors import InputError


@pytest.fixture
def root(tmp_path):
    return write_blender(tmp_path / "scene", {"train": 9, "val": 2, "test": 3})


def refused(root, message, **settings):
    with pytest.raises(InputError, match=message):
        BlenderReader(str(root), **settings).read()


def change_frame(root, index, **changed):
    path = root / "transforms_train.json"
    content = json.loads(path.read_text())
    content["frames"][index] |= changed
    path.write_text(json.dumps(content))


def test_one_view_cannot_be_split(tmp_path):
    refused(write_blender(tmp_path, {"train": 1}), "leaves 0 to learn from and 1 to judge by")


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"downscale": 0}, r"scene.downscale is 0, but it must be 1"),
        ({"skip": {"test": 0}}, r"scene.skip.test is 0, but it must be 1"),
        ({"skip": {"tset": 2}}, r"scene.skip names the split 'tset'; the splits are train, val, test"),
        ({"near": 6.0}, r"scene.near is 6.0 and scene.far is 6.0, but rays need 0 <= near < far"),
        ({"near": -1.0}, r"rays need 0 <= near < far"),
        ({"far": float("nan")}, r"rays need 0 <= near < far"),
        (
            {"background": "pink"},
            r"scene.background is 'pink'; choose one of white, black, random, white_or_random, black_or_random, none",
        ),
        ({"aabb_half": 0.0}, r"scene.aabb_half is 0.0"),
        ({"downscale": 3}, r"downscale=3 does not divide .* 8 x 8 pixels. Choose one of 1, 2, 4, 8\."),
    ],
)
def test_refuses_settings(root, settings, message):
    refused(root, message, **settings)


def test_refuses_a_missing_folder(tmp_path):
    refused(tmp_path / "none", r"The folder .*none does not exist. Set scene.root")


def test_refuses_an_empty_folder(tmp_path):
    refused(tmp_path, r"transforms_train.json does not exist; the folder holds nothing. Set scene.root")


def test_names_what_a_wrong_folder_holds(tmp_path):
    (tmp_path / "transforms.json").touch()
    refused(tmp_path, r"the folder holds transforms.json. Set scene.root")


def test_refuses_json_that_does_not_parse(root):
    (root / "transforms_val.json").write_text('{\n"frames": [,]}')
    refused(root, r"transforms_val.json is not valid json: .* at line 2, column 12. Export it again")


def test_refuses_json_that_is_not_text(root):
    (root / "transforms_val.json").write_bytes(b"\x89PNG")
    refused(root, r"transforms_val.json is not a text file \(byte 0 is not UTF-8\)")


@pytest.mark.parametrize(
    ("content", "message"),
    [
        ({"frames": [], "fl_x": 2}, r"lacks camera_angle_x; it has frames, fl_x. The Blender format needs"),
        ({}, r"lacks camera_angle_x, frames; it has nothing"),
        ([], r"transforms_train.json must be a json object with the keys .*, but it is list"),
        (
            {"camera_angle_x": 4, "frames": []},
            r"camera_angle_x is 4, but it must be an angle between 0 and 2.97 radians",
        ),
        ({"camera_angle_x": "1", "frames": []}, r"camera_angle_x is '1', but it must be an angle"),
        ({"camera_angle_x": 1, "frames": {}}, r"frames must be a list of views, but it is dict"),
        ({"camera_angle_x": 1, "frames": []}, r"transforms_train.json has no frames"),
        (
            {"camera_angle_x": 1, "frames": [{}]},
            r"frames\[0\] lacks file_path, transform_matrix; it has nothing",
        ),
        ({"camera_angle_x": 1, "frames": [7]}, r"frames\[0\] must be a json object"),
    ],
)
def test_refuses_json_of_another_shape(root, content, message):
    (root / "transforms_train.json").write_text(json.dumps(content))
    refused(root, message)


@pytest.mark.parametrize(
    ("matrix", "message"),
    [
        (pose(0)[:3], r"transform_matrix must be a 4 x 4 matrix, but it is 3 x 4"),
        (5, r"must be a 4 x 4 matrix, but it is a single number"),
        ([[1, 2], [3]], r"is not a 4 x 4 matrix of numbers"),
        ([["a"] * 4] * 4, r"is not a 4 x 4 matrix of numbers"),
        ([[float("nan")] * 4, *pose(0)[1:]], r"holds NaN or infinite numbers"),
        (
            [[2.0, 0, 0, 0], *pose(0)[1:]],
            r"is not a camera pose: it must be a rotation \(no scale, no mirror\)",
        ),
        ([[-1.0, 0, 0, 0], *pose(0)[1:]], r"is not a camera pose"),
        (np.array(pose(1)).T.tolist(), r"make sure that the matrix is not transposed"),
    ],
)
def test_refuses_matrices_that_are_no_pose_and_names_the_frame(root, matrix, message):
    change_frame(root, 3, transform_matrix=matrix)
    refused(root, r"transforms_train.json: frames\[3\] \(./train/r_3\): transform_matrix .*")
    refused(root, message)


def test_refuses_a_file_path_that_is_no_text(root):
    change_frame(root, 3, file_path=None)
    refused(root, r"frames\[3\]: file_path is None, but it must be the image's path")


def test_lists_all_absent_images_at_once_up_to_ten(tmp_path):
    root = write_blender(tmp_path, {"train": 14})
    for view in range(1, 4):
        (root / "train" / f"r_{view}.png").unlink()
    refused(root, r"names 3 image\(s\) that do not exist: \S+r_1.png, \S+r_2.png, \S+r_3.png. Copy them")
    for view in range(4, 14):
        (root / "train" / f"r_{view}.png").unlink()
    refused(root, r"names 13 image\(s\) that do not exist: .*r_10.png and 3 more. Copy them")


def test_names_images_of_another_size(root):
    Image.fromarray(picture(0, 6, 4)).save(root / "val" / "r_1.png")
    refused(root, r"must all have one size. Most are 8 x 8, but not \S+val/r_1.png \(6 x 4\). Render or resize")


@pytest.mark.parametrize(
    ("damage", "message"),
    [
        (lambda content: b"", r"train/r_4.png is empty \(0 bytes\)"),
        (lambda content: b"no picture", r"train/r_4.png is not an image that can be read"),
        (lambda content: content[: len(content) // 2], r"train/r_4.png cannot be read: .* cut short"),
    ],
)
def test_refuses_damaged_images(root, damage, message):
    path = root / "train" / "r_4.png"
    path.write_bytes(damage(path.read_bytes()))
    refused(root, message)

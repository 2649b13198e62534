import json
import logging
import re

import numpy as np
import pytest
import torch
from PIL import Image
from support.captures import FOV, picture, pose, write_blender, write_transforms

from nerf_lightning.data.readers.blender import BlenderReader
from nerf_lightning.messages.errors import InputError
from nerf_lightning.nerf.geometry.cameras import focal_from_fov, project
from nerf_lightning.nerf.geometry.world_frame import points_to_user

COUNTS = {"train": 9, "val": 2, "test": 3}
FISHEYE = {"camera_model": "OPENCV_FISHEYE", "k1": 0.1}
FRAME = {"file_path": "train/r_0", "transform_matrix": pose(0)}


@pytest.fixture
def root(tmp_path):
    return write_blender(tmp_path / "scene", COUNTS)


def change_frame(root, index, **changed):
    path = root / "transforms_train.json"
    content = json.loads(path.read_text())
    content["frames"][index] |= changed
    path.write_text(json.dumps(content))


def test_reads_all_splits_in_order(root):
    scene = BlenderReader(str(root), name="toy").read()
    assert scene.splits == {"train": tuple(range(9)), "val": (9, 10), "test": (11, 12, 13)}
    assert scene.view_names[0] == "train/r_0"
    assert scene.view_names[11] == "test/r_0"
    assert torch.allclose(scene.cameras.c2w[12].double(), torch.tensor(pose(1)).double()[:3], atol=1e-6)
    assert scene.cameras.focal[0].tolist() == pytest.approx([focal_from_fov(8, FOV)] * 2)
    assert (scene.near.tolist(), scene.far.tolist()) == ([2.0] * 14, [6.0] * 14)
    assert scene.aabb.tolist() == [[-1.5] * 3, [1.5] * 3]
    assert (scene.name, scene.background, scene.truth) == ("toy", "white", None)
    assert torch.equal(scene.to_user, torch.eye(4, dtype=torch.float64))


def test_keeps_straight_alpha_and_the_colour_under_it(root):
    scene = BlenderReader(str(root)).read()
    for view, shown in ((0, 0), (8, 8), (11, 0), (13, 2)):
        assert np.array_equal(scene.pixels.view(view).numpy(), picture(shown))


def test_downscale_moves_every_projected_point_with_the_pixels(tmp_path):
    root = write_blender(tmp_path, {"train": 2, "val": 1, "test": 1}, width=12, height=8)
    full, small = (BlenderReader(str(root), downscale=factor).read() for factor in (1, 4))
    points = torch.tensor([[0.3, -0.2, 0.5], [-0.7, 0.4, 0.1]])
    for view in range(4):
        seen = project(full.cameras, view, points)
        assert torch.allclose(project(small.cameras, view, points), seen / 4, atol=1e-4)
    assert (small.cameras.width.tolist(), small.cameras.height.tolist()) == ([3] * 4, [2] * 4)
    assert small.pixels.view(1).shape == (2, 3, 4)
    assert small.protocol["downscale"] == "4"
    assert small.protocol["filter"] == "area, premultiplied"
    assert full.protocol["filter"] == "none"


def test_each_file_has_its_own_angle_of_view(root):
    write_transforms(root, "val", [{"file_path": "val/r_0", "transform_matrix": pose(0)}], camera_angle_x=0.4)
    focal = BlenderReader(str(root)).read().cameras.focal[:, 0]
    assert focal[9].item() == pytest.approx(focal_from_fov(8, 0.4))
    assert focal[10].item() == pytest.approx(focal_from_fov(8, FOV))


def test_skip_takes_every_kth_frame(root):
    scene = BlenderReader(str(root), skip={"train": 4, "test": 2}).read()
    assert [name for name in scene.view_names if "train" in name] == ["train/r_0", "train/r_4", "train/r_8"]
    assert [scene.view_names[view] for view in scene.splits["test"]] == ["test/r_0", "test/r_2"]
    assert scene.protocol["test_skip"] == "2"
    assert np.array_equal(scene.pixels.view(1).numpy(), picture(4))


def test_names_are_the_shortest_that_differ(tmp_path, root):
    write_blender(tmp_path / "alone", {"train": 2})
    assert BlenderReader(str(tmp_path / "alone")).read().view_names == ("r_0", "r_1")
    # One picture may serve in two splits.
    frames = [{"file_path": f"./{split}/r_0.png", "transform_matrix": pose(0)} for split in ("val", "test")]
    write_transforms(root, "test", frames)
    names = BlenderReader(str(root)).read().view_names
    assert names[-2:] == ("test/val/r_0", "test/test/r_0")
    assert len(set(names)) == len(names)


@pytest.mark.parametrize(
    ("absent", "val", "test", "judged", "said"),
    [
        (("val",), (9, 10, 11), (9, 10, 11), "test", "has no val split: the 3 test views serve as it"),
        (("test",), (9, 10), (9, 10), "val", "has no test split: the 2 val views serve as it"),
        (
            ("val", "test"),
            (0, 8),
            (0, 8),
            "every 8th train view",
            "lists no held-out view that exists: every 8th view is held out",
        ),
    ],
)
def test_a_missing_split_is_the_other_else_views_are_held_out(root, caplog, absent, val, test, judged, said):
    for split in absent:
        write_transforms(root, split, []) if split == "test" else (root / f"transforms_{split}.json").unlink()
    with caplog.at_level(logging.INFO):
        scene = BlenderReader(str(root)).read()
    train = tuple(range(1, 8)) if len(absent) == 2 else tuple(range(9))
    assert scene.splits == {"train": train, "val": val, "test": test}
    assert f"{root / 'transforms_train.json'} {said}" in caplog.messages
    assert caplog.text.count(" split") == len(absent) % 2
    assert scene.protocol["test_views"] == judged


def test_the_frame_may_be_fitted_to_the_cameras_instead(root):
    given, fitted = (BlenderReader(str(root), coordinates=each).read() for each in ("given", "fitted"))
    here, there = (scene.cameras.c2w[:, :, 3].double() for scene in (given, fitted))
    assert float(there.norm(dim=-1).max()) < 2.0 < float(here.norm(dim=-1).max())
    assert torch.allclose(points_to_user(there, fitted.to_user), here, atol=1e-5)


def test_photographs_are_read_where_the_format_is_named(root):
    for path in root.rglob("r_*.png"):
        Image.open(path).convert("RGB").save(path)
    write_blender(root / "below", {"train": 3, "test": 1})
    assert len(BlenderReader(str(root)).read().view_names) == sum(COUNTS.values())


def test_masks_count_and_a_size_that_is_no_multiple_is_cropped(root):
    for path in root.rglob("r_*.png"):
        mask = root / "masks" / path.relative_to(root)
        mask.parent.mkdir(parents=True, exist_ok=True)
        Image.fromarray(np.uint8([[0] * 8] * 3 + [[255] * 8] * 5)).save(mask)
    pixels = BlenderReader(str(root), downscale=3).read().pixels
    assert (pixels.width.tolist(), pixels.height.tolist()) == ([2] * 14, [2] * 14)
    assert pixels.view_mask(0).tolist() == [[0, 0], [1, 1]]
    assert BlenderReader(str(root), masks="none").read().pixels.mask is None


@pytest.mark.parametrize("ending", [".png", ".jpg", ".PNG", ""])
def test_file_path_may_have_its_ending_and_a_dot_is_none(root, ending):
    Image.fromarray(picture(0)[..., :3]).save(root / f"view.1{ending or '.png'}")
    change_frame(root, 0, file_path=f"view.1{ending}")
    assert BlenderReader(str(root)).read().pixels.view(0)[..., 3].min() == 255


def refused(root, message, **settings):
    with pytest.raises(InputError, match=message):
        BlenderReader(str(root), **settings).read()


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
    ("content", "message", "remaining"),
    [
        ([], r"transforms_val.json must be a json object with the keys .*, but it is list", None),
        ({}, r"lacks frames; it has nothing. The Blender format needs", None),
        ({"camera_angle_x": 1, "frames": [7]}, r"frames\[0\] must be a json object", 12),
        ({"frames": [FRAME]}, r"frames\[0\] \(train/r_0\) has no focal length: neither fl_x", 12),
        ({"camera_angle_x": 1, "frames": [FRAME | FISHEYE]}, r"has another kind of lens \(fisheye\) than most", 11),
    ],
)
def test_a_file_of_another_shape_is_refused_and_a_view_that_cannot_be_used_left_out(
    root, caplog, content, message, remaining
):
    (root / "transforms_val.json").write_text(json.dumps(content))
    if remaining is None:
        refused(root, message)
    else:
        assert len(BlenderReader(str(root)).read().view_names) == remaining
        assert re.search(message, caplog.text)
        assert caplog.text.count("views are left out: ") == 1


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

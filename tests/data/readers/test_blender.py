import json
import logging
import re

import numpy as np
import pytest
import torch
from PIL import Image
from support.captures import FOV, picture, pose, real_capture, write_blender, write_transforms

from nerf_lightning.data.readers.blender import BlenderReader
from nerf_lightning.nerf.geometry.cameras import focal_from_fov, project
from nerf_lightning.nerf.geometry.world_frame import points_to_user

COUNTS = {"train": 9, "val": 2, "test": 3}


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


def test_poses_of_other_conventions_are_read(root):
    plain = BlenderReader(str(root)).read().cameras.c2w
    for split, count in COUNTS.items():
        others = [np.linalg.inv(pose(view) @ np.diag([1, -1, -1, 1])).tolist() for view in range(count)]
        write_transforms(
            root, split, [{"file_path": f"{split}/r_{n}", "transform_matrix": other} for n, other in enumerate(others)]
        )
    read = BlenderReader(str(root), axes="opencv", poses="w2c").read().cameras.c2w
    assert torch.allclose(read, plain, atol=1e-5)


def test_masks_count_and_a_size_that_is_no_multiple_is_cropped(root):
    for path in root.rglob("r_*.png"):
        mask = root / "masks" / path.relative_to(root)
        mask.parent.mkdir(parents=True, exist_ok=True)
        Image.fromarray(np.uint8([[0] * 8] * 3 + [[255] * 8] * 5)).save(mask)
    pixels = BlenderReader(str(root), downscale=3).read().pixels
    assert (pixels.width.tolist(), pixels.height.tolist()) == ([2] * 14, [2] * 14)
    assert pixels.kept(0).tolist() == [[0, 0], [1, 1]]
    assert BlenderReader(str(root), masks="none").read().pixels.mask is None


@pytest.mark.parametrize("ending", [".png", ".jpg", ".PNG", ""])
def test_file_path_may_have_its_ending_and_a_dot_is_none(root, ending):
    Image.fromarray(picture(0)[..., :3]).save(root / f"view.1{ending or '.png'}")
    change_frame(root, 0, file_path=f"view.1{ending}")
    assert BlenderReader(str(root)).read().pixels.view(0)[..., 3].min() == 255


@pytest.mark.data
def test_reads_the_lego_of_200_pixels():
    scene = BlenderReader(str(real_capture("lego_200"))).read()
    assert {split: len(views) for split, views in scene.splits.items()} == {"train": 100, "val": 20, "test": 25}
    assert scene.cameras.focal[0, 0].item() == pytest.approx(277.7778, abs=1e-3)
    assert scene.cameras.c2w[:, :, 3].norm(dim=-1).tolist() == pytest.approx([4.0311] * 145, abs=1e-3)
    assert len(set(scene.view_names)) == 145
    assert re.fullmatch(r"test/r_\d+", scene.view_names[-1])


@pytest.mark.data
def test_downscaling_the_lego_of_800_pixels_gives_the_one_of_200():
    skip = {"train": 20, "test": 20}
    small = BlenderReader(str(real_capture("lego_200")), skip=skip).read()
    large = BlenderReader(str(real_capture("lego_800")), skip=skip, downscale=4).read()
    assert torch.allclose(small.cameras.focal[:5], large.cameras.focal[:5])
    ours, theirs = (scene.pixels.rgba[: 5 * 200 * 200].int() for scene in (large, small))
    # Ties are rounded to even there and up here.
    assert (ours[:, 3] - theirs[:, 3]).abs().max() <= 1
    assert (ours - theirs)[theirs[:, 3] > 0].abs().max() <= 1

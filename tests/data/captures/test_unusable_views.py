"""What a capture lists and cannot be used as it is listed: left out and said, or refused where too little remains."""

import json

import numpy as np
import pytest
from support.captures import write_blender, write_npz
from support.malformed import edit_json, refused
from support.posed_captures import Known, read, write_colmap, write_transforms

from nerf_lightning.checkpoints.record import make_record
from nerf_lightning.data.readers.blender import BlenderReader
from nerf_lightning.data.readers.npz import NpzReader
from nerf_lightning.messages.errors import InputError

NAMES = [f"images/p_{view}.png" for view in range(9)]


def with_lists(root, train, test, **more):
    return write_transforms(root, Known(), train_filenames=train, test_filenames=test, **more)


def test_what_is_tested_is_not_learnt_from(tmp_path, caplog):
    root = with_lists(tmp_path / "c", NAMES, NAMES[7:], val_filenames=NAMES[6:7])
    assert read("transforms", root).splits == {"train": tuple(range(6)), "val": (6,), "test": (7, 8)}
    said = "3 of 9 views are listed both for training and as held out, and are not trained on: images/p_6.png, images"
    assert caplog.text.count(said) == 1


def test_lists_that_leave_less_than_half_to_learn_from_have_two_readings(tmp_path):
    root = with_lists(tmp_path / "c", NAMES[:4], NAMES)
    refused("transforms", root, r"4 of 4 training views are also held out .* 0 would be left.*Remove them")


def test_one_list_for_both_is_meant_and_said(tmp_path, caplog):
    for count in (1, 9):
        scene = read("transforms", with_lists(tmp_path / str(count), NAMES[:count], NAMES[:count]))
        assert scene.splits["train"] == scene.splits["test"] == tuple(range(count))
        assert scene.protocol["test_views"] == "learned from"
        make_record(scene, "", {})
        assert f"The scene: {count} of {count} training views are also validation or test views" in caplog.text


def test_a_picture_in_two_blender_files_is_one_view(tmp_path, caplog):
    root = write_blender(tmp_path / "c", {"train": 8, "val": 1, "test": 1})
    train = json.loads((root / "transforms_train.json").read_text())
    (root / "transforms_test.json").write_text(json.dumps(train | {"frames": train["frames"][:3]}))
    scene = BlenderReader(str(root)).read()
    learnt, tested = ([scene.view_names[view][-3:] for view in scene.splits[split]] for split in ("train", "test"))
    assert (learnt, tested) == (["r_3", "r_4", "r_5", "r_6", "r_7"], ["r_0", "r_1", "r_2"])
    assert "3 of 8 views are listed both for training and as held out" in caplog.text


def test_blender_files_that_are_copies_are_judged_by_what_is_learnt(tmp_path):
    root = write_blender(tmp_path / "c", {"train": 8, "val": 1})
    (root / "transforms_test.json").write_text((root / "transforms_train.json").read_text())
    scene = BlenderReader(str(root)).read()
    assert len(scene.splits["train"]) == len(scene.splits["test"]) == 8
    assert scene.protocol["test_views"] == "learned from"


def with_focal(root, views, focal):
    def change(content):
        for view in views:
            content["frames"][view] |= {"fl_x": focal, "fl_y": focal}
        return content

    edit_json(root, change)
    return root


def test_a_view_through_no_lens_is_left_out(tmp_path, caplog):
    root = with_focal(write_transforms(tmp_path / "c", Known()), [3], 0.007)
    scene = read("transforms", root)
    assert scene.view_names == tuple(name for name in NAMES if name != "images/p_3.png")
    assert caplog.text.count("1 of 9 views are left out: images/p_3.png. The first:") == 1
    assert "the view images/p_3.png has a focal length of 0.007 pixels for 16 x 12" in caplog.text
    assert "179.9 degrees" in caplog.text


def test_a_camera_that_is_no_lens_is_refused(tmp_path):
    words = r"p_0.png.*a focal length of 0.007.*16 x 12.*179.9 degrees.*in pixels"
    refused("transforms", with_focal(write_transforms(tmp_path / "c", Known()), range(9), 0.007), words)
    refused("colmap", write_colmap(tmp_path / "d", Known(focal=(0.007, 0.007))), words)
    root = write_blender(tmp_path / "e", {"train": 3})
    path = root / "transforms_train.json"
    path.write_text(json.dumps(json.loads(path.read_text()) | {"camera_angle_x": 3.14}))
    with pytest.raises(InputError, match=r"r_0.*8 x 8.*179.9 degrees.*in pixels"):
        BlenderReader(str(root)).read()
    npz = NpzReader(str(write_npz(tmp_path / "f.npz", focal=np.array(0.003))))
    with pytest.raises(InputError, match=r"focal length of 0.003.*6 x 4.*degrees"):
        npz.read()


def test_wide_lenses_are_lenses(tmp_path):
    """139 degrees through a perspective lens; a fisheye may see what lies behind it."""
    assert len(read("transforms", with_focal(write_transforms(tmp_path / "c", Known()), range(9), 3.0)).view_names) == 9
    fisheye = Known(camera="OPENCV_FISHEYE", params=(4.0, 4.0, 8.0, 6.0, 0.0, 0.0, 0.0, 0.0))
    assert len(read("colmap", write_colmap(tmp_path / "d", fisheye)).view_names) == 9

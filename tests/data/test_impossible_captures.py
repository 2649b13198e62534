"""Captures whose every number is one, and whose scene no checkpoint could keep: refused where they are read."""

from dataclasses import replace

import numpy as np
import pytest
from captures import write_blender
from malformed import Cases, edit_json, edit_rows, refused, refused_when_damaged
from posed_captures import Known, write_colmap

from nerf_lightning.data.blender import BlenderReader
from nerf_lightning.errors import InputError

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


@pytest.mark.parametrize("far", [1e12, 1e200])
def test_sparse_points_that_are_mistakes(tmp_path, far):
    known = Known()
    points = 0.1 * known.points[:20]  # of few points, the outermost ones count
    points[0] = known.c2w[0] @ [0.0, 0.0, -far, 1.0]
    refused("colmap", write_colmap(tmp_path / "capture", replace(known, points=points)), REACH, space="contracted")


def test_a_name_that_no_file_system_takes(tmp_path):
    root = write_blender(tmp_path / "a", {"train": 3, "val": 1, "test": 1})
    path = root / "transforms_train.json"
    path.write_text(path.read_text().replace("./train/r_1", "x" * 5000))
    with pytest.raises(InputError, match=r"names 1 image\(s\) that do not exist"):
        BlenderReader(str(root)).read()

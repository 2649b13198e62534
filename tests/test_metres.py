"""Depth in meters: from a setting of the reader, through the checkpoint, to what is written."""

import json
from dataclasses import replace
from functools import partial

import numpy as np
import pytest
import torch
from PIL import Image
from support.known_fields import ball, solid
from support.posed_captures import Known, read, write_colmap
from support.running import refused
from support.scenes import ball_scene

from nerf_lightning.checkpoints.record import make_record, scene_record
from nerf_lightning.export.images import ImagesExport
from nerf_lightning.nerf.geometry.world_frame import similarity, told_length
from nerf_lightning.video.paths.orbit import Orbit
from nerf_lightning.video.shots import Subject, depth_range, make_shots

UNIT, METRES, SIZE, TILE = 50.0, 0.01, 33, 1 << 15
"""A unit of the scene is fifty of the capture's, which are centimeters."""


def record(metres_per_unit=METRES):
    scene = scene_record(ball_scene(num_views=4, size=SIZE))
    to_user = similarity(torch.eye(3), torch.tensor([5.0, 6.0, 7.0]), UNIT)
    return replace(scene, to_user=to_user, metres_per_unit=metres_per_unit)


def test_a_reader_says_it_a_checkpoint_keeps_it_and_lengths_are_told_in_metres_where_it_is_known(tmp_path):
    root = write_colmap(tmp_path, Known())
    scene = read("colmap", root, metres_per_unit=2.5)
    assert scene.metres_per_unit == 2.5
    assert read("colmap", root).metres_per_unit is None
    kept = make_record(scene, "", {})["scene"]
    assert kept["metres_per_unit"] == 2.5
    for nothing in (0.0, -1.0, float("nan"), float("inf")):
        refused(partial(read, metres_per_unit=nothing), "colmap", root, parts=("scene.metres_per_unit=", "0.01 for"))
    assert told_length(record()) == (pytest.approx(0.5), "meters")
    assert told_length(record(None)) == (pytest.approx(UNIT), "the capture's units")


def test_films_show_depth_in_metres():
    known, unknown = (
        make_shots([Subject(solid(ball()), record(metres), "white")], Orbit(2, width=24, elevation=0.0), TILE)[0]
        for metres in (METRES, None)
    )
    picture = known.picture(0)
    torch.testing.assert_close(known.z_depth(0, picture), METRES * unknown.z_depth(0, picture))
    assert depth_range([known]) == pytest.approx([METRES * end for end in depth_range([unknown])])
    torch.testing.assert_close(known.normals(0, picture), unknown.normals(0, picture))
    several = [Subject(solid(ball()), record(metres), "white") for metres in (METRES, None)]
    assert len({shot.unit for shot in make_shots(several, Orbit(2, width=24), TILE)}) == 1


@pytest.mark.parametrize(("metres", "step"), [(METRES, 1e-3), (METRES * 100, None)])
def test_depth_as_a_picture_is_in_millimetres_unless_it_is_too_far(tmp_path, metres, step):
    scene = record(metres)
    ImagesExport(max_views=1).export(solid(ball()), scene, tmp_path, TILE)
    said = json.loads((tmp_path / "images.json").read_text())
    assert "in meters" in said["depth"]
    (view, name) = next(iter(said["views"].items()))
    distance = float(scene.cameras.c2w[scene.view_names.index(view), :, 3].norm())
    expected = metres * UNIT * (distance - 0.8)
    depth = np.load(tmp_path / "depth" / f"{name}.npy")
    assert depth[SIZE // 2, SIZE // 2] == pytest.approx(expected, rel=0.05)
    assert (said["depth_scale"] == step) == (step is not None)
    picture = np.array(Image.open(tmp_path / "depth" / f"{name}.png"))
    np.testing.assert_allclose(picture * said["depth_scale"], np.nan_to_num(depth), atol=said["depth_scale"])

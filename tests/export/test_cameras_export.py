"""Cameras: what is written is read back by our own readers as the same rays in the user's frame."""

import json
import logging

import numpy as np
import pytest
import torch
from support.known_fields import ball, solid
from support.posed_captures import (
    Known,
    read,
    ring,
    user_rays,
    wall,
    write_colmap,
    write_llff,
    write_pictures,
    write_transforms,
)

from nerf_lightning.checkpoints.record import scene_record
from nerf_lightning.export.cameras import CamerasExport
from nerf_lightning.messages.errors import InputError
from nerf_lightning.nerf.geometry.poses import rotation_from_quaternion

# Around an axis of no special place.
ROTATION = rotation_from_quaternion(torch.tensor([0.2, 0.4, -0.7, 0.5], dtype=torch.float64)).numpy()
PLACES = [(0.0, 0.0), (0.99, 0.0), (0.5, 0.5), (0.2, 0.9)]
LENSES = {
    "PINHOLE": (20.0, 21.0, 8.2, 5.9),
    "OPENCV": (20.0, 21.0, 8.2, 5.9, 0.05, -0.01, 0.002, -0.003),
    "OPENCV_FISHEYE": (20.0, 21.0, 8.2, 5.9, 0.02, 0.01, -0.003, 0.001),
}


def same_rays(one, other, names):
    for name, theirs in names.items():
        mine, my_directions = user_rays(one, name, PLACES)
        their, their_directions = user_rays(other, theirs, PLACES)
        torch.testing.assert_close(mine, their, atol=2e-4 * max(1.0, float(mine.abs().max())), rtol=0)
        torch.testing.assert_close(my_directions, their_directions, atol=1e-4, rtol=0)


def known_turned(**changes):
    return Known(**changes).moved(120.0, ROTATION, np.array([900.0, 20.0, -70.0]))


@pytest.mark.parametrize("camera", LENSES)
def test_round_trip_through_both_formats(tmp_path, camera):
    known = known_turned(camera=camera, params=LENSES[camera])
    scene = read("colmap", write_colmap(tmp_path / "made", known))
    folder = tmp_path / "exported"
    CamerasExport(images="images").export(solid(ball()), scene_record(scene), folder, 65_536)
    write_pictures(folder / "images", known.names, known.size)
    back = read("colmap", folder)
    assert back.cameras.lens_model == scene.cameras.lens_model
    same_rays(scene, back, {name: name for name in known.names})
    back = read("transforms", folder)
    assert back.cameras.lens_model == scene.cameras.lens_model
    assert back.splits == scene.splits
    same_rays(scene, back, {name: f"images/{name}" for name in known.names})
    text = (folder / "sparse" / "0" / "cameras.txt").read_text()
    assert len([line for line in text.splitlines() if not line.startswith("#")]) == 1  # one camera for all


@pytest.mark.parametrize("write", [write_transforms, write_colmap])
def test_the_cameras_of_a_capture_are_not_replaced_and_those_exported_before_are(tmp_path, write):
    record = scene_record(read("colmap", write_colmap(tmp_path / "made", known_turned())))
    capture = write(tmp_path / "capture", known_turned())
    before = {path: path.read_bytes() for path in capture.rglob("*") if path.is_file()}
    with pytest.raises(InputError, match="was not written by nerf export, and would be lost"):
        CamerasExport().export(solid(ball()), record, capture, 65_536)
    assert before == {path: path.read_bytes() for path in capture.rglob("*") if path.is_file()}
    for _ in range(2):
        CamerasExport().export(solid(ball()), record, tmp_path / "exported", 65_536)


def test_a_forward_facing_capture_has_its_cameras_in_the_world(tmp_path):
    known = Known(c2w=wall())
    scene = read("llff", write_llff(tmp_path / "made", known), space="ndc")
    CamerasExport().export(solid(ball()), scene_record(scene), tmp_path / "out", 65_536)
    frames = json.loads((tmp_path / "out" / "transforms.json").read_text())["frames"]
    poses = {frame["file_path"]: np.array(frame["transform_matrix"])[:3] for frame in frames}
    for name, pose in zip(known.names, known.c2w, strict=True):
        np.testing.assert_allclose(poses[name], pose, atol=1e-4)


def test_a_lens_that_colmap_lacks_goes_into_the_json_alone(tmp_path, caplog):
    scene = read("transforms", write_transforms(tmp_path / "made", Known(c2w=ring()), k1=0.05, k3=0.01))
    with caplog.at_level(logging.WARNING):
        written = CamerasExport().export(solid(ball()), scene_record(scene), tmp_path / "out", 65_536)
    assert "k3 or k4, which COLMAP's model OPENCV lacks" in caplog.text
    assert [path.name for path in written] == ["transforms.json"]
    assert not (tmp_path / "out" / "sparse").exists()
    write_pictures(tmp_path / "out" / "images", Known().names, (16, 12))
    same_rays(scene, read("transforms", tmp_path / "out"), {name: name for name in scene.view_names})

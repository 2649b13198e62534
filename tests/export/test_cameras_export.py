"""Cameras: what is written is read back by our own readers as the same rays in the user's frame."""

import json
import logging
import os
import sys
from dataclasses import replace
from types import SimpleNamespace

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

from nerf_lightning.checkpoints.reading import scene_record
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


@pytest.mark.parametrize("camera", LENSES)
def test_round_trip_through_both_formats(tmp_path, camera):
    known = known_turned(camera=camera, params=LENSES[camera])
    scene = read("colmap", write_colmap(tmp_path / "made", known))
    folder = tmp_path / "exported"
    CamerasExport(images="images").export(solid(ball()), scene_record(scene), folder, 4096)
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


def test_a_forward_facing_capture_has_its_cameras_in_the_world(tmp_path):
    known = Known(c2w=wall())
    scene = read("llff", write_llff(tmp_path / "made", known), space="ndc")
    CamerasExport().export(solid(ball()), scene_record(scene), tmp_path / "out", 4096)
    frames = json.loads((tmp_path / "out" / "transforms.json").read_text())["frames"]
    poses = {frame["file_path"]: np.array(frame["transform_matrix"])[:3] for frame in frames}
    for name, pose in zip(known.names, known.c2w, strict=True):
        np.testing.assert_allclose(poses[name], pose, atol=1e-4)


def test_a_lens_that_colmap_lacks_goes_into_the_json_alone(tmp_path, caplog):
    scene = read("transforms", write_transforms(tmp_path / "made", Known(c2w=ring()), k1=0.05, k3=0.01))
    with caplog.at_level(logging.WARNING):
        written = CamerasExport().export(solid(ball()), scene_record(scene), tmp_path / "out", 4096)
    assert "k3 or k4, which COLMAP's model OPENCV lacks" in caplog.text
    assert [path.name for path in written] == ["transforms.json"]
    assert not (tmp_path / "out" / "sparse").exists()
    write_pictures(tmp_path / "out" / "images", Known().names, (16, 12))
    same_rays(scene, read("transforms", tmp_path / "out"), {name: name for name in scene.view_names})


def exported_in(folder, scene, form, **settings):
    (path,) = CamerasExport(format=form, **settings).export(solid(ball()), scene_record(scene), folder, 4096)
    return path


def known_turned(**changes):
    return Known(**changes).moved(120.0, ROTATION, np.array([900.0, 20.0, -70.0]))


def poses_in_order(known, scene):
    return known.c2w[[known.names.index(name) for name in scene.view_names]]


def test_nerfstudios_camera_path_holds_the_cameras(tmp_path):
    known = known_turned(focal=(20.0, 20.0))
    scene = read("colmap", write_colmap(tmp_path / "made", known))
    content = json.loads(exported_in(tmp_path / "out", scene, "nerfstudio", fps=3).read_text())
    assert (content["camera_type"], content["render_width"], content["render_height"]) == ("perspective", 16, 12)
    assert (content["fps"], content["seconds"]) == (3, 3.0)
    frames = content["camera_path"]
    for frame, pose in zip(frames, poses_in_order(known, scene), strict=True):
        np.testing.assert_allclose(np.reshape(frame["camera_to_world"], (4, 4))[:3], pose, atol=1e-3)
        assert frame["camera_to_world"][12:] == [0, 0, 0, 1]
        # What nerfstudio makes of it: half the height over the tangent of half the angle, in degrees.
        assert 6 / np.tan(np.radians(frame["fov"]) / 2) == pytest.approx(20.0, rel=1e-5)
        assert frame["aspect"] == pytest.approx(16 / 12)


class Keyed:
    """Stands for what Blender animates: keeps the values of each key at each frame."""

    def __init__(self):
        self.keys = {}

    def keyframe_insert(self, key, frame):
        self.keys.setdefault(frame, {})[key] = getattr(self, key)


def run_in_blender(path, monkeypatch):
    """Run a script before a stand-in for Blender; return the scene, the camera's object and its data."""
    placed, data, scene, markers = Keyed(), Keyed(), SimpleNamespace(render=SimpleNamespace()), {}
    scene.collection = SimpleNamespace(objects=SimpleNamespace(link=lambda linked: None))
    scene.timeline_markers = SimpleNamespace(new=lambda name, frame: markers.__setitem__(frame, name))
    made = SimpleNamespace(
        cameras=SimpleNamespace(new=lambda name: data), objects=SimpleNamespace(new=lambda name, made_of: placed)
    )
    blender = SimpleNamespace(context=SimpleNamespace(scene=scene), data=made)
    monkeypatch.setitem(sys.modules, "bpy", blender)
    exec(compile(path.read_text(), path.name, "exec"), {})
    assert scene.camera is placed
    assert (placed.rotation_mode, data.sensor_fit) == ("QUATERNION", "HORIZONTAL")
    return scene, placed, data, markers


def test_blender_gets_the_same_rays_as_keyframes(tmp_path, monkeypatch):
    known = known_turned(center=(8.7, 5.2))
    scene = read("colmap", write_colmap(tmp_path / "made", known))
    made, placed, data, markers = run_in_blender(exported_in(tmp_path / "out", scene, "blender"), monkeypatch)
    width, height = made.render.resolution_x, made.render.resolution_y
    assert (width, height, made.render.fps, made.frame_start, made.frame_end) == (16, 12, 24, 1, 9)
    assert [markers[number] for number in range(1, 10)] == list(scene.view_names)
    quaternions = torch.tensor([placed.keys[frame]["rotation_quaternion"] for frame in range(1, 10)]).double()
    assert ((quaternions[1:] * quaternions[:-1]).sum(dim=-1) > 0).all()
    for frame, name in enumerate(scene.view_names, start=1):
        lens, shift = data.keys[frame]["lens"], [data.keys[frame][key] for key in ("shift_x", "shift_y")]
        rotation = rotation_from_quaternion(quaternions[frame - 1])
        places, directions = user_rays(scene, name, PLACES)
        for (x, y), place, direction in zip(PLACES, places, directions, strict=True):
            x, y = (np.floor(x * width) + 0.5) / width, (np.floor(y * height) + 0.5) / height  # a pixel's middle
            # The window before the camera, as wide as the sensor, moved by its shift to the right and up.
            right, up = x - 0.5 + shift[0], (0.5 - y) * height / width + shift[1]
            there = rotation @ torch.tensor([right * data.sensor_width, up * data.sensor_width, -lens]).double()
            torch.testing.assert_close(there / there.norm(), direction.double(), atol=1e-4, rtol=0)
            np.testing.assert_allclose(placed.keys[frame]["location"], place.numpy(), atol=1e-2)


def test_names_are_literals_in_blenders_script(tmp_path, monkeypatch):
    scene = read("colmap", write_colmap(tmp_path / "made", Known()))
    planted = '\'"""\n]\nimport os; os.planted = True\n\\{fps}\udcff.png'
    scene = replace(scene, view_names=(planted, *scene.view_names[1:]))
    _, _, _, markers = run_in_blender(exported_in(tmp_path / "out", scene, "blender"), monkeypatch)
    assert markers[1] == planted
    assert not hasattr(os, "planted")


def test_what_an_animation_does_not_hold_is_said(tmp_path, caplog):
    bent = Known(camera="OPENCV", params=(20.0, 22.0, 8.9, 5.9, 0.05, -0.01, 0.002, -0.003))
    scene = read("colmap", write_colmap(tmp_path / "made", bent))
    exported_in(tmp_path / "out", scene, "nerfstudio")
    for text in ("camera_path.json does not say", "coefficients of the lens", "not square", "off the middle"):
        assert text in caplog.text
    caplog.clear()
    exported_in(tmp_path / "out", scene, "blender")
    assert "off the middle" not in caplog.text
    round_ = read(
        "colmap", write_colmap(tmp_path / "fish", Known(camera="OPENCV_FISHEYE", params=LENSES["OPENCV_FISHEYE"]))
    )
    path = exported_in(tmp_path / "out", round_, "nerfstudio")
    assert json.loads(path.read_text())["camera_type"] == "fisheye"
    with pytest.raises(InputError, match=r"what\.format=blender: the photographs are fisheye ones"):
        exported_in(tmp_path / "fish_out", round_, "blender")
    assert not (tmp_path / "fish_out").exists()

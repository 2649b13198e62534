"""What can be filmed of a forward-facing capture."""

import math

import torch
from support.posed_captures import Known, read, wall, write_llff

from nerf_lightning.nerf.geometry.cameras import pinhole_cameras
from nerf_lightning.video.paths.auto import AutoPath
from nerf_lightning.video.paths.base import frame_of
from nerf_lightning.video.paths.orbit import Orbit
from nerf_lightning.video.shots import in_front_of_near_plane


def test_cameras_turn_away_step_over_the_plane_or_see_something():
    # 90 degrees of view: turned by 40 its border still looks ahead, by 50 no longer.
    c2w = torch.eye(4)[:3].repeat(4, 1, 1)
    for view, degrees in enumerate((0.0, 40.0, 50.0)):
        c, s = math.cos(math.radians(degrees)), math.sin(math.radians(degrees))
        c2w[view, :, :3] = torch.tensor([[c, 0.0, s], [0.0, 1.0, 0.0], [-s, 0.0, c]])
    c2w[3, 2, 3] = -1.01
    assert in_front_of_near_plane(pinhole_cameras(c2w, 32.0, 64, 48)).tolist() == [True, True, False, False]


def test_the_path_of_a_forward_facing_capture_can_be_filmed_and_a_circle_cannot(tmp_path):
    scene = read("llff", write_llff(tmp_path, Known(c2w=wall())), space="ndc")
    around = frame_of(scene.cameras, scene.aabb)
    assert bool(in_front_of_near_plane(AutoPath(num_frames=8).cameras(around)).all())
    assert not bool(in_front_of_near_plane(Orbit(num_frames=8).cameras(around)).all())

"""Any path as keyframes, the curve through which is the path; what can be filmed of a forward-facing capture."""

import math
from dataclasses import replace

import pytest
import torch
from support.posed_captures import Known, read, wall, write_llff
from test_chosen_paths import frame, keyframe_file, keys

from nerf_lightning.nerf.geometry.cameras import pinhole_cameras
from nerf_lightning.nerf.geometry.poses import rotation_from_quaternion
from nerf_lightning.nerf.geometry.world_frame import similarity
from nerf_lightning.video.paths.as_keyframes import MOST, as_keyframes
from nerf_lightning.video.paths.auto import AutoPath
from nerf_lightning.video.paths.base import frame_of
from nerf_lightning.video.paths.keyframe_path import KeyframeCurve, KeyframePath
from nerf_lightning.video.paths.keyframes import Keyframe
from nerf_lightning.video.paths.orbit import Orbit
from nerf_lightning.video.paths.photograph_path import PhotographPath
from nerf_lightning.video.paths.spiral import Spiral
from nerf_lightning.video.shots import in_front_of_near_plane


def elsewhere():
    """Like `frame`, in a capture of other units and axes."""
    turn = rotation_from_quaternion(torch.tensor([[0.8, 0.0, 0.6, 0.0]], dtype=torch.float64))[0]
    return replace(frame(), to_user=similarity(turn, torch.tensor([5.0, -3.0, 2.0], dtype=torch.float64), 3.0))


@pytest.mark.parametrize("path", [Orbit(120, fps=12), Spiral(90, fps=10)])
def test_the_curve_through_the_keyframes_of_a_path_is_the_path(path):
    around = elsewhere()
    found = as_keyframes(path, around)
    assert MOST <= len(found) <= MOST + 1
    times = [each.time for each in found]
    at = torch.arange(path.num_frames, dtype=torch.float64) / path.fps
    curve, wanted = KeyframeCurve(found, around, times), path.cameras(around)
    reach = wanted.c2w[:, :, 3].std(dim=0).norm() + 0.1
    assert (curve.poses(at)[:, :, 3] - wanted.c2w[:, :, 3]).norm(dim=1).max() < 0.01 * reach
    torch.testing.assert_close(curve.poses(at)[:, :, :3], wanted.c2w[:, :, :3].double(), atol=0.01, rtol=0)
    torch.testing.assert_close(curve.focal(at), wanted.focal[:, 0].float())


def test_a_circle_ends_where_it_began_and_one_camera_makes_no_path(tmp_path):
    found = as_keyframes(Orbit(60, fps=12), frame())
    assert found[0].position == found[-1].position
    assert found[-1].time == pytest.approx(5.0)
    assert as_keyframes(PhotographPath(60), frame())[-1].time == pytest.approx(59 / 30)
    assert as_keyframes(Orbit(1), frame()) == []
    assert as_keyframes(KeyframePath(keys(tmp_path), 1), frame()) == []


def test_keyframes_of_a_file_stay_as_they_are(tmp_path):
    timed = [
        Keyframe((5.0, 2.0, 4.0), look_at=(1.0, 2.0, 3.0), up=(0.0, 0.0, 1.0), fov=50.0, time=2.0),
        Keyframe((1.0, 7.0, 5.0), look_at=(1.0, 2.5, 3.0), up=(0.0, 0.0, 1.0), fov=40.0, time=3.5),
    ]
    found = as_keyframes(KeyframePath(keyframe_file(tmp_path, *timed)), elsewhere())
    assert [each.time for each in found] == [0.0, 1.5]
    for given, each in zip(timed, found, strict=True):
        assert each.position == pytest.approx(given.position)
        assert each.look_at == given.look_at
        assert each.fov == pytest.approx(given.fov, abs=1e-4)


def test_a_file_may_leave_out_what_a_player_needs(tmp_path):
    path = KeyframePath(keys(tmp_path), closed=True)
    found = as_keyframes(path, frame())
    assert [each.look_at is not None and each.up is not None and each.fov is not None for each in found] == [True] * 4
    assert found[0].position == pytest.approx(found[-1].position)
    assert found[-1].time == pytest.approx(4.0)  # 120 frames of 30 a second
    assert as_keyframes(KeyframePath(keys(tmp_path), fov=33.0), frame())[1].fov == pytest.approx(33.0, abs=1e-4)


def test_a_forward_facing_capture_can_be_filmed_from_before_its_near_plane(tmp_path):
    # 90 degrees of view: turned by 40 its border still looks ahead, by 50 no longer.
    c2w = torch.eye(4)[:3].repeat(4, 1, 1)
    for view, degrees in enumerate((0.0, 40.0, 50.0)):
        c, s = math.cos(math.radians(degrees)), math.sin(math.radians(degrees))
        c2w[view, :, :3] = torch.tensor([[c, 0.0, s], [0.0, 1.0, 0.0], [-s, 0.0, c]])
    c2w[3, 2, 3] = -1.01
    assert in_front_of_near_plane(pinhole_cameras(c2w, 32.0, 64, 48)).tolist() == [True, True, False, False]
    scene = read("llff", write_llff(tmp_path, Known(c2w=wall())), space="ndc")
    around = frame_of(scene.cameras, scene.aabb)
    assert bool(in_front_of_near_plane(AutoPath(num_frames=8).cameras(around)).all())
    assert not bool(in_front_of_near_plane(Orbit(num_frames=8).cameras(around)).all())

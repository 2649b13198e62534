import math
from dataclasses import replace

import pytest
import torch
from support.budget import budget

from nerf_lightning.messages.errors import InputError
from nerf_lightning.nerf.geometry.cameras import pinhole_cameras, project
from nerf_lightning.nerf.geometry.poses import is_rigid, look_at
from nerf_lightning.video.paths.auto import AutoPath, looks_at_center
from nerf_lightning.video.paths.base import PathFrame, frame_of
from nerf_lightning.video.paths.orbit import Orbit
from nerf_lightning.video.paths.sweep import Sweep, azimuths


def frame(up=(0.0, 0.0, 1.0), dtype=torch.float64, poses=None):
    poses = torch.eye(4, dtype=dtype)[None, :3] if poses is None else poses
    center, up = torch.tensor([1.0, 2.0, 3.0], dtype=dtype), torch.tensor(up, dtype=dtype)
    return PathFrame(center=center, up=up, radius=4.0, focal=140.0, width=100, height=80, poses=poses)


def test_the_first_cameras_stand_where_geometry_start_and_direction_say():
    cameras = Orbit(num_frames=4, elevation=30.0).cameras(frame())
    level, up = 4 * math.cos(math.pi / 6), 2.0
    offsets = [[level, 0, up], [0, level, up], [-level, 0, up], [0, -level, up]]
    wanted = torch.tensor(offsets, dtype=torch.float64) + frame().center
    torch.testing.assert_close(cameras.c2w[:, :, 3], wanted)
    eyes = Orbit(num_frames=4, elevation=0.0, start=90.0, turns=-1.0).cameras(frame()).c2w[:, :, 3] - frame().center
    wanted = torch.tensor([[0.0, 4, 0], [4, 0, 0], [0, -4, 0], [-4, 0, 0]], dtype=torch.float64)
    torch.testing.assert_close(eyes, wanted)


@pytest.mark.parametrize("up", [(0.0, 0.0, 2.0), (0.0, -1.0, 0.0), (1.0, 0.0, 0.0), (0.3, 0.5, -0.4)])
def test_every_camera_looks_at_the_center_and_keeps_up_up(up):
    around = frame(up)
    cameras = Orbit(num_frames=7, elevation=-20.0, turns=2.0).cameras(around)
    assert is_rigid(cameras.c2w, tolerance=1e-9).all()
    unit = around.up / around.up.norm()
    offsets = cameras.c2w[:, :, 3] - around.center
    torch.testing.assert_close(offsets.norm(dim=-1), torch.full((7,), 4.0, dtype=torch.float64))
    height = torch.full((7,), 4 * math.sin(math.radians(-20)), dtype=torch.float64)
    torch.testing.assert_close(offsets @ unit, height)
    for view in range(7):
        middle = project(cameras, view, around.center)
        torch.testing.assert_close(middle, torch.tensor([50.0, 40.0], dtype=torch.float64))
        assert project(cameras, view, around.center + 0.1 * unit)[1] < 40.0


@pytest.mark.parametrize(
    ("asked", "size", "focal"),
    [
        ({}, (100, 80), 140.0),
        ({"width": 200}, (200, 160), 280.0),
        ({"height": 40}, (50, 40), 70.0),
        ({"width": 400, "height": 400}, (400, 400), 560.0),
    ],
)
def test_another_size_keeps_the_field_of_view(asked, size, focal):
    cameras = Orbit(num_frames=2, **asked).cameras(frame())
    assert (int(cameras.width[0]), int(cameras.height[0])) == size
    assert cameras.focal.tolist() == [[focal, focal]] * 2
    assert cameras.center[1].tolist() == [size[0] / 2, size[1] / 2]
    assert math.isclose(float(cameras.width[0] / cameras.focal[0, 0]), 100 / 140, rel_tol=1e-6)


@pytest.mark.parametrize(
    ("bad", "words"),
    [
        ({"num_frames": 0}, "path.num_frames is 0, but must be at least 1"),
        ({"elevation": 90.0}, "path.elevation is 90.0, but must be between -90 and 90"),
        ({"radius": 0.0}, "path.radius is 0.0, but must be a positive distance"),
        ({"turns": 0.0}, "path.turns is 0.0"),
        ({"fps": 0}, "path.fps is 0"),
        ({"fov": 180.0}, "path.fov is 180.0"),
        ({"center": [0.0, 1.0]}, "path.center is .0.0, 1.0., but must be three finite numbers"),
    ],
)
def test_a_bad_number_is_named(bad, words):
    with pytest.raises(InputError, match=words):
        Orbit(**bad).cameras(frame())


def test_the_frame_of_a_capture_leaves_its_lens_behind():
    eyes = torch.tensor([[3.0, 0, 1], [0, 5, 1], [1, 0, 4]])
    target = torch.tensor([1.0, 0, 1])
    c2w = look_at(eyes, target.expand(3, 3), torch.tensor([0.1, 0.2, 1.0]))
    cameras = pinhole_cameras(c2w, focal=70.0, width=64, height=48)
    around = frame_of(cameras, torch.tensor([[0.0, -1, 0], [2, 1, 2]]))
    assert around.center.tolist() == [1, 0, 1]
    assert around.up.tolist() == [0, 0, 1]
    assert math.isclose(around.radius, (2 + math.sqrt(26) + 3) / 3, rel_tol=1e-6)
    assert (around.focal, around.width, around.height) == (70.0, 64, 48)
    assert frame_of(cameras, torch.zeros(2, 3), up=(0.0, 1.0, 0.0)).up.tolist() == [0, 1, 0]
    """What is rendered anew has no reason to be bent."""
    c2w = look_at(torch.tensor([[3.0, 0, 1]]), torch.zeros(1, 3), torch.tensor([0.0, 0, 1]))
    bent = replace(pinhole_cameras(c2w, 70.0, 64, 48), lens=torch.full((1, 6), 0.1), lens_model="radial_tangential")
    cameras = Orbit(num_frames=3).cameras(frame_of(bent, torch.tensor([[-1.0] * 3, [1.0] * 3])))
    assert cameras.lens_model == "pinhole"
    assert cameras.lens.tolist() == [[0.0] * 6] * 3
    assert cameras.focal.tolist() == [[70.0, 70.0]] * 3


def ring(degrees, elevation=40.0, radius=4.0):
    """Cameras that look at the frame's center from azimuths in degrees."""
    azimuth, height = torch.deg2rad(torch.tensor(degrees, dtype=torch.float64)), math.radians(elevation)
    level = torch.stack([azimuth.cos(), azimuth.sin()], dim=-1) * math.cos(height)
    offsets = torch.cat([level, torch.full_like(level[:, :1], math.sin(height))], dim=-1)
    center = frame().center
    eyes = center + radius * offsets
    return look_at(eyes, center.expand_as(eyes), torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64))


def test_what_was_photographed_from_all_sides_or_one_is_filmed_from_there_at_that_height():
    cameras = AutoPath(num_frames=6).cameras(frame(poses=ring([0.0, 72.0, 144.0, 216.0, 288.0])))
    wanted = Orbit(num_frames=6, elevation=40.0).cameras(frame())
    torch.testing.assert_close(cameras.c2w, wanted.c2w)
    around = frame(poses=ring([-20.0, -10.0, 0.0, 10.0, 20.0]))
    cameras = AutoPath(num_frames=16).cameras(around)
    assert is_rigid(cameras.c2w).all()
    mean = around.poses[:, :, 3].mean(dim=0)
    most = (around.poses[:, :, 3] - mean).norm(dim=-1).max()
    assert ((cameras.c2w[:, :, 3] - mean).norm(dim=-1) < most).all()
    seen = torch.stack([project(cameras, view, around.center) for view in range(16)])
    torch.testing.assert_close(seen, cameras.center)


def test_a_sweep_is_level_and_as_high_and_as_far_as_the_photographs_nearby():
    near, far = ring(range(0, 180, 15), 20.0, 3.0), ring(range(180, 360, 15), 60.0, 6.0)
    around = frame(poses=torch.cat([near, far]))
    cameras = Sweep(num_frames=40).cameras(around)
    assert cameras.c2w[:, 2, 0].abs().max() < 1e-12
    offsets = cameras.c2w[:, :, 3] - around.center
    distance, height = offsets.norm(dim=-1), (offsets[:, 2] / offsets.norm(dim=-1)).asin().rad2deg()
    assert (distance[9:12] - 3.0).abs().max() < 0.01  # about 90 degrees
    assert (distance[29:32] - 6.0).abs().max() < 0.01
    assert (height[9:12] - 20.0).abs().max() < 0.1
    assert (height[29:32] - 60.0).abs().max() < 0.1
    step = cameras.c2w[:, :, 3].diff(dim=0, append=cameras.c2w[:1, :, 3]).norm(dim=-1)
    assert step.max() < 1.2


def test_a_sweep_stays_where_most_photographs_are_and_no_nearer_than_a_tenth_of_them():
    around = frame(poses=torch.cat([ring(range(0, 60, 3)), ring([30.0], 40.0, 0.5)]))
    offsets = Sweep(smooth=5.0).cameras(around).c2w[:, :, 3] - around.center
    assert offsets.norm(dim=-1).min() >= 4.0 - 1e-9
    around = frame(poses=ring([170.0, 180.0, 190.0, 200.0, 300.0, 310.0]))
    offsets = Sweep().cameras(around).c2w[:, :, 3] - around.center
    azimuth = torch.atan2(offsets[:, 1], offsets[:, 0]).rad2deg() % 360
    assert 170 < azimuth.min() < 172
    assert 198 < azimuth.max() < 200
    assert float(azimuths(torch.arange(0.0, 360, 45), 8).max()) == 315.0
    arc = azimuths(torch.arange(0.0, 316, 5), 8)
    assert (float(arc.min()), float(arc.max())) == pytest.approx((375.75, 659.25))


def test_a_sweep_has_what_photographs_show_in_the_middle_of_every_frame():
    random = torch.Generator().manual_seed(0)
    content = frame().center + 2 * torch.rand(500, 3, dtype=torch.float64, generator=random) - torch.tensor([0.6, 1, 1])
    poses = torch.cat([ring(range(0, 60, 3), radius=4.0), ring(range(0, 60, 15), radius=7.0)])
    around = replace(frame(poses=poses), content=lambda: content, bounded=True)
    for steps in (around, replace(around, bounded=False)):
        cameras = Sweep(num_frames=9).cameras(steps)
        pixel = torch.stack([project(cameras, view, content) for view in range(9)])
        inside = ((pixel - cameras.center[0]).abs() <= torch.tensor([100.0, 80.0]) / 3).all(dim=-1)
        torch.testing.assert_close(inside.double().mean(dim=1), torch.full((9,), 0.95).double(), atol=3e-3, rtol=0)
    far = Sweep(num_frames=9).cameras(replace(around, content=lambda: 9 * content, bounded=False))
    assert float((far.c2w[:, :, 3] - around.center).norm(dim=-1).max()) <= 7.0 + 1e-9


def test_what_looks_outwards_is_not_circled_and_a_forward_facing_capture_is_looked_at_from_in_front():
    outwards = ring(range(0, 360, 30))
    outwards[:, :, 0], outwards[:, :, 2] = -outwards[:, :, 0], -outwards[:, :, 2]
    assert looks_at_center(frame(poses=ring(range(0, 360, 30))))
    assert not looks_at_center(frame(poses=outwards))
    cameras = replace(pinhole_cameras(torch.eye(4)[None, :3], 70.0, 64, 48), ndc=torch.ones(1, 2))
    around = frame_of(cameras, torch.tensor([[-1.0] * 3, [1.0] * 3]))
    assert around.center.tolist() == [0.0, 0.0, -5.0]
    assert around.up.tolist() == [0.0, 1.0, 0.0]


def test_a_film_is_no_larger_than_asked_and_has_no_more_frames_than_agreed():
    large = replace(frame(), width=4000, height=3000, focal=3000.0)
    cameras = AutoPath(num_frames=2).cameras(large)
    assert (int(cameras.width[0]), int(cameras.height[0])) == (480, 360)
    assert float(cameras.focal[0, 0]) == pytest.approx(360.0)
    assert int(AutoPath(num_frames=2, width=800).cameras(large).height[0]) == 600
    assert int(AutoPath(num_frames=2).cameras(frame()).width[0]) == 100
    with pytest.raises(
        InputError, match=r"num_frames is 1000000000, .* at most 100,000 \(more with budgets\.film_frames\)"
    ):
        AutoPath(num_frames=10**9)
    with budget(film_frames=10**9):
        assert AutoPath(num_frames=10**9).num_frames == 10**9

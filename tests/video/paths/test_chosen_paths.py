"""Paths that a person lays: orbits, spirals, photographs and keyframes, in the capture's own frame."""

import math
from dataclasses import replace

import pytest
import torch

from nerf_lightning.messages.errors import InputError
from nerf_lightning.nerf.geometry.poses import is_rigid, look_at, rotation_from_quaternion
from nerf_lightning.nerf.geometry.world_frame import points_from_user, poses_from_user, similarity
from nerf_lightning.video.paths.base import PathFrame
from nerf_lightning.video.paths.keyframe_path import KeyframePath
from nerf_lightning.video.paths.keyframes import Keyframe, write_keyframes
from nerf_lightning.video.paths.orbit import Orbit
from nerf_lightning.video.paths.photograph_path import PhotographPath
from nerf_lightning.video.paths.spiral import Spiral

MIDDLE = torch.tensor([1.0, 2.0, 3.0], dtype=torch.float64)
UP = torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64)


def frame(count=8, long=4.0, short=2.0, height=1.0) -> PathFrame:
    """Cameras on an ellipse around (1, 2, 3), whose long axis is 30 degrees from x; they look at that point."""
    angle = 2 * math.pi * torch.arange(count, dtype=torch.float64) / count
    flat = torch.stack([long * angle.cos(), short * angle.sin(), torch.full_like(angle, height)], dim=-1)
    c, s = math.cos(math.pi / 6), math.sin(math.pi / 6)
    turn = torch.tensor([[c, -s, 0], [s, c, 0], [0, 0, 1]], dtype=torch.float64)
    eyes = MIDDLE + flat @ turn.mT
    poses, names = look_at(eyes, MIDDLE.expand_as(eyes), UP), tuple(f"IMG_{number:02d}.jpg" for number in range(count))
    size = {"radius": 4.0, "focal": 140.0, "width": 100, "height": 80}
    return PathFrame(center=MIDDLE, up=UP, poses=poses, view_names=names, **size)


def keyframe_file(tmp_path, *keyframes):
    write_keyframes(tmp_path / "keys.yaml", keyframes)
    return str(tmp_path / "keys.yaml")


def keys(tmp_path):
    return keyframe_file(
        tmp_path,
        Keyframe((5.0, 2.0, 4.0), look_at=(1.0, 2.0, 3.0)),
        Keyframe((1.0, 7.0, 5.0), look_at=(1.0, 4.0, 4.0), fov=60.0),
        Keyframe((-4.0, 2.0, 3.0), look_at=(1.0, 2.0, 3.0), up=(0.1, 0.0, 1.0)),
    )


def every_path(tmp_path):
    return [
        Orbit(5, radius=3.0, center=[0.0, 1.0, 2.0]),
        Spiral(5, target=[0.0, 1.0, 2.0]),
        PhotographPath(5, views=[0, "IMG_05.jpg", 3]),
        PhotographPath(5, views=[0, 2, 3], closed=True),
        KeyframePath(keys(tmp_path), 5),
    ]


def in_another_frame(user: PathFrame, quaternion: list[float]) -> PathFrame:
    """The same capture, brought elsewhere, turned and 2.5 times smaller."""
    rotation = rotation_from_quaternion(torch.tensor(quaternion, dtype=torch.float64))
    to_user = similarity(rotation, torch.tensor([10.0, -3.0, 4.0], dtype=torch.float64), 2.5)
    return replace(
        user,
        center=points_from_user(user.center[None], to_user)[0],
        up=rotation.mT @ user.up,
        radius=user.radius / 2.5,
        poses=poses_from_user(user.poses, to_user),
        to_user=to_user,
    )


@pytest.mark.parametrize("number", range(5))
def test_a_path_does_not_depend_on_the_working_frame(tmp_path, number):
    """What the user gave in the user's frame is there, however the capture was moved, turned and scaled."""
    path, user = every_path(tmp_path)[number], frame()
    if isinstance(path, Spiral):  # it wants cameras that look the same way
        user = replace(user, poses=user.poses[:3])
    working = in_another_frame(user, [0.9, 0.1, -0.3, 0.2])
    to_user = working.to_user
    wanted, found = path.cameras(user), path.cameras(working)
    assert is_rigid(found.c2w, tolerance=1e-9).all()
    if isinstance(path, Orbit):  # its azimuth 0 is the working frame's
        distance = (found.c2w[:, :, 3] - points_from_user(torch.tensor([[0.0, 1, 2]]).double(), to_user)).norm(dim=-1)
        torch.testing.assert_close(distance, torch.full_like(distance, 3.0 / 2.5))
    else:
        torch.testing.assert_close(found.c2w, poses_from_user(wanted.c2w, to_user))
        torch.testing.assert_close(found.focal, wanted.focal)


def test_a_path_passes_the_photographs_as_they_were_taken_and_is_smooth_where_it_closes():
    chosen = frame().poses[[0, 3, 4]]
    cameras = PhotographPath(2001, views=[0, "IMG_03*", 4]).cameras(frame())
    for pose in chosen:
        apart = (cameras.c2w - pose).abs().amax(dim=(-2, -1))
        assert float(apart.min()) < 5e-3
    torch.testing.assert_close(cameras.c2w[[0, -1]], chosen[[0, -1]])
    eyes = PhotographPath(400, closed=True).cameras(frame()).c2w[:, :, 3]
    velocity = eyes.roll(-1, dims=0) - eyes
    change = (velocity.roll(-1, dims=0) - velocity).norm(dim=-1)
    assert float(change[-2:].max()) <= float(change[:-2].max()) * 1.01
    assert float(velocity.norm(dim=-1).max() / velocity.norm(dim=-1).min()) < 2.5


def test_a_far_photograph_takes_longer_to_reach_and_fov_is_a_setting_of_every_path():
    eyes = MIDDLE + torch.tensor([[0.0, 9.0, 0.0], [1.0, 9.0, 0.0], [11.0, 9.0, 0.0]], dtype=torch.float64)
    along_x = look_at(eyes, eyes - torch.tensor([0.0, 1.0, 0.0]).double(), UP)
    x = PhotographPath(111).cameras(replace(frame(), poses=along_x)).c2w[:, 0, 3]
    torch.testing.assert_close(x.diff(), torch.full((110,), 0.1, dtype=torch.float64))
    cameras = PhotographPath(3, fov=90.0, width=60).cameras(frame())
    assert cameras.focal[0].tolist() == pytest.approx([30.0, 30.0])


@pytest.mark.parametrize(
    ("path", "words"),
    [
        (PhotographPath(views=["IMG_99.jpg", 1]), r"no photograph IMG_99.jpg. It has 8, numbered from 0, with names"),
        (PhotographPath(views=[0, 8]), "no photograph 8. It has 8"),
        (PhotographPath(views=[3]), r"names 1 photograph\(s\), and a path needs two"),
        (Spiral(target=[1.0, 2.0]), "path.target is .1.0, 2.0., but must be three finite numbers"),
    ],
)
def test_what_cannot_be_filmed_is_named(path, words):
    with pytest.raises(InputError, match=words):
        path.cameras(frame())

"""The similarity between two sets of poses of the same cameras."""

import pytest
import torch
from support.alignment import umeyama
from support.scenes import ball_scene

from nerf_lightning.nerf.geometry.alignment import carried, similarity_between
from nerf_lightning.nerf.geometry.frames import similarity
from nerf_lightning.nerf.geometry.poses import look_at, rotation_from_vector


def a_similarity():
    rotation = rotation_from_vector(torch.tensor([0.3, -1.2, 0.7], dtype=torch.float64))
    return similarity(rotation, torch.tensor([1.0, 2.0, -3.0], dtype=torch.float64), 2.5)


def in_a_line(count):
    eyes = torch.tensor([[0.5, 0.0, 0.0]]) * torch.arange(count)[:, None] + torch.tensor([0.0, -4.0, 1.0])
    return look_at(eyes, torch.zeros_like(eyes), torch.tensor([0.0, 0.0, 1.0]))


@pytest.mark.parametrize("poses", [ball_scene().cameras.c2w, in_a_line(4), in_a_line(2)])
def test_poses_that_moved_as_one_are_found_again(poses):
    by = a_similarity()
    moved = carried(poses.double(), by)
    torch.testing.assert_close(similarity_between(poses, moved), by, atol=1e-6, rtol=0)


def test_cameras_in_one_place_turn_and_shift_and_keep_their_size():
    poses = in_a_line(3).double()
    poses[:, :, 3] = torch.tensor([1.0, 2.0, 3.0])
    by = similarity(a_similarity()[:3, :3] / 2.5, torch.tensor([4.0, 0.0, 0.0], dtype=torch.float64), 1.0)
    torch.testing.assert_close(similarity_between(poses, carried(poses, by)), by, atol=1e-9, rtol=0)


def test_without_turns_it_is_umeyamas():
    draw = torch.Generator().manual_seed(0)
    one = ball_scene().cameras.c2w.double()
    other = one.clone()
    other[:, :, 3] = 1.5 * other[:, :, 3] + 0.01 * torch.randn(6, 3, generator=draw)
    scale, rotation, shift = umeyama(one[:, :, 3].numpy(), other[:, :, 3].numpy())
    found = similarity_between(one, other)
    assert float(found[:3, :3].norm()) / 3**0.5 == pytest.approx(scale, rel=1e-4)
    torch.testing.assert_close(found[:3, 3], torch.from_numpy(shift), atol=2e-2, rtol=0)
    torch.testing.assert_close(found[:3, :3], scale * torch.from_numpy(rotation), atol=2e-2, rtol=0)

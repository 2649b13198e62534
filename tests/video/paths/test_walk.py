"""A walk past photographs: every frame looks where a photograph nearby looks, with a level horizon."""

import math
from dataclasses import replace

import pytest
import torch
from test_chosen_paths import UP, frame

from nerf_lightning.nerf.geometry.poses import look_at
from nerf_lightning.video.paths.auto import AutoPath
from nerf_lightning.video.paths.spiral import Spiral
from nerf_lightning.video.paths.walk import Walk, walking_order


def looking(eyes, ahead):
    return replace(frame(), poses=look_at(eyes, eyes + ahead, UP), view_names=())


def street(count=20, shake=0.05):
    """Walking along x, looking ahead, with a camera held by hand."""
    place = torch.arange(count, dtype=torch.float64)
    eyes = torch.stack([place, (1.7 * place).sin() * shake, (2.3 * place).sin() * shake], dim=-1)
    return looking(eyes, torch.stack([torch.ones(count), 0.2 * place.cos(), 0.1 * place.sin()], dim=-1).double())


def room(count=24, radius=1.0):
    """Looking outward from a ring, as in a room."""
    angle = 2 * math.pi * torch.arange(count, dtype=torch.float64) / count
    ahead = torch.stack([angle.cos(), angle.sin(), torch.zeros(count)], dim=-1)
    return looking(radius * ahead, ahead)


def corner(count=24):
    """A path around a corner, looking ahead."""
    place = torch.linspace(0, 1, count, dtype=torch.float64)
    eyes = torch.stack([4 * place.clamp(max=0.5), 4 * (place - 0.5).clamp(min=0), torch.zeros(count)], dim=-1)
    turn = math.pi / 2 * ((place - 0.4) / 0.2).clamp(0, 1)
    return looking(eyes, torch.stack([turn.cos(), turn.sin(), torch.zeros(count)], dim=-1))


CAPTURES = {"street": street(), "room": room(), "corner": corner(), "few": street(4)}


@pytest.mark.parametrize("name", CAPTURES)
@pytest.mark.parametrize("path", [Walk(60), AutoPath(60)])
def test_no_frame_looks_where_no_photograph_does_and_none_is_rolled(name, path):
    around = CAPTURES[name]
    seen = path.cameras(around).c2w
    to_nearest = (seen[:, :, 2] @ around.poses[:, :, 2].mT).amax(dim=1).clamp(-1, 1).acos().rad2deg()
    assert float(to_nearest.max()) < 25
    assert float((seen[:, :, 0] @ UP).abs().max()) < math.sin(math.radians(1))  # rows are horizontal
    assert float((seen[:, :, 1] @ UP).min()) > 0
    near = torch.cdist(seen[:, :, 3], around.poses[:, :, 3]).amin(dim=1)
    assert float(near.max()) < 1.0


def test_a_walk_is_steadier_than_the_photographs_and_passes_them_from_neighbor_to_neighbor():
    around = street(40, shake=0.3)
    heights = Walk(400, smooth=2.0).cameras(around).c2w[:, 2, 3]
    assert float(heights.std()) < 0.5 * float(around.poses[:, 2, 3].std())
    around = street()
    mixed = torch.randperm(20, generator=torch.manual_seed(3))
    assert walking_order(around.poses, 1.0).tolist() == list(range(20))
    eyes = around.poses[mixed][walking_order(around.poses[mixed], 1.0)][:, 0, 3]
    assert float(eyes.diff().abs().sum()) < 40  # in the order of the files it is about 130


def test_cameras_that_look_straight_down_keep_their_own_up():
    place = torch.arange(6, dtype=torch.float64)
    eyes = torch.stack([place, torch.zeros(6), torch.full((6,), 5.0)], dim=-1)
    down = torch.tensor([0.0, 0.0, -1.0], dtype=torch.float64).expand(6, 3)
    north = torch.tensor([0.0, 1.0, 0.0], dtype=torch.float64)
    around = replace(frame(), poses=look_at(eyes, eyes + down, north), view_names=())
    seen = Walk(20).cameras(around).c2w
    torch.testing.assert_close(seen[:, :, 1], north.expand(20, 3), atol=1e-6, rtol=0)


def test_a_street_is_walked_also_where_most_photographs_look_at_a_place_on_the_way():
    """The last ones were taken beyond it."""
    around = replace(street(), center=torch.tensor([16.5, 0.0, 0.0], dtype=torch.float64))
    torch.testing.assert_close(AutoPath(7).cameras(around).c2w, Walk(7).cameras(around).c2w)


def test_photographs_side_by_side_are_seen_from_a_spiral_and_one_alone_stands_still():
    place = torch.arange(9, dtype=torch.float64)
    eyes = torch.stack([torch.zeros(9), place % 3, place // 3], dim=-1)
    around = looking(eyes, torch.tensor([1.0, 0.0, 0.0], dtype=torch.float64).expand(9, 3))
    torch.testing.assert_close(AutoPath(7).cameras(around).c2w, Spiral(7).cameras(around).c2w)
    alone = replace(around, poses=around.poses[:1])
    torch.testing.assert_close(Walk(3).cameras(alone).c2w, around.poses[:1].expand(3, 3, 4))

"""What the channels of a view show."""

from dataclasses import replace

import pytest
import torch
from support.scenes import ball_scene

from nerf_lightning.checkpoints.reading import scene_record
from nerf_lightning.viewer.camera_state import CameraState, camera_of
from nerf_lightning.viewer.channels import CHANNELS, FARTHEST, picture_of, planar_depth
from nerf_lightning.viewer.renderer import View
from nerf_lightning.viewer.shown_photographs import Photographs


@pytest.fixture
def plane():
    """A wall across the view, one unit behind the middle; the camera looks along -y."""
    c2w = torch.tensor([[1.0, 0, 0, 0], [0, 0, 1, 3], [0, 1, 0, 0]])
    c2w[:, 0] *= -1  # right, up, back is a right-handed system
    camera, _, _ = camera_of(CameraState(c2w, 0.8, 12, 12), scene_record(ball_scene()), 12)
    from nerf_lightning.nerf.geometry.cameras import all_pixels, rays_through_pixels

    rays = rays_through_pixels(camera, all_pixels(camera, 0), torch.zeros(1), torch.zeros(1))
    depth = 4.0 / -rays.directions[..., 1]
    return View(torch.full((12, 12, 3), 0.5), depth, torch.ones(12, 12), camera)


def test_the_normal_of_a_wall_is_its_own_as_colour(plane):
    picture = picture_of(plane, "normals")
    assert picture[6, 6].tolist() == pytest.approx([128, 255, 128], abs=1)


def test_colour_and_opacity_are_themselves(plane):
    assert picture_of(plane, "colour")[0, 0].tolist() == [128, 128, 128]
    assert picture_of(plane, "opacity").min() == 255


def test_near_is_bright(plane):
    picture = picture_of(plane, "depth").float().sum(dim=-1)
    assert picture[6, 6] > picture[0, 0]


def test_what_hides_lines_is_as_far_along_the_axis_as_the_wall_and_light_hides_nothing(plane):
    assert planar_depth(plane) == pytest.approx(4.0, abs=1e-5)
    assert planar_depth(replace(plane, opacity=torch.zeros(12, 12))).min() == pytest.approx(FARTHEST)


def test_every_channel_has_the_views_size(plane):
    assert {tuple(picture_of(plane, channel).shape) for channel in CHANNELS} == {(12, 12, 3)}


def test_a_photograph_comes_over_the_background_by_its_name():
    scene = ball_scene(num_views=4, size=16)
    record = scene_record(scene)
    photographs = Photographs(record, scene, "black")
    picture = photographs.picture(1, 16, 16)
    rgba = scene.pixels.view(1).float() / 255
    assert torch.allclose(picture.float() / 255, rgba[..., :3] * rgba[..., 3:], atol=2 / 255)
    assert photographs.thumbnail(0).shape == (96, 96, 3)
    without = Photographs(record, None, "black")
    assert not without.has(1)
    assert without.thumbnail(1) is None

"""Views in slices are the same views; crops and photographs' cameras are kept."""

from dataclasses import replace

import pytest
import torch
from support.scenes import ball_scene, tiny_model
from support.static_models import fast_model
from support.steps import rays_of

from nerf_lightning.checkpoints.record import scene_record
from nerf_lightning.extensions.viewer import renderer as slices
from nerf_lightning.extensions.viewer.camera_state import CameraState, camera_of, pose_of
from nerf_lightning.extensions.viewer.channels import CHANNELS, FARTHEST, picture_of, planar_depth
from nerf_lightning.extensions.viewer.renderer import SlicedRenderer, View
from nerf_lightning.extensions.viewer.shown_photographs import Photographs
from nerf_lightning.nerf.geometry.cameras import all_pixels, rays_through_pixels
from nerf_lightning.nerf.geometry.clipping import CropBox
from nerf_lightning.nerf.models.ragged_level import RaggedLevel
from nerf_lightning.nerf.models.ray_generator import RayGenerator
from nerf_lightning.nerf.models.render_image import render_picture


@pytest.fixture
def scene():
    return ball_scene(num_views=4, size=16)


@pytest.fixture
def renderer(scene):
    return SlicedRenderer(tiny_model().eval(), scene_record(scene), "white", 4096)


@pytest.fixture
def behind_grid(scene):
    """A model that evaluates its field only in occupied cells: those that the photographs' alpha does not rule out."""
    model = fast_model(RaggedLevel).eval()
    model.fit_to(scene)
    return SlicedRenderer(model, scene_record(scene), "white", 4096)


def finished(generator):
    count = 0
    while True:
        try:
            next(generator)
            count += 1
        except StopIteration as end:
            return end.value, count


def test_a_photographs_look_in_slices_is_its_picture(scene, renderer):
    renderer.rays_per_second = 64 / slices.SLICE_SECONDS  # the first slice has 64 rays
    look = CameraState(scene.cameras.c2w[1], 0.6, 160, 120, photograph=1)
    view, count = finished(renderer.slices(look, 16))
    whole = render_picture(renderer.model, rays_of(scene), 1, "white", 4096)
    assert count >= 2
    assert torch.allclose(view.rgb, whole.rgb, atol=1e-6)
    assert torch.allclose(view.opacity, whole.opacity, atol=1e-6)


def test_a_free_look_from_a_photographs_place_sees_what_the_photograph_sees(scene, renderer):
    fov = 2 * float(torch.atan(torch.tensor(0.5 / 1.6)))
    view, _ = finished(renderer.slices(CameraState(scene.cameras.c2w[2], fov, 640, 640), 16))
    _, near, far = camera_of(CameraState(scene.cameras.c2w[2], 1.0, 1, 1), scene_record(scene), 1)
    rays = RayGenerator(scene.cameras, near.expand(4), far.expand(4))
    whole = render_picture(renderer.model, rays, 2, "white", 4096)
    assert torch.allclose(view.rgb, whole.rgb, atol=1e-4)


def test_outside_of_the_crop_box_there_is_only_background(scene, renderer):
    box = CropBox.from_user((-0.2, -0.2, -0.2), (0.2, 0.2, 0.2), torch.eye(4))
    view, _ = finished(renderer.slices(CameraState(scene.cameras.c2w[0], 0.6, 32, 32, crop=box), 32))
    assert torch.equal(view.rgb[0], torch.ones(32, 3))
    assert float(view.opacity[0].max()) == 0.0
    assert float(view.opacity[16, 16]) > 0.0


def test_the_near_plane_goes_with_somebody_who_comes_closer(scene):
    record = scene_record(scene)
    c2w = scene.cameras.c2w[0].clone()
    _, near, far = camera_of(CameraState(c2w, 0.6, 8, 8), record, 8)
    c2w[:, 3] *= 0.5
    _, nearer, less_far = camera_of(CameraState(c2w, 0.6, 8, 8), record, 8)
    assert float(near) == pytest.approx(2.0, abs=1e-4)
    assert 0 < float(nearer) < 0.1
    walked = float(c2w[:, 3].norm())
    assert float(far) - float(less_far) == pytest.approx(walked, abs=1e-4)


def test_a_tall_photograph_fits_into_a_wide_window_and_opencvs_rotation_becomes_ours(scene):
    record = scene_record(scene)
    cameras, _, _ = camera_of(CameraState(scene.cameras.c2w[0], 0.6, 200, 100, photograph=0), record, 50)
    assert (int(cameras.width), int(cameras.height)) == (50, 50)
    cameras, _, _ = camera_of(CameraState(scene.cameras.c2w[0], 0.6, 50, 100, photograph=0), record, 100)
    assert (int(cameras.width), int(cameras.height)) == (50, 50)
    from viser.transforms import SO3

    c2w = scene.cameras.c2w[3]
    quaternion = SO3.from_matrix((c2w[:, :3] * torch.tensor([1.0, -1, -1])).double().numpy()).wxyz
    assert torch.allclose(pose_of(torch.tensor(quaternion).float(), c2w[:, 3]), c2w, atol=1e-5)


def test_the_speed_that_was_seen_decides_the_size_while_moving(scene, renderer):
    look = CameraState(scene.cameras.c2w[0], 0.6, 400, 300)
    renderer.rays_per_second = 120_000.0
    assert renderer.height_while_moving(look) == 94  # 12,000 rays, 4 to 3
    renderer.rays_per_second = 10.0
    assert renderer.height_while_moving(look) == slices.LEAST_HEIGHT


def test_behind_an_occupancy_grid_slices_are_the_whole_picture(scene, behind_grid):
    behind_grid.rays_per_second = 64 / slices.SLICE_SECONDS
    view, count = finished(behind_grid.slices(CameraState(scene.cameras.c2w[1], 0.6, 160, 120, photograph=1), 16))
    whole = render_picture(behind_grid.model, rays_of(scene), 1, "white", 4096)
    assert count >= 2
    assert torch.allclose(view.rgb, whole.rgb, atol=2e-3)  # a ray may end when its light is below 1e-3
    assert torch.allclose(view.opacity, whole.opacity, atol=2e-3)
    assert float(view.opacity[8, 8]) > 0.1
    assert float(view.opacity[0].max()) == 0.0  # empty cells


def test_behind_an_occupancy_grid_a_crop_box_only_takes_away(scene, behind_grid):
    look = CameraState(scene.cameras.c2w[0], 0.6, 32, 32)
    whole, _ = finished(behind_grid.slices(look, 32))
    all_of_it = CropBox.from_user((-1.0, -1.0, -1.0), (1.0, 1.0, 1.0), torch.eye(4))
    uncut, _ = finished(behind_grid.slices(replace(look, crop=all_of_it), 32))
    assert torch.allclose(uncut.rgb, whole.rgb, atol=2e-3)
    upper = CropBox.from_user((-1.0, -1.0, 0.0), (1.0, 1.0, 1.0), torch.eye(4))
    half, _ = finished(behind_grid.slices(replace(look, crop=upper), 32))
    assert bool((half.opacity <= whole.opacity + 2e-3).all())
    assert torch.equal(half.rgb[-8:], torch.ones(8, 32, 3))
    assert float(whole.opacity[-10].max()) > 0.1
    assert float(half.opacity[10].max()) > 0.1


@pytest.fixture
def plane():
    """A wall across the view, one unit behind the middle; the camera looks along -y."""
    c2w = torch.tensor([[1.0, 0, 0, 0], [0, 0, 1, 3], [0, 1, 0, 0]])
    c2w[:, 0] *= -1  # right, up, back is a right-handed system
    camera, _, _ = camera_of(CameraState(c2w, 0.8, 12, 12), scene_record(ball_scene()), 12)
    rays = rays_through_pixels(camera, all_pixels(camera, 0), torch.zeros(1), torch.zeros(1))
    depth = 4.0 / -rays.directions[..., 1]
    return View(torch.full((12, 12, 3), 0.5), depth, torch.ones(12, 12), camera)


def test_every_channel_has_the_views_size_and_shows_what_it_is(plane):
    picture = picture_of(plane, "Normals")
    assert picture[6, 6].tolist() == pytest.approx([128, 255, 128], abs=1)
    assert picture_of(plane, "Color")[0, 0].tolist() == [128, 128, 128]
    assert picture_of(plane, "Opacity").min() == 255
    picture = picture_of(plane, "Depth").float().sum(dim=-1)
    assert picture[6, 6] > picture[0, 0]
    assert {tuple(picture_of(plane, channel).shape) for channel in CHANNELS} == {(12, 12, 3)}


def test_what_hides_lines_is_as_far_along_the_axis_as_the_wall_and_light_hides_nothing(plane):
    assert planar_depth(plane) == pytest.approx(4.0, abs=1e-5)
    assert planar_depth(replace(plane, opacity=torch.zeros(12, 12))).min() == pytest.approx(FARTHEST)


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

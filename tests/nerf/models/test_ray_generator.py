"""The one place where cameras become rays: what is bent, what may learn, and what a step tells of its photographs."""

from dataclasses import replace

import torch
from support.learnt_cameras import LearntShifts
from support.scenes import ball_scene, tiny_model
from support.steps import make_step, rays_of

from nerf_lightning.data.ray_batches import RayBatches
from nerf_lightning.nerf.geometry.cameras import all_pixels, rays_through_pixels
from nerf_lightning.nerf.models.ray_generator import RayGenerator
from nerf_lightning.nerf.types.rays import PixelIndex
from nerf_lightning.training.validation import RayErrors


def test_a_pixel_has_the_ray_of_its_camera_and_rays_through_the_world_are_not_bent():
    scene = ball_scene()
    rays_of_scene, pixels = rays_of(scene), all_pixels(scene.cameras, 2)
    rays = rays_through_pixels(scene.cameras, pixels, scene.near, scene.far)
    assert torch.equal(rays_of_scene(pixels).directions, rays.directions)
    assert rays_of_scene(pixels).photograph is None
    assert not rays_of_scene.state_dict()
    forward = replace(scene.cameras, c2w=torch.eye(4)[:3].expand(len(scene.near), 3, 4))
    bent = RayGenerator(replace(forward, ndc=torch.ones(len(scene.near), 2)), scene.near, scene.far)
    pixels = all_pixels(forward, 0)
    straight = RayGenerator(forward, scene.near, scene.far)(pixels)
    assert torch.equal(bent.through_world(pixels).origins, straight.origins)
    assert not torch.allclose(bent(pixels).origins, straight.origins)


def test_rays_of_a_smaller_picture_pass_through_the_middles_of_squares_as_learned():
    scene = ball_scene()
    whole = LearntShifts(scene.cameras, scene.near, scene.far)
    torch.nn.init.constant_(whole.shift, 0.1)
    side = int(scene.cameras.width[2])
    small = whole.at_most(side // 2)
    corners = PixelIndex(*(torch.tensor(each) for each in ([2, 2], [0, 4], [0, 2])))
    found = small(PixelIndex(corners.view, corners.x // 2, corners.y // 2))
    expected = whole(corners, torch.full((2, 2), 0.5))
    torch.testing.assert_close((found.origins, found.directions), (expected.origins, expected.directions))
    assert not found.origins.requires_grad
    assert torch.equal(whole.at_most(side)(corners).directions, whole(corners).directions)


def test_cameras_can_learn_in_tiles_and_whole():
    scene, shifts = ball_scene(), []
    for tile_points in (None, 200):
        train_step = make_step(tile_points)
        train_step.objective.rays = LearntShifts(scene.cameras, scene.near, scene.far)
        train_step.build_optimizer = lambda groups: torch.optim.SGD(groups, lr=1.0)
        optimizer = train_step.new_optimizer()
        train_step(RayBatches(scene, train_step.progress, 0, 64).batch_at(0, 0), optimizer)
        shifts.append(train_step.objective.rays.shift.detach())
    assert float(shifts[0][list(scene.splits["train"])].abs().min()) > 0
    torch.testing.assert_close(shifts[0], shifts[1], rtol=1e-3, atol=1e-7)


def test_a_training_step_says_which_photograph_it_explains_and_validation_does_not():
    model, seen = tiny_model(density_bias=0.5), []
    render = model.forward

    def forward(rays, background, random):
        seen.append(rays.photograph)
        return render(rays, background, random)

    model.forward = forward
    train_step = make_step(None, model)
    batch = RayBatches(ball_scene(), train_step.progress, 0, 64).batch_at(0, 0)
    train_step(batch, train_step.new_optimizer())
    assert torch.equal(seen[0], batch.pixels.view)
    RayErrors().of(train_step.objective, batch, None)
    assert seen[1] is None

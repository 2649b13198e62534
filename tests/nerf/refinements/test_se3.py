"""Cameras that learn: what may move, what does not, and where it ends."""

import copy
from dataclasses import replace

import pytest
import torch
from support.known_fields import photographed_ball
from support.running import refused
from support.scenes import ball_scene, tiny_model
from support.steps import make_step
from support.wrong_cameras import mean_errors, with_noise

from nerf_lightning.data.ray_batches import RayBatches
from nerf_lightning.nerf.encoders.hash_grid import HashGridEncoder
from nerf_lightning.nerf.encoders.spherical_harmonics import SphericalHarmonicsEncoder
from nerf_lightning.nerf.fields.ngp_field import NGPField
from nerf_lightning.nerf.geometry.alignment import carried, similarity_between
from nerf_lightning.nerf.geometry.cameras import all_pixels, project
from nerf_lightning.nerf.geometry.lenses import unproject
from nerf_lightning.nerf.models.ragged_level import RaggedLevel
from nerf_lightning.nerf.models.ray_generator import RayGenerator
from nerf_lightning.nerf.optimizers.schedule import ExponentialDecay
from nerf_lightning.nerf.part import StepContext, fit_parts
from nerf_lightning.nerf.randomness import batch_random
from nerf_lightning.nerf.refinements.base import NoRefinement
from nerf_lightning.nerf.refinements.displacements import camera_displacements, far_displaced
from nerf_lightning.nerf.refinements.se3 import SE3Delta
from nerf_lightning.nerf.rendering.quadrature import composite_ragged
from nerf_lightning.nerf.rendering.sample_points import ragged_points
from nerf_lightning.nerf.samplers.early_termination import visible_samples
from nerf_lightning.nerf.samplers.occupancy import OccupancySampler
from nerf_lightning.nerf.types.rays import PixelIndex
from nerf_lightning.training.attempts import restart


def a_step(scene, refinement, model=None):
    train_step = make_step(None, model, background=scene.background)
    fit_parts(train_step.objective.model, scene)
    refinement.fit_to(scene)
    train_step.objective.rays = RayGenerator(scene.cameras, scene.near, scene.far, refinement)
    return train_step


def learnt(scene, refinement, model, steps, decay=1.0):
    """What has learned the cameras of a known scene: in each step, from as many rays."""
    train_step = a_step(scene, refinement, model)
    train_step.build_optimizer = lambda groups: torch.optim.Adam(groups, lr=1e-30)
    train_step.schedule, train_step.num_steps = ExponentialDecay(decay_rate=decay), steps
    loader, optimizer = RayBatches(scene, train_step.progress, 0, 768), train_step.new_optimizer()
    for _ in range(steps):
        train_step(loader.batch_at(0, train_step.progress.rays_seen), optimizer)
    return train_step.objective.rays.cameras.map(torch.Tensor.detach)


@pytest.mark.parametrize("refinement", [
    NoRefinement(), SE3Delta(), SE3Delta(poses=False, focal=True), SE3Delta(poses=False, lens=True),
])  # fmt: skip
def test_at_first_every_ray_is_as_it_was_to_the_bit(refinement):
    scene = ball_scene()
    train_step = a_step(scene, refinement)
    plain = RayGenerator(scene.cameras, scene.near, scene.far)
    pixels = PixelIndex(torch.arange(6), torch.arange(6), torch.arange(6))
    assert torch.equal(train_step.objective.rays(pixels).directions, plain(pixels).directions)
    assert torch.equal(train_step.objective.rays(pixels).origins, plain(pixels).origins)


def test_only_photographs_that_are_trained_on_move():
    scene = ball_scene()
    train_step = a_step(scene, SE3Delta(learning_rate=1e-2, hold=0.0, weight=1.0))
    train_step.build_optimizer = lambda groups: torch.optim.Adam(groups, lr=1e-3)
    loader, optimizer = RayBatches(scene, train_step.progress, 0, 64), train_step.new_optimizer()
    for _ in range(3):
        train_step(loader.batch_at(0, train_step.progress.rays_seen), optimizer)
    moved = (train_step.objective.rays.cameras.c2w.detach() - scene.cameras.c2w).abs().amax(dim=(1, 2))
    assert float(moved[:3].min()) > 1e-3
    assert float(moved[3:].max()) == 0.0


def test_cameras_are_held_until_there_is_a_scene():
    scene = ball_scene()
    train_step = a_step(scene, SE3Delta(learning_rate=1e-2, hold=0.02))  # two of the hundred steps
    train_step.build_optimizer = lambda groups: torch.optim.Adam(groups, lr=1e-3)
    loader, optimizer, moved = RayBatches(scene, train_step.progress, 0, 64), train_step.new_optimizer(), []
    for _ in range(3):
        train_step(loader.batch_at(0, train_step.progress.rays_seen), optimizer)
        moved.append(float(train_step.objective.rays.refinement.shift.detach().abs().max()))
    assert moved[:2] == [0.0, 0.0]
    assert moved[2] > 1e-3


def test_wrong_cameras_before_a_known_scene_find_their_place():
    true, model = photographed_ball()
    scene = with_noise(true, degrees=1.0, share=0.01)
    found = learnt(scene, SE3Delta(learning_rate=1e-2, hold=0.0, weight=0.0), model, 80, decay=0.01)
    views = true.splits["train"]
    before, after = (mean_errors(each.c2w, true.cameras.c2w, views) for each in (scene.cameras, found))
    assert after[0] < before[0] / 4, (before, after)
    assert after[1] < before[1] / 4, (before, after)


def test_photographs_of_one_camera_share_its_focal_length_and_a_pinhole_may_turn_out_to_have_a_lens():
    scene = ball_scene()
    scene = replace(scene, cameras=replace(scene.cameras, focal=scene.cameras.focal.clone()))
    scene.cameras.focal[4:] *= 2.0
    refinement = SE3Delta(poses=False, focal=True)
    refinement.fit_to(scene)
    assert refinement.log_focal.shape == (2,)
    torch.nn.init.constant_(refinement.log_focal, 0.1)
    torch.testing.assert_close(refinement(scene.cameras).focal, scene.cameras.focal * torch.tensor(0.1).exp())
    scene = ball_scene()
    refinement = SE3Delta(poses=False, lens=True)
    refinement.fit_to(scene)
    assert refinement(scene.cameras).lens_model == "radial_tangential"
    with torch.no_grad():
        refinement.radial[:] = torch.tensor([0.1, -0.02])
    assert refinement(scene.cameras).lens[0].tolist() == pytest.approx([0.1, -0.02, 0.0, 0.0, 0.0, 0.0])


def test_a_wrong_focal_length_is_found_before_a_known_scene():
    true, model = photographed_ball()
    scene = replace(true, cameras=replace(true.cameras, focal=1.03 * true.cameras.focal))
    refinement = SE3Delta(poses=False, focal=True, learning_rate=3e-3, hold=0.0, weight=0.0)
    found = learnt(scene, refinement, model, 30)
    assert float((found.focal / true.cameras.focal).mean()) == pytest.approx(1.0, abs=6e-3)


@pytest.mark.parametrize("model", ["radial_tangential", "fisheye"])
def test_a_wrong_lens_is_found_before_a_known_scene(model):
    bent = (0.3, 0.0, 0.0, 0.0, 0.0, 0.0)
    true, known = photographed_ball(lens=bent, lens_model=model)
    given = torch.zeros(8, 6) if model == "fisheye" else torch.tensor([[0.2, *bent[1:]]] * 8)
    scene = replace(true, cameras=replace(true.cameras, lens=given))
    refinement = SE3Delta(poses=False, lens=True, learning_rate=3e-2, hold=0.0, weight=0.0)
    found = learnt(scene, refinement, known, 60, decay=0.01)
    corner = torch.tensor([[0.3, 0.3]])  # in focal lengths, where the coefficients are told apart from each other
    seen, *others = (unproject(corner, each[:1], model) for each in (true.cameras.lens, given, found.lens))
    before, after = (float((each - seen).norm()) for each in others)
    assert after < before / 5, (before, after)


@pytest.mark.parametrize(
    ("refinement", "changes", "cameras", "parts"),
    [
        (SE3Delta(focal=True), {}, {"lens_model": "equirectangular"}, ("has panoramas", "refinement=se3")),
        (SE3Delta(), {"space": "ndc"}, {"ndc": torch.ones(6, 2)}, ("scene.space=ndc", "scene.space=contracted")),
        (SE3Delta(), {"splits": {"train": (2,)}}, {}, ("trains on 1 photograph",)),
    ],
)
def test_captures_whose_cameras_cannot_be_learnt_are_refused(refinement, changes, cameras, parts):
    scene = ball_scene()
    scene = replace(scene, cameras=replace(scene.cameras, **cameras), **changes)
    refused(refinement.fit_to, scene, parts=(*parts, "refinement=none"))


def test_the_penalty_is_the_mean_square_of_what_has_moved_and_without_a_refinement_nothing_learns():
    refinement = SE3Delta(weight=0.5)
    refinement.fit_to(ball_scene())  # three photographs
    torch.nn.init.constant_(refinement.rotation[:1], 0.1)
    assert float(refinement.penalty().detach()) == pytest.approx(0.5 * 3 * 0.01 / 3)
    assert SE3Delta(weight=0.0).penalty() is None
    rays = a_step(ball_scene(), NoRefinement()).objective.rays
    assert not list(rays.parameters())
    assert not rays.state_dict()
    assert rays.penalty() is None
    assert rays.refined((0, 1, 2)) is None


@pytest.mark.parametrize(("settings", "said"), [
    ({"learning_rate": 0.0}, "learning_rate=0.0: give"), ({"weight": -1.0}, "weight=-1.0: give"),
    ({"poses": False}, "nothing to learn"),
])  # fmt: skip
def test_settings_that_make_no_sense_are_refused(settings, said):
    with pytest.raises(ValueError, match=said):
        SE3Delta(**settings)


def test_views_that_are_not_trained_on_follow_the_others():
    scene = ball_scene(num_views=8)
    refinement = SE3Delta()
    refinement.fit_to(scene)
    rays = RayGenerator(scene.cameras, scene.near, scene.far, refinement)
    with torch.no_grad():
        refinement.shift[:4] = torch.tensor([0.0, 0.0, 0.02])  # each goes back, and the others are left behind
    rows, eyes = [0, 1, 2, 3], rays.refined(scene.splits["train"]).c2w[:, :, 3]
    by = similarity_between(scene.cameras.c2w[rows], rays.cameras.c2w[rows].detach())
    torch.testing.assert_close(eyes[4:], carried(scene.cameras.c2w, by)[4:, :, 3])
    torch.testing.assert_close(eyes[:4], rays.cameras.c2w[:4, :, 3].detach())
    assert float((eyes - scene.cameras.c2w[:, :, 3]).norm(dim=1).min()) > 0.01


def test_a_shifted_camera_turns_back_to_the_middle_of_the_scene():
    scene = ball_scene()
    refinement = SE3Delta()
    refinement.fit_to(scene)
    with torch.no_grad():
        refinement.shift[:] = torch.tensor([0.01, -0.02, 0.0])
        cameras = refinement(scene.cameras)
    for view in range(6):
        before, after = (project(each, view, torch.zeros(1, 3)) for each in (scene.cameras, cameras))
        torch.testing.assert_close(after, before, atol=5e-3, rtol=0)
        shift = (cameras.c2w[view, :, 3] - scene.cameras.c2w[view, :, 3]).norm()
        torch.testing.assert_close(shift, 3**0.5 * torch.tensor([0.01, 0.02]).norm())


def test_who_moved_far_is_told_from_what_all_did():
    scene, trained = ball_scene(num_views=12), tuple(range(10))
    drifted = replace(scene.cameras, c2w=1.0 * scene.cameras.c2w)
    drifted.c2w[:, :, 3] *= 1.2
    wrong = with_noise(with_noise(replace(scene, cameras=drifted), 0.1, 0.001), 6.0, 0.02, views=[4], seed=3)
    motion = camera_displacements(scene.cameras, wrong.cameras, trained, extent=3**0.5)
    assert far_displaced(motion) == [4]
    assert float(motion[4]) == pytest.approx(0.105 + 0.02 * 4.1 / 3**0.5, rel=0.2)
    assert far_displaced(camera_displacements(scene.cameras, drifted, trained, extent=1.0)) == []


def test_a_restart_puts_the_cameras_back():
    scene = ball_scene()
    train_step = a_step(scene, SE3Delta(), tiny_model(density_bias=0.5))
    torch.nn.init.normal_(train_step.objective.rays.refinement.rotation)
    restart(train_step, torch.optim.SGD(train_step.objective.rays.parameters(), lr=1.0))
    assert torch.equal(train_step.objective.rays.cameras.c2w, scene.cameras.c2w)
    assert torch.equal(train_step.objective.rays.refined((0, 1, 2)).c2w[:3], scene.cameras.c2w[:3])


@pytest.mark.parametrize("blended", [1.0, 0.5])
def test_a_camera_before_packed_samples_has_the_gradient_of_the_reference_in_float64(blended):
    torch.manual_seed(0)
    scene = replace(ball_scene(), refined=True)
    encoder = HashGridEncoder(
        num_levels=3, log2_table_size=10, min_resolution=4, max_resolution=16, blend_in=0.0 if blended == 1.0 else 0.5
    )
    field = NGPField(encoder, SphericalHarmonicsEncoder(3), width=16)
    level = RaggedLevel(OccupancySampler(resolution=8, num_steps=32, opaque_below=0.1), field)
    level.sampler.fit_to(scene)
    field.fit_to(scene)
    torch.nn.init.normal_(encoder.table, std=0.3)
    encoder.on_step(StepContext(0.5 * blended, 0, 0))
    motion = SE3Delta()
    motion.fit_to(scene)
    rays = RayGenerator(scene.cameras, scene.near, scene.far, motion)
    pixels = all_pixels(scene.cameras, 1).map(torch.Tensor.flatten)
    random = batch_random(7, pixels.x.shape[0], torch.device("cpu"))
    weight = torch.rand(pixels.x.shape[0], 3)

    (weight * level(rays(pixels), None, [], random).rgb).sum().backward()

    exact_rays, exact_field = copy.deepcopy(rays).double(), copy.deepcopy(field).double()
    exact_rays.zero_grad()
    samples, features = visible_samples(level.sampler, level.field, rays(pixels), random)
    assert features is not None
    samples = replace(samples, starts=samples.starts.double(), ends=samples.ends.double())
    bundle = exact_rays(pixels)
    output = exact_field(ragged_points(bundle, samples, None))
    output = replace(output, density=output.density.double(), rgb=output.rgb.double())
    (weight * composite_ragged(output, samples, bundle, None).rgb).sum().backward()
    for found, exact in zip(rays.parameters(), exact_rays.parameters(), strict=True):
        assert float(exact.grad[1].abs().min()) > 1e-3
        torch.testing.assert_close(found.grad.double(), exact.grad, rtol=1e-3, atol=1e-4)

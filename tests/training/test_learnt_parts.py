"""What learns in a step beside the model: its own rate, its penalty, its beginning."""

import copy
from dataclasses import replace

import pytest
import torch
from support.learnt_cameras import LearntShifts
from support.scenes import ball_scene, tiny_model
from support.steps import make_step

from nerf_lightning.data.ray_batches import RayBatches
from nerf_lightning.nerf.optimizers.schedule import ExponentialDecay
from nerf_lightning.nerf.randomness import batch_random, fold
from nerf_lightning.training.step import Share


def a_step(tile_points=None, model=None, **settings):
    scene, step = ball_scene(), make_step(tile_points, model)
    step.rays = LearntShifts(scene.cameras, scene.near, scene.far, **settings)
    return step


def batch_of(step):
    return RayBatches(ball_scene(), step.progress, 0, 64).at(0, 0)


def test_a_part_may_learn_at_its_own_rate_which_the_schedule_scales():
    step = a_step(learning_rate=0.25)
    step.build_optimizer = lambda groups: torch.optim.Adam(groups, lr=1e-3, weight_decay=0.1)
    step.schedule = ExponentialDecay(decay_rate=0.5, decay_steps=1)
    optimizer = step.new_optimizer()
    for _ in range(3):
        step(batch_of(step), optimizer)
    model, own = optimizer.param_groups
    assert own["params"] == [step.rays.shift]
    assert not any(parameter is step.rays.shift for parameter in model["params"])
    assert (own["lr"], own["weight_decay"]) == (0.25 / 4, 0.0)
    assert (model["lr"], model["weight_decay"]) == (1e-3 / 4, 0.1)


def test_without_a_rate_of_its_own_it_learns_as_the_model_does():
    (group,) = a_step().new_optimizer().param_groups
    assert any(parameter.shape == (6, 3) for parameter in group["params"])


@pytest.mark.parametrize("tile_points", [None, 16, 200])
@pytest.mark.parametrize("parts", [[slice(0, 64)], [slice(0, 16), slice(16, 64)]])
def test_a_penalty_counts_once_however_the_step_is_cut_and_shared_by_processes(tile_points, parts):
    model = tiny_model(density_bias=0.5).requires_grad_(False)
    light, heavy = (a_step(tile_points, copy.deepcopy(model), weight=weight) for weight in (0.0, 5.0))
    for step in (light, heavy):
        batch = batch_of(step)
        for part in parts:
            step.gradients(batch[part], share=Share(part.start, 64, batch.weight.sum()))
    torch.testing.assert_close(heavy.rays.shift.grad - light.rays.shift.grad, torch.full((6, 3), -10.0))


def test_a_new_attempt_begins_where_the_first_began():
    step = a_step()
    with torch.no_grad():
        step.rays.shift.fill_(3.0)
    step.restart(step.new_optimizer())
    assert float(step.rays.shift.detach().abs().max()) == 0


def test_gradients_and_weights_of_a_part_that_are_not_finite_are_seen():
    step = a_step(weight=1.0)
    with torch.no_grad():
        step.rays.shift[:] = float("inf")
    step(batch_of(step), step.new_optimizer())
    assert step.guard.skipped == 1
    assert step.broken_weights() == "rays"


@pytest.mark.parametrize("tile_points", [None, 60, 200])
def test_what_a_level_adds_to_the_loss_of_its_rays_counts_once_however_the_step_is_cut(tile_points):
    plain, scene = tiny_model(density_bias=0.5), ball_scene()

    class Frowning(type(plain)):
        def forward(self, rays, background, random):
            first, last = super().forward(rays, background, random)
            return [first, replace(last, penalty=rays.photograph * last.depth)]

    frowning = copy.deepcopy(plain)
    frowning.__class__ = Frowning
    losses, gradients = [], []
    for model in (plain, frowning):
        step = make_step(tile_points, model)
        batch = RayBatches(scene, step.progress, 0, 64).at(0, 0)
        seen = step.gradients(batch)
        losses.append(seen.losses)
        gradients.append(torch.cat([each.grad.flatten() for each in model.parameters()]))
    random = batch_random(fold(0, 0, 0), 64)
    rays = replace(step.rays(batch.pixels), photograph=batch.pixels.view)
    last = plain(rays, torch.ones(64, 3), random)[-1]
    penalty = (rays.photograph * last.depth).mean()
    torch.testing.assert_close(losses[1] - losses[0], torch.stack([torch.zeros(()), penalty.detach()]))
    plain.zero_grad()
    penalty.backward()
    alone = torch.cat(
        [torch.zeros_like(each).flatten() if each.grad is None else each.grad.flatten() for each in plain.parameters()]
    )
    torch.testing.assert_close(gradients[1] - gradients[0], alone, atol=1e-4, rtol=1e-3)


def test_a_part_of_a_model_may_learn_at_its_own_rate():
    step = make_step(None, tiny_model())
    field = step.model.last.field
    field.learning_rate = 0.5
    step.build_optimizer = lambda groups: torch.optim.Adam(groups, lr=1e-3)
    others, quick = step.new_optimizer().param_groups
    own = {id(each) for each in field.parameters()}
    assert (quick["lr"], others["lr"]) == (0.5, 1e-3)
    assert {id(each) for each in quick["params"]} == own
    assert len(others["params"]) + len(own) == len(list(step.model.parameters()))

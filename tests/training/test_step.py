import copy
from dataclasses import replace

import pytest
import torch
from support.learnt_cameras import LearntShifts
from support.scenes import ball_scene, tiny_model
from support.stand_in_device import StandInDevice
from support.steps import gradients, make_step, rays_of

from nerf_lightning.compute import ranks
from nerf_lightning.data.ray_batches import RayBatches
from nerf_lightning.messages.errors import InputError
from nerf_lightning.nerf.losses.mse import MeanSquaredError
from nerf_lightning.nerf.losses.robust import RobustLoss
from nerf_lightning.nerf.models.render_image import render_picture
from nerf_lightning.nerf.optimizers.schedule import ExponentialDecay
from nerf_lightning.nerf.randomness import batch_random, fold
from nerf_lightning.training.attempts import draw_weights, restart
from nerf_lightning.training.gradients.tiles import Share
from nerf_lightning.training.step_guard import StepGuard, first_not_finite
from nerf_lightning.training.system import RadianceFieldSystem


@pytest.mark.parametrize(
    ("tile_points", "background"), [(16, "random"), (100, "white"), (100, "black"), (512, "random"), (512, "none")]
)
def test_a_tiled_step_equals_the_whole_step_up_to_rounding(tile_points, background):
    scene = ball_scene()
    model = tiny_model(density_bias=0.5)
    whole, losses = gradients(make_step(None, copy.deepcopy(model), background), scene)
    tiled, tiled_losses = gradients(make_step(tile_points, copy.deepcopy(model), background), scene)
    torch.testing.assert_close(tiled, whole, rtol=1e-4, atol=1e-6)
    torch.testing.assert_close(tiled_losses, losses, rtol=1e-5, atol=1e-7)
    assert float(whole.norm()) > 0


def test_clipping_scales_the_whole_gradient_whose_norms_are_measured_before_for_each_level():
    gradient, _ = gradients(make_step(100, clip_norm=1e-3), ball_scene())
    assert abs(float(gradient.norm()) - 1e-3) < 1e-6
    clipped, whole = make_step(100, clip_norm=1e-3), make_step(100)
    scene = ball_scene()
    batch = RayBatches(scene, clipped.progress, 0, 64).batch_at(0, 0)
    seen = clipped(batch, clipped.new_optimizer(), measure_gradients=True)
    RayBatches(scene, whole.progress, 0, 64)
    assert whole(batch, whole.new_optimizer()).gradient_norms == {}
    for name, level in whole.objective.model.levels.items():
        expected = torch.cat([parameter.grad.flatten() for parameter in level.parameters()]).norm()
        assert float(expected) > 1e-3
        torch.testing.assert_close(seen.gradient_norms[name], expected)


def test_a_step_whose_gradients_are_not_finite_is_left_out_and_counted():
    train_step, steps = make_step(None), []
    optimizer = train_step.new_optimizer()
    optimizer.step = lambda: steps.append(train_step.progress.step)
    color = train_step.objective.model.levels["fine"].field.color_head.weight
    good, broken = color.detach().clone(), torch.full_like(color, float("nan"))
    loader = RayBatches(ball_scene(), train_step.progress, 0, 64)
    for weights in (good, broken, broken, good):
        with torch.no_grad():
            color.copy_(weights)
        train_step(loader.batch_at(0, train_step.progress.rays_seen), optimizer)
    assert steps == [0, 3]
    assert train_step.guard.skipped == 2
    assert train_step.guard.state() == [2, 0]
    assert train_step.progress.step == 4


def test_weights_are_a_function_of_seed_and_attempt_and_zero_is_a_seed():
    states = []
    for seed, attempt in [(0, 0), (0, 0), (1, 0), (0, 1)]:
        torch.rand(3)  # what was drawn before must not matter
        train_step = make_step(None, seed=seed)
        train_step.progress.attempt = attempt
        draw_weights(train_step)
        states.append(torch.cat([p.detach().flatten() for p in train_step.objective.model.parameters()]))
    assert torch.equal(states[0], states[1])
    assert not torch.equal(states[0], states[2])
    assert not torch.equal(states[0], states[3])


@pytest.fixture
def one_thread():
    """What is tried is tried in order: several threads would each take a tile."""
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    yield
    torch.set_num_threads(before)


def stingy_model(room):
    """A model that has room for so many rays at once, and a list of what was tried."""
    model, tried = tiny_model(density_bias=0.5), []
    render = model.forward

    def forward(rays, background, random):
        tried.append(rays.near.numel())
        if tried[-1] > room:
            raise torch.OutOfMemoryError("CUDA out of memory")
        return render(rays, background, random)

    model.forward = forward
    return model, tried


def test_without_memory_tiles_are_halved_until_a_single_ray_does_not_fit(caplog, one_thread):
    scene = ball_scene()
    wanted, losses = gradients(make_step(100_000), scene)
    model, tried = stingy_model(room=20)
    got, got_losses = gradients(make_step(2_000, model=model), scene)
    assert torch.allclose(got, wanted, atol=1e-6)
    assert torch.allclose(got_losses, losses)
    assert tried[0] == 64
    assert tried[-1] <= 20
    assert "out of memory: reducing tiles to" in caplog.text
    with pytest.raises(InputError, match="There is no memory"):
        gradients(make_step(100_000, model=stingy_model(room=0)[0]), ball_scene())


def test_without_memory_pictures_are_rendered_in_smaller_tiles_from_then_on(caplog, one_thread):
    scene = ball_scene()
    wanted = render_picture(tiny_model(density_bias=0.5), rays_of(scene), 1, "white", 10**6)
    model, tried = stingy_model(room=40)
    for _ in range(2):
        picture = render_picture(model, rays_of(scene), 1, "white", 10**6)
    torch.testing.assert_close(picture.rgb, wanted.rgb)
    assert tried[:3] == [144, 72, 36]
    assert max(tried[3:]) == 36
    assert caplog.text.count("from now on") == 2


def robust_step(tile_points, patch=4):
    train_step = make_step(tile_points)
    train_step.objective.loss = RobustLoss(MeanSquaredError(), patch=patch)
    train_step.objective.loss.threshold.fill_(0.05)  # leaves some out
    return train_step


@pytest.mark.parametrize("tile_points", [40, 300, 700])
def test_tiles_never_part_the_squares_of_a_robust_loss(tile_points):
    scene, found = ball_scene(), []
    for train_step in (robust_step(None), robust_step(tile_points)):
        loader = RayBatches(scene, train_step.progress, 0, 64, patch=4)
        seen = train_step(loader.batch_at(0, 0), train_step.new_optimizer())
        flat = torch.cat([p.grad.flatten() for p in train_step.objective.model.parameters()])
        found.append((flat, seen.losses, train_step.objective.loss.threshold))
    torch.testing.assert_close(found[0], found[1], rtol=1e-4, atol=1e-6)
    assert float(found[0][2]) != pytest.approx(0.05)
    plain = make_step(None)
    plain(RayBatches(scene, plain.progress, 0, 64, patch=4).batch_at(0, 0), plain.new_optimizer())
    assert not torch.allclose(found[0][0], torch.cat([p.grad.flatten() for p in plain.objective.model.parameters()]))


def test_a_step_that_is_left_out_teaches_a_robust_loss_nothing_and_smaller_batches_hold_whole_squares():
    train_step = robust_step(None)
    loader, optimizer = RayBatches(ball_scene(), train_step.progress, 0, 64, patch=4), train_step.new_optimizer()
    with torch.no_grad():
        train_step.objective.model.levels["fine"].field.color_head.weight.fill_(float("nan"))
    train_step(loader.batch_at(0, 0), optimizer)
    assert float(train_step.objective.loss.threshold) == pytest.approx(0.05)
    restart(train_step, optimizer)
    assert float(train_step.objective.loss.threshold) == 1.0
    train_step = make_step(None, sample_budget=8 * 40)
    train_step.objective.loss = RobustLoss(MeanSquaredError(), patch=4)
    loader = RayBatches(ball_scene(), train_step.progress, 0, 64, patch=4)
    train_step(loader.batch_at(0, 0), train_step.new_optimizer())
    assert train_step.progress.batch_rays == 16


def test_weights_that_are_not_finite_are_not_saved():
    system = RadianceFieldSystem(make_step(None), {})
    system._trainer = type("T", (), {"global_step": 7, "default_root_dir": "outputs/x"})()
    with torch.no_grad():
        system.model.levels["fine"].field.color_head.bias[0] = float("inf")
    with pytest.raises(InputError, match=r"weights of step 7 are not finite.*optimizer\.lr"):
        system.on_save_checkpoint({})


def a_step_with_shifts(tile_points=None, model=None, **settings):
    scene, train_step = ball_scene(), make_step(tile_points, model)
    train_step.objective.rays = LearntShifts(scene.cameras, scene.near, scene.far, **settings)
    return train_step


def batch_of(train_step):
    return RayBatches(ball_scene(), train_step.progress, 0, 64).batch_at(0, 0)


def test_a_part_may_learn_at_its_own_rate_which_the_schedule_scales_or_as_the_model_does():
    train_step = a_step_with_shifts(learning_rate=0.25)
    train_step.build_optimizer = lambda groups: torch.optim.Adam(groups, lr=1e-3, weight_decay=0.1)
    train_step.schedule = ExponentialDecay(decay_rate=0.5, decay_steps=1)
    optimizer = train_step.new_optimizer()
    for _ in range(3):
        train_step(batch_of(train_step), optimizer)
    model, own = optimizer.param_groups
    assert own["params"] == [train_step.objective.rays.shift]
    assert not any(parameter is train_step.objective.rays.shift for parameter in model["params"])
    assert (own["lr"], own["weight_decay"]) == (0.25 / 4, 0.0)
    assert (model["lr"], model["weight_decay"]) == (1e-3 / 4, 0.1)
    (group,) = a_step_with_shifts().new_optimizer().param_groups
    assert any(parameter.shape == (6, 3) for parameter in group["params"])
    train_step = make_step(None, tiny_model())
    field = train_step.objective.model.last.field
    field.learning_rate = 0.5
    train_step.build_optimizer = lambda groups: torch.optim.Adam(groups, lr=1e-3)
    others, quick = train_step.new_optimizer().param_groups
    own = {id(each) for each in field.parameters()}
    assert (quick["lr"], others["lr"]) == (0.5, 1e-3)
    assert {id(each) for each in quick["params"]} == own
    assert len(others["params"]) + len(own) == len(list(train_step.objective.model.parameters()))


@pytest.mark.parametrize(
    ("tile_points", "parts"), [(None, [slice(0, 64)]), (16, [slice(0, 64)]), (200, [slice(0, 16), slice(16, 64)])]
)
def test_a_penalty_counts_once_however_the_step_is_cut_and_shared_by_processes(tile_points, parts):
    model = tiny_model(density_bias=0.5).requires_grad_(False)
    light, heavy = (a_step_with_shifts(tile_points, copy.deepcopy(model), weight=weight) for weight in (0.0, 5.0))
    for train_step in (light, heavy):
        batch = batch_of(train_step)
        for part in parts:
            train_step.gradients(batch[part], train_step.key, Share(part.start, 64))
    torch.testing.assert_close(
        heavy.objective.rays.shift.grad - light.objective.rays.shift.grad, torch.full((6, 3), -10.0)
    )


def test_a_whole_batch_needs_no_other_process(monkeypatch):
    train_step = a_step_with_shifts()
    monkeypatch.setattr(ranks, "world_size", lambda: 2)  # the first process measures tiles while the other waits
    train_step.tiles(batch_of(train_step), train_step.key)
    with pytest.raises(ValueError, match="process group"):
        train_step.tiles(batch_of(train_step), train_step.key, Share(0, 128))


def test_parts_that_are_not_finite_are_seen_and_a_new_attempt_begins_where_the_first_began():
    train_step = a_step_with_shifts()
    with torch.no_grad():
        train_step.objective.rays.shift.fill_(3.0)
    restart(train_step, train_step.new_optimizer())
    assert float(train_step.objective.rays.shift.detach().abs().max()) == 0
    train_step = a_step_with_shifts(weight=1.0)
    with torch.no_grad():
        train_step.objective.rays.shift[:] = float("inf")
    train_step(batch_of(train_step), train_step.new_optimizer())
    assert train_step.guard.skipped == 1
    assert first_not_finite(train_step.objective.named_weights()) == "rays"


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
        train_step = make_step(tile_points, model)
        batch = RayBatches(scene, train_step.progress, 0, 64).batch_at(0, 0)
        seen = train_step.gradients(batch, train_step.key)
        losses.append(seen.losses)
        gradients.append(torch.cat([each.grad.flatten() for each in model.parameters()]))
    random = batch_random(fold(0, 0, 0), 64)
    rays = replace(train_step.objective.rays(batch.pixels), photograph=batch.pixels.view)
    last = plain(rays, torch.ones(64, 3), random)[-1]
    penalty = (rays.photograph * last.depth).mean()
    torch.testing.assert_close(losses[1] - losses[0], torch.stack([torch.zeros(()), penalty.detach()]))
    plain.zero_grad()
    penalty.backward()
    alone = torch.cat(
        [torch.zeros_like(each).flatten() if each.grad is None else each.grad.flatten() for each in plain.parameters()]
    )
    torch.testing.assert_close(gradients[1] - gradients[0], alone, atol=1e-4, rtol=1e-3)


NAN, INFINITE = float("nan"), float("inf")
GOOD = [1e-30, -0.0, -3.0]


def parameters_with(device, *gradients):
    for number, gradient in enumerate(gradients):
        parameter = torch.nn.Parameter(torch.zeros(len(gradient), device=device))
        parameter.grad = torch.zeros_like(parameter)
        for place, value in enumerate(gradient):
            parameter.grad[place] = value
        yield f"part{number}.weight", parameter


def steps_taken(guard, device):
    """Whether each step is allowed, and the gradients that are left."""
    for value in (1.0, NAN, -INFINITE, 1.0, INFINITE):
        named = list(parameters_with(device, GOOD, [], [1.0, value], [value]))
        losses = torch.full((2,), 0.5, device=device)
        allowed = guard.allows(losses, named)
        yield allowed, torch.cat([parameter.grad for _, parameter in named]).cpu()


def test_on_the_cpu_steps_are_left_out_and_counted():
    guard = StepGuard()
    assert [allowed for allowed, _ in steps_taken(guard, torch.device("cpu"))] == [True, False, False, True, False]
    assert guard.state() == [3, 1]
    assert guard.first_module == "part2"


@pytest.mark.parametrize("kind", ["cuda", "mps"])
def test_elsewhere_their_gradients_become_zeros_and_others_keep_their_bits(kind):
    guard = StepGuard()
    with StandInDevice(kind) as there:
        seen = list(steps_taken(guard, there.device))
        assert guard.state() == [3, 1]
        assert guard.first_module == "part2"
    for number, (allowed, left) in enumerate(seen):
        expected = torch.tensor([*GOOD, 1.0, 1.0, 1.0]) if number in (0, 3) else torch.zeros(6)
        assert allowed
        assert torch.equal(left.view(torch.int32), expected.view(torch.int32))


@pytest.mark.parametrize("losses", [[NAN, 0.0], [0.0, INFINITE]])
def test_a_loss_that_is_not_finite_is_the_first_where_no_gradient_shows_it(losses):
    guard = StepGuard()
    assert not guard.allows(torch.tensor(losses), parameters_with("cpu", GOOD))
    assert guard.first_module == "loss"
    assert guard.allows(torch.zeros(2), parameters_with("cpu", GOOD))
    assert guard.allows(torch.zeros(2), parameters_with("cpu", GOOD, [1e38, -1e38]))
    assert guard.state() == [1, 0]

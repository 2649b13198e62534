import copy

import pytest
import torch
from support.scenes import ball_scene, tiny_model
from support.steps import gradients, make_step, rays_of

from nerf_lightning.data.ray_batches import RayBatches
from nerf_lightning.messages.errors import InputError
from nerf_lightning.nerf.losses.mse import MeanSquaredError
from nerf_lightning.nerf.losses.robust import RobustLoss
from nerf_lightning.nerf.models.render_image import render_picture
from nerf_lightning.nerf.optimizers.schedule import ExponentialDecay


@pytest.mark.parametrize("background", ["white", "black", "random", "none"])
@pytest.mark.parametrize("tile_points", [16, 100, 512])
def test_a_tiled_step_equals_the_whole_step_up_to_rounding(tile_points, background):
    scene = ball_scene()
    model = tiny_model(density_bias=0.5)
    whole, losses = gradients(make_step(None, copy.deepcopy(model), background), scene)
    tiled, tiled_losses = gradients(make_step(tile_points, copy.deepcopy(model), background), scene)
    torch.testing.assert_close(tiled, whole, rtol=1e-4, atol=1e-6)
    torch.testing.assert_close(tiled_losses, losses, rtol=1e-5, atol=1e-7)
    assert float(whole.norm()) > 0


def test_clipping_scales_the_whole_gradient():
    gradient, _ = gradients(make_step(100, clip_norm=1e-3), ball_scene())
    assert abs(float(gradient.norm()) - 1e-3) < 1e-6


def test_the_gradients_of_each_level_are_measured_when_asked_for_and_before_they_are_clipped():
    clipped, whole = make_step(100, clip_norm=1e-3), make_step(100)
    scene = ball_scene()
    batch = RayBatches(scene, clipped.progress, 0, 64).at(0, 0)
    seen = clipped(batch, clipped.new_optimizer(), measure_gradients=True)
    RayBatches(scene, whole.progress, 0, 64)
    assert whole(batch, whole.new_optimizer()).gradient_norms == {}
    for name, level in whole.model.levels.items():
        expected = torch.cat([parameter.grad.flatten() for parameter in level.parameters()]).norm()
        assert float(expected) > 1e-3
        torch.testing.assert_close(seen.gradient_norms[name], expected)


def test_batch_norm_with_tiles_is_refused_by_name():
    with pytest.raises(InputError, match=r"field\.batch_norm=true .* trainer\.tile_points=null"):
        make_step(64, tiny_model(batch_norm=True))
    make_step(None, tiny_model(batch_norm=True))


def test_a_step_whose_gradients_are_not_finite_is_left_out_and_counted():
    step, steps = make_step(None), []
    optimizer = step.new_optimizer()
    optimizer.step = lambda: steps.append(step.progress.step)
    color = step.model.levels["fine"].field.color_head.weight
    good, broken = color.detach().clone(), torch.full_like(color, float("nan"))
    loader = RayBatches(ball_scene(), step.progress, 0, 64)
    for weights in (good, broken, broken, good):
        with torch.no_grad():
            color.copy_(weights)
        step(loader.at(0, step.progress.rays_seen), optimizer)
    assert steps == [0, 3]
    assert step.guard.skipped == 2
    assert step.guard.state() == [2, 0]
    assert step.progress.step == 4


def test_gradients_that_stay_not_finite_are_counted_and_their_module_is_named():
    step = make_step(None)
    with torch.no_grad():
        step.model.levels["fine"].field.color_head.weight.fill_(float("nan"))
    gradients(step, ball_scene(), steps=7)
    assert step.guard.in_row == 7
    assert step.guard.first_module.startswith("levels.fine.field.")
    assert not step.all_finite()
    assert step.broken_weights() == "levels.fine.field.color_head"


def test_a_run_that_starts_from_weights_restarts_from_them():
    step = make_step(None)
    weights = {name: torch.full_like(value, 0.25) for name, value in step.model.named_parameters()}
    step.start_weights = step.model.state_dict() | weights
    step.draw_weights()
    assert all(bool((parameter == 0.25).all()) for parameter in step.model.parameters())


def test_weights_are_a_function_of_seed_and_attempt_and_zero_is_a_seed():
    states = []
    for seed, attempt in [(0, 0), (0, 0), (1, 0), (0, 1)]:
        torch.rand(3)  # what was drawn before must not matter
        step = make_step(None, seed=seed)
        step.progress.attempt = attempt
        step.draw_weights()
        states.append(torch.cat([p.detach().flatten() for p in step.model.parameters()]))
    assert torch.equal(states[0], states[1])
    assert not torch.equal(states[0], states[2])
    assert not torch.equal(states[0], states[3])


def test_the_learning_rate_follows_the_schedule():
    step = make_step(None)
    step.schedule = ExponentialDecay(decay_rate=0.5, decay_steps=1, warmup_steps=2)
    rates = []
    loader, optimizer = RayBatches(ball_scene(), step.progress, 0, 16), step.new_optimizer()
    for _ in range(4):
        step(loader.at(0, 0), optimizer)
        rates.append(optimizer.param_groups[0]["lr"])
    assert rates == [0.5, 0.5, 0.25, 0.125]


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


def test_without_memory_the_tile_is_halved_and_the_step_repeated(caplog, one_thread):
    scene = ball_scene()
    wanted, losses = gradients(make_step(100_000), scene)
    model, tried = stingy_model(room=20)
    got, got_losses = gradients(make_step(2_000, model=model), scene)
    assert torch.allclose(got, wanted, atol=1e-6)
    assert torch.allclose(got_losses, losses)
    assert tried[0] == 64
    assert tried[-1] <= 20
    assert "from now on tiles of" in caplog.text


def test_without_memory_for_a_single_ray_the_run_ends_with_advice():
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


def test_fields_are_compiled_for_static_shapes_where_torch_can_see_into_them(monkeypatch):
    model, compiled = tiny_model(), []
    monkeypatch.setattr(torch.nn.Module, "compile", lambda module, **options: compiled.append((module, options)))
    model.levels["coarse"].field.compiles = False
    assert model.compile_fields() == ["fine"]
    assert compiled == [(model.levels["fine"].field, {"dynamic": False})]


def robust_step(tile_points, patch=4):
    step = make_step(tile_points)
    step.loss = RobustLoss(MeanSquaredError(), patch=patch)
    step.loss.threshold.fill_(0.05)  # leaves some out
    return step


@pytest.mark.parametrize("tile_points", [40, 300, 700])
def test_tiles_never_part_the_squares_of_a_robust_loss(tile_points):
    scene, found = ball_scene(), []
    for step in (robust_step(None), robust_step(tile_points)):
        loader = RayBatches(scene, step.progress, 0, 64, patch=4)
        seen = step(loader.at(0, 0), step.new_optimizer())
        flat = torch.cat([p.grad.flatten() for p in step.model.parameters()])
        found.append((flat, seen.losses, step.loss.threshold))
    torch.testing.assert_close(found[0], found[1], rtol=1e-4, atol=1e-6)
    assert float(found[0][2]) != pytest.approx(0.05)
    plain = make_step(None)
    plain(RayBatches(scene, plain.progress, 0, 64, patch=4).at(0, 0), plain.new_optimizer())
    assert not torch.allclose(found[0][0], torch.cat([p.grad.flatten() for p in plain.model.parameters()]))


def test_a_step_that_is_left_out_teaches_a_robust_loss_nothing_and_a_restart_lets_it_forget():
    step = robust_step(None)
    loader, optimizer = RayBatches(ball_scene(), step.progress, 0, 64, patch=4), step.new_optimizer()
    with torch.no_grad():
        step.model.levels["fine"].field.color_head.weight.fill_(float("nan"))
    step(loader.at(0, 0), optimizer)
    assert float(step.loss.threshold) == pytest.approx(0.05)
    step.restart(optimizer)
    assert float(step.loss.threshold) == 1.0


def test_smaller_batches_hold_whole_squares():
    step = make_step(None, sample_budget=8 * 40)
    step.loss = RobustLoss(MeanSquaredError(), patch=4)
    loader = RayBatches(ball_scene(), step.progress, 0, 64, patch=4)
    step(loader.at(0, 0), step.new_optimizer())
    assert step.progress.batch_rays == 16

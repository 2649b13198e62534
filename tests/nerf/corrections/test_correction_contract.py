"""What every correction of conf/ keeps to."""

import copy
from dataclasses import replace

import pytest
import torch
from support.configs import composed, options
from support.scenes import ball_scene, tiny_model
from support.steps import make_step

from nerf_lightning.config.instantiate import build
from nerf_lightning.data.ray_batches import RayBatches
from nerf_lightning.messages.errors import InputError
from nerf_lightning.nerf.models.render_image import render_picture
from nerf_lightning.nerf.types.rays import PixelIndex
from nerf_lightning.training.attempts import restart

LEARNT = sorted(set(options("correction")) - {"none", "auto"})


def correction_of(option, scene):
    correction = build(composed("train", f"correction={option}").correction)
    correction.fit_to(scene)
    return correction


def a_step(option, scene, background="white", tile_points=None):
    train_step = make_step(tile_points, copy.deepcopy(tiny_model(density_bias=0.5)), background)
    train_step.objective.correction = correction_of(option, scene)
    return train_step


@pytest.mark.parametrize("option", options("correction"))
@pytest.mark.parametrize("background", ["none", "white", "random"])
def test_as_it_begins_it_changes_no_bit_of_a_step(option, background):
    scene, found = ball_scene(), []
    for name in ("none", option):
        train_step = a_step(name, scene, background, tile_points=200)
        batch = RayBatches(scene, train_step.progress, 0, 64).batch_at(0, 0)
        losses = train_step(batch, train_step.new_optimizer()).losses
        found.append([losses, *(parameter.grad for parameter in train_step.objective.model.parameters())])
    for ours, theirs in zip(*found, strict=True):
        assert torch.equal(ours, theirs)


@pytest.mark.parametrize("option", LEARNT)
def test_it_learns_from_the_photographs_that_train_and_only_of_them(option):
    scene = ball_scene(num_views=8)
    train_step = a_step(option, scene)
    train_step.build_optimizer = lambda groups: torch.optim.Adam(groups, lr=1e-3)
    optimizer, loader = train_step.new_optimizer(), RayBatches(scene, train_step.progress, 0, 64)
    for _ in range(3):
        train_step(loader.batch_at(0, train_step.progress.rays_seen), optimizer)
    for parameter in train_step.objective.correction.parameters():
        assert float(parameter.detach().abs().max()) > 0
        if len(parameter) == 8:
            trained = torch.zeros(8, dtype=torch.bool).index_fill(0, torch.tensor(scene.splits["train"]), True)
            assert float(parameter.detach()[~trained].abs().sum()) == 0
    restart(train_step, optimizer)
    assert all(float(parameter.detach().abs().max()) == 0 for parameter in train_step.objective.correction.parameters())


@pytest.mark.parametrize("option", LEARNT)
def test_gradients_are_finite_for_whatever_colours_and_what_is_taken_back_is_what_was_there(option):
    scene = ball_scene()
    correction = correction_of(option, scene)
    with torch.no_grad():
        for parameter in correction.parameters():
            parameter.uniform_(-2, 2)
    rgb = torch.tensor([0.0, 1e-20, 0.04, 0.5, 1.0, 1.3]).expand(3, 6).T.clone().requires_grad_()
    view, x, y = (torch.arange(6), torch.tensor([0, 3, 6, 9, 11, 0]), torch.tensor([0, 11, 0, 5, 6, 11]))
    shown = correction(rgb, PixelIndex(view, x, y))
    assert not torch.allclose(shown, rgb)
    back = correction.neutral(shown, PixelIndex(view, x, y))
    assert back is None or torch.allclose(back, rgb, atol=1e-5)
    shown.sum().backward()
    for tensor in (shown, rgb.grad, *(parameter.grad for parameter in correction.parameters())):
        assert bool(torch.isfinite(tensor).all())


@pytest.mark.parametrize("option", LEARNT)
@pytest.mark.parametrize("background", ["black", "white", "random"])
def test_the_background_looks_the_same_to_all(option, background):
    """No camera saw it: where nothing is, a correction changes neither what is shown nor what is asked for."""
    scene = ball_scene()
    scene = replace(scene, pixels=replace(scene.pixels, rgba=torch.zeros_like(scene.pixels.rgba)))
    train_step = make_step(None, tiny_model(density_bias=-30.0), background)
    train_step.objective.correction = correction_of(option, scene)
    with torch.no_grad():
        for parameter in train_step.objective.correction.parameters():
            parameter.uniform_(-1, 1)
    seen = train_step.gradients(RayBatches(scene, train_step.progress, 0, 64).batch_at(0, 0), train_step.key)
    torch.testing.assert_close(seen.rgb, seen.target)
    behind = seen.target
    assert background == "random" or torch.equal(behind, torch.full_like(behind, float(background == "white")))


@pytest.mark.parametrize("option", LEARNT)
def test_pictures_and_validation_show_the_neutral_colours(option):
    from nerf_lightning.training.validation import RayErrors

    scene = ball_scene()
    train_step, errors = a_step(option, scene), []
    batch = RayBatches(scene, train_step.progress, 0, 64).batch_at(0, 0)
    pictures = []
    for spread in (0.0, 2.0):
        with torch.no_grad():
            for parameter in train_step.objective.correction.parameters():
                parameter.uniform_(-spread, spread)
            seen = RayErrors()
            seen.of(train_step.objective, batch, None)
        errors.append(torch.cat(seen.parts))
        pictures.append(
            render_picture(train_step.objective.model.eval(), train_step.objective.rays, 0, "white", 4096).rgb
        )
    assert torch.equal(*pictures)
    assert torch.equal(*errors)


@pytest.mark.parametrize("option", LEARNT)
def test_one_photograph_has_nothing_to_differ_from(option):
    scene = ball_scene(num_views=2)
    scene.splits["train"] = (0,)
    with pytest.raises(InputError, match=r"trains on one photograph.*correction=none"):
        correction_of(option, scene)
    correction_of("none", scene)

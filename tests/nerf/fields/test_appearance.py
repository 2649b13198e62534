"""A code for each photograph, which its colours depend on."""

from dataclasses import replace

import pytest
import torch
from support.configs import composed
from support.scenes import ball_scene
from support.steps import make_step

from nerf_lightning.config.instantiate import build
from nerf_lightning.data.ray_batches import RayBatches
from nerf_lightning.messages.errors import InputError
from nerf_lightning.nerf.models.render_image import render_picture
from nerf_lightning.nerf.types.points import Points

SMALL = ("encoder.log2_table_size=10", "encoder.num_levels=3", "field.width=16")


def a_model(model="fast_small", appearance=4):
    found = build(composed("train", f"model={model}", *SMALL, f"field.appearance={appearance}").model)
    found.fit_to(ball_scene(num_views=8))
    return found


def a_step(model):
    step = make_step(None, model)
    step.build_optimizer = lambda groups: torch.optim.Adam(groups, lr=1e-2)
    return step


@pytest.mark.parametrize("model", ["fast_small", "fast_proposal"])
def test_codes_learn_from_their_own_photographs_and_pictures_have_their_mean(model):
    scene, step = ball_scene(num_views=8), a_step(a_model(model))
    optimizer, loader = step.new_optimizer(), RayBatches(scene, step.progress, 0, 64)
    for _ in range(3):
        step(loader.at(0, step.progress.rays_seen), optimizer)
    field, trained = step.model.last.field, list(scene.splits["train"])
    codes = field.codes.detach()
    others = [view for view in range(8) if view not in trained]
    assert float(codes[trained].abs().amax(dim=1).min()) > 0
    assert float(codes[others].abs().max()) == 0
    points = Points(torch.rand(5, 3) - 0.5, torch.nn.functional.normalize(torch.randn(5, 3), dim=-1))
    neutral = field(points).rgb
    with torch.no_grad():
        codes[others[0]] = codes[trained].mean(dim=0)
    mean = field(replace(points, photograph=torch.full((5,), others[0]))).rgb
    torch.testing.assert_close(neutral, mean)
    assert not torch.allclose(field(replace(points, photograph=torch.full((5,), trained[0]))).rgb, mean)


def test_a_new_model_takes_the_codes_of_a_checkpoint():
    step = a_step(a_model())
    step(RayBatches(ball_scene(num_views=8), step.progress, 0, 64).at(0, 0), step.new_optimizer())
    again = build(composed("train", "model=fast_small", *SMALL, "field.appearance=4").model)
    again.load_state_dict(step.model.state_dict())
    pictures = [render_picture(each.eval(), step.rays, 0, "white", 4096).rgb for each in (step.model, again)]
    assert torch.equal(*pictures)


def test_codes_of_no_view_are_refused():
    state = a_model().state_dict()
    state["levels.fine.field.trained"][0] = 8
    with pytest.raises(InputError, match="codes"):
        a_model().load_state_dict(state)


def test_one_photograph_has_nothing_to_differ_from():
    scene = ball_scene(num_views=2)
    scene.splits["train"] = (0,)
    with pytest.raises(InputError, match=r"trains on one photograph.*field\.appearance=0"):
        build(composed("train", "model=fast_small", *SMALL, "field.appearance=4").model).fit_to(scene)

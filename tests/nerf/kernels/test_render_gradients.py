"""Whole rays in one kernel with gradients, against march, field and quadrature one after the other."""

from dataclasses import replace

import pytest
import torch
from support.ragged_levels import a_level, needs_bfloat16
from support.scenes import some_rays

from nerf_lightning.nerf.fields.ngp_field import NGPField
from nerf_lightning.nerf.kernels.backends import without
from nerf_lightning.nerf.kernels.render import gradients as kernels
from nerf_lightning.nerf.randomness import batch_random
from nerf_lightning.nerf.types.renderings import RaggedRendering


def learnt(level, rays, random, weight, background=None):
    """Return what is seen, and the gradients of what all of it comes to."""
    level.zero_grad(set_to_none=True)
    seen = level(rays, background, [], random)
    shown = torch.cat([seen.rgb, seen.foreground, seen.opacity[:, None], seen.depth[:, None]], dim=1)
    (shown * weight).sum().backward()
    return shown.detach(), {name: each.grad.clone() for name, each in level.named_parameters()}


def far_apart(found, expected):
    return float((found - expected).norm() / expected.norm().clamp(min=1e-20))


@pytest.mark.parametrize("jitter", [True, False])
@pytest.mark.parametrize(
    ("matmul_precision", "most"), [("float32", 2e-4), pytest.param("bfloat16", 0.02, marks=needs_bfloat16)]
)
@pytest.mark.parametrize(("features", "color_layers"), [(2, 1), (4, 2)])
@pytest.mark.parametrize(("opaque_below", "bias"), [(0.0, 1.0), (1e-3, 4.0)])
def test_it_sees_and_learns_what_the_single_kernels_do(
    jitter, matmul_precision, most, features, color_layers, opaque_below, bias
):
    level = a_level(opaque_below, 32, features, matmul_precision, density_bias=bias, color_layers=color_layers)
    level.returns_weights = False
    rays, random = some_rays(700), batch_random(3, 700) if jitter else None
    weight, background = torch.randn(700, 8), torch.rand(700, 3)
    seen, gradients = learnt(level, rays, random, weight, background)
    asked = int(level.counter.counts[0])
    level.reset_statistics()
    with without("render.gradients"):
        expected, of_single = learnt(level, rays, random, weight, background)
    assert 0.1 < float(expected[:, 6].mean()) < 0.9
    assert far_apart(seen, expected) < most
    assert gradients.keys() == of_single.keys()
    for name, gradient in gradients.items():
        assert far_apart(gradient, of_single[name]) < 5 * most, name
    # What lies behind an opaque sample is not asked about.
    assert asked == int(level.counter.counts[0]) if opaque_below == 0.0 else asked < int(level.counter.counts[0])


def test_what_a_part_has_no_room_for_is_rendered_again(monkeypatch):
    level, rays = a_level(density_bias=3.0), some_rays(300)
    level.returns_weights = False
    weight = torch.randn(300, 8)
    seen, gradients = learnt(level, rays, None, weight)
    monkeypatch.setattr(kernels, "_spare", [])
    monkeypatch.setattr(kernels, "SPARE_BLOCKS", 1)
    monkeypatch.setattr(level, "points_per_ray", lambda before, training: 0.0)
    again, of_again = learnt(level, rays, None, weight)
    assert torch.equal(seen, again)
    assert all(torch.equal(gradient, of_again[name]) for name, gradient in gradients.items())


@pytest.mark.parametrize("threads", [1, 2])
def test_many_rays_are_shared_out_and_nothing_changes(threads):
    level, rays = a_level(density_bias=3.0), some_rays(600)
    level.returns_weights = False
    weight, before = torch.randn(600, 8), torch.get_num_threads()
    try:
        torch.set_num_threads(threads)
        seen, gradients = learnt(level, rays, None, weight)
        again, of_again = learnt(level, rays, None, weight)
        torch.set_num_threads(1)
        alone, of_alone = learnt(level, rays, None, weight)
    finally:
        torch.set_num_threads(before)
    assert torch.equal(seen, again)
    assert torch.equal(seen, alone)
    for name, gradient in gradients.items():
        assert torch.equal(gradient, of_again[name])
        assert far_apart(gradient, of_alone[name]) < 1e-5


def test_it_goes_the_other_way_where_something_else_is_wanted():
    level, rays = a_level(density_bias=3.0), some_rays(50)
    assert isinstance(level(rays, None, [], None), RaggedRendering)  # as a notebook wants it
    assert not level.takes_whole_rays(rays)
    level.returns_weights = False
    assert level.takes_whole_rays(rays)
    assert not isinstance(level(rays, None, [], None), RaggedRendering)
    with torch.no_grad():
        assert isinstance(level(rays, None, [], batch_random(0, 50)), RaggedRendering)
    turned = replace(rays, origins=rays.origins.clone().requires_grad_())
    assert isinstance(level(turned, None, [], None), RaggedRendering)
    level.field.__class__ = type("Other", (NGPField,), {})
    assert level.field.parts() is None


def test_colours_have_a_way_back_from_black():
    level, rays = a_level(density_bias=4.0), some_rays(200)
    level.returns_weights, level.field.least_slope = False, 0.1
    with torch.no_grad():
        level.field.color_mlp[-1].mul_(1000.0)
    weight = torch.randn(200, 8)
    _, gradients = learnt(level, rays, None, weight)
    with without("render.gradients"):
        _, expected = learnt(level, rays, None, weight)
    level.field.least_slope = 0.0
    _, without_slope = learnt(level, rays, None, weight)
    name = "field.color_mlp.0"
    assert far_apart(gradients[name], expected[name]) < 1e-3
    assert far_apart(without_slope[name], expected[name]) > 1e-2

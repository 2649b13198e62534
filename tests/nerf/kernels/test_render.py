"""Whole rays in one kernel, against rendering round by round, and its gradients against the single kernels'."""

from dataclasses import replace

import pytest
import torch
from support.comparing import far_apart
from support.ragged_levels import a_level, needs_bfloat16
from support.scenes import some_rays

from nerf_lightning.nerf.encoders.hash_grid import HashGridEncoder
from nerf_lightning.nerf.fields.ngp_field import NGPField
from nerf_lightning.nerf.kernels.backends import without
from nerf_lightning.nerf.kernels.render import gradients as kernels
from nerf_lightning.nerf.kernels.render import workspace
from nerf_lightning.nerf.kernels.render.op import has_kernel
from nerf_lightning.nerf.matmul_precision import cpu_multiplies_bfloat16
from nerf_lightning.nerf.part import StepContext
from nerf_lightning.nerf.randomness import batch_random
from nerf_lightning.nerf.rendering.sample_points import ragged_points
from nerf_lightning.nerf.types.renderings import RaggedRendering


def rendered(level, rays, background=None):
    with torch.no_grad():
        return level(rays, background, [], None)


@pytest.mark.parametrize("matmul_precision", ["float32", pytest.param("bfloat16", marks=needs_bfloat16)])
@pytest.mark.parametrize("features", [2, 4])
@pytest.mark.parametrize("opaque_below", [0.0, 0.05])
@pytest.mark.parametrize("bias", [1.0, 4.0])
def test_it_sees_what_rounds_see(matmul_precision, features, opaque_below, bias):
    level = a_level(opaque_below, features=features, matmul_precision=matmul_precision, density_bias=bias)
    rays = some_rays(700)
    background = torch.rand(700, 3)
    whole = rendered(level, rays, background)
    with without("render.cpu", "march.cpu", "ragged.cpu", "hash_grid.cpu"):
        rounds = rendered(level, rays, background)
    assert 0.1 < float(whole.opacity.mean()) < 0.9
    for name in ("rgb", "foreground", "opacity", "depth"):
        apart = (getattr(whole, name) - getattr(rounds, name)).abs()
        # A number at the border of two bfloat16 ones is rounded to one here and to the other there, now and then.
        assert float((apart < 3e-5).float().mean()) > (0.85 if opaque_below == 0.0 else 0.4)
        # Where rays end early, rounds take a few samples more.
        assert float(apart.max()) < 0.02 + 4 * opaque_below


def test_a_ray_does_not_depend_on_the_others():
    level, rays = a_level(opaque_below=1e-3, density_bias=3.0), some_rays(500)
    order = torch.randperm(500)
    together, mixed, few = rendered(level, rays), rendered(level, rays[order]), rendered(level, rays[7:9])
    for name in ("rgb", "opacity", "depth"):
        assert torch.equal(getattr(together, name)[order], getattr(mixed, name))
        assert torch.equal(getattr(together, name)[7:9], getattr(few, name))


def test_a_ray_ends_where_too_little_light_is_left():
    level, rays = a_level(opaque_below=0.5, density_bias=3.0), some_rays(300)
    with torch.no_grad():
        samples = level.sampler(rays, None)
        density = level.field.density(ragged_points(rays, samples, None))[0].double()
    light, expected = torch.ones(300).double(), torch.zeros(300).double()
    for ray, opacity in zip(samples.ray_index, -torch.expm1(-density * samples.deltas), strict=True):
        if light[ray] > 0.5:
            expected[ray] += light[ray] * opacity
            light[ray] *= 1.0 - opacity
    assert int((light < 0.5).sum()) > 20
    torch.testing.assert_close(rendered(level, rays).opacity.double(), expected, atol=1e-3, rtol=0)


def test_nothing_lies_outside_of_the_fields_box():
    level, rays = a_level(density_bias=3.0), some_rays(300)
    level.sampler.grid.occupy(torch.ones_like(level.sampler.grid.possible))
    level.field.aabb.mul_(0.1)
    small = rendered(level, rays).opacity
    assert float((small > 0).float().mean()) < 0.2
    with without("render.cpu"):
        torch.testing.assert_close(small, rendered(level, rays).opacity, atol=1e-4, rtol=0)


def test_fields_of_other_kinds_are_not_taken():
    takes = [
        has_kernel(a_level(**each).field.parts(), "float32", torch.device("cpu"), gradients)
        for each, gradients in (
            ({}, True),
            ({"contraction": True}, False),
            ({"appearance": 4}, False),
            ({"appearance": 4}, True),
        )
    ]
    assert takes == [True, False, True, False]
    level = a_level()
    level.field.position_encoder = HashGridEncoder(num_levels=4, log2_table_size=8, max_resolution=32, blend_in=0.5)
    assert level.field.parts() is not None
    level.field.position_encoder.on_step(StepContext(0.1, 0, 0))
    assert level.field.parts() is None


def test_other_machines_and_widths_render_round_by_round():
    """Whatever the kernel does not take: the same picture, by the other way."""
    level, rays = a_level(density_bias=3.0, width=24), some_rays(200)
    narrow = rendered(level, rays)
    with without("render.cpu"):
        assert torch.equal(narrow.rgb, rendered(level, rays).rgb)
    assert torch.isfinite(narrow.rgb).all()
    assert not has_kernel(level.field.parts(), "float32", rays.near.device, gradients=False)
    level = a_level()
    assert has_kernel(level.field.parts(), "float32", rays.near.device, gradients=False)
    assert not has_kernel(level.field.parts(), "float32", torch.device("meta"), gradients=False)
    if not cpu_multiplies_bfloat16():
        assert not has_kernel(level.field.parts(), "bfloat16", rays.near.device, gradients=False)


def learnt(level, rays, random, weight, background=None):
    """Return what is seen, and the gradients of what all of it comes to."""
    level.zero_grad(set_to_none=True)
    seen = level(rays, background, [], random)
    shown = torch.cat([seen.rgb, seen.foreground, seen.opacity[:, None], seen.depth[:, None]], dim=1)
    (shown * weight).sum().backward()
    return shown.detach(), {name: each.grad.clone() for name, each in level.named_parameters()}


@pytest.mark.parametrize("jitter", [True, False])
@pytest.mark.parametrize(
    ("matmul_precision", "most"), [("float32", 2e-4), pytest.param("bfloat16", 0.02, marks=needs_bfloat16)]
)
@pytest.mark.parametrize(("features", "color_layers", "feature_dim"), [(2, 1, 16), (4, 2, 16), (4, 1, 4)])
@pytest.mark.parametrize(("opaque_below", "bias"), [(0.0, 1.0), (1e-3, 4.0)])
def test_it_sees_and_learns_what_the_single_kernels_do(
    jitter, matmul_precision, most, features, color_layers, feature_dim, opaque_below, bias
):
    sizes = {"color_layers": color_layers, "feature_dim": feature_dim}
    level = a_level(opaque_below, 32, features, matmul_precision, density_bias=bias, **sizes)
    level.returns_weights = False
    rays, random = some_rays(700), batch_random(3, 700) if jitter else None
    weight, background = torch.randn(700, 8), torch.rand(700, 3)
    seen, gradients = learnt(level, rays, random, weight, background)
    asked = int(level.counter.counts[0])
    level.counter.reset_statistics()
    with without("render.gradients"):
        expected, of_single = learnt(level, rays, random, weight, background)
    assert 0.1 < float(expected[:, 6].mean()) < 0.9
    assert far_apart(seen, expected) < most
    assert gradients.keys() == of_single.keys()
    for name, gradient in gradients.items():
        assert far_apart(gradient, of_single[name]) < 5 * most, name
    # Both count visible samples alone; the light before one may be the least that is seen, to the last bit.
    assert asked == pytest.approx(int(level.counter.counts[0]), rel=0.0 if opaque_below == 0.0 else 2e-3)


def test_what_a_part_has_no_room_for_is_rendered_again(monkeypatch):
    level, rays = a_level(density_bias=3.0), some_rays(300)
    level.returns_weights = False
    weight = torch.randn(300, 8)
    seen, gradients = learnt(level, rays, None, weight)
    monkeypatch.setattr(workspace, "_spare", [])
    monkeypatch.setattr(kernels, "SPARE_ROWS", 128)
    monkeypatch.setattr(level, "points_per_ray", lambda before, training: 0.0)
    again, of_again = learnt(level, rays, None, weight)
    assert torch.equal(seen, again)
    assert all(torch.equal(gradient, of_again[name]) for name, gradient in gradients.items())


@pytest.mark.parametrize("threads", [1, 2])
def test_many_rays_are_shared_out_and_nothing_changes(threads, set_threads):
    level, rays = a_level(density_bias=3.0), some_rays(600)
    level.returns_weights = False
    weight = torch.randn(600, 8)
    set_threads(threads)
    seen, gradients = learnt(level, rays, None, weight)
    again, of_again = learnt(level, rays, None, weight)
    set_threads(1)
    alone, of_alone = learnt(level, rays, None, weight)
    assert torch.equal(seen, again)
    assert torch.equal(seen, alone)
    for name, gradient in gradients.items():
        assert torch.equal(gradient, of_again[name])
        assert far_apart(gradient, of_alone[name]) < 1e-5


def test_it_goes_the_other_way_where_something_else_is_wanted():
    level, rays, cpu = a_level(density_bias=3.0), some_rays(50), torch.device("cpu")
    assert isinstance(level(rays, None, [], None), RaggedRendering)  # as a notebook wants it
    assert not level.takes_whole_rays(cpu, training=True, learns_cameras=False)
    level.returns_weights = False
    assert level.takes_whole_rays(cpu, training=True, learns_cameras=False)
    assert not level.takes_whole_rays(cpu, training=True, learns_cameras=True)
    turns = replace(rays, directions=rays.directions.clone().requires_grad_())  # a focal length that is learned
    assert isinstance(level(turns, None, [], None), RaggedRendering)
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

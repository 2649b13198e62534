"""Whole rays in one kernel, against rendering round by round."""

import pytest
import torch
from support.ragged_levels import a_level, needs_bfloat16
from support.scenes import some_rays

from nerf_lightning.nerf.encoders.hash_grid import HashGridEncoder
from nerf_lightning.nerf.kernels.backends import without
from nerf_lightning.nerf.kernels.render.whole_rays import has_kernel
from nerf_lightning.nerf.matmul_precision import cpu_multiplies_bfloat16
from nerf_lightning.nerf.part import StepContext
from nerf_lightning.nerf.rendering.sample_points import ragged_points


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
    assert a_level().field.parts() is not None
    assert a_level(contraction=True).field.parts() is None
    assert a_level(appearance=4).field.parts() is None
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

"""Rays with equally many samples in one kernel, against the same level in plain torch, and its gradients."""

from dataclasses import replace

import pytest
import torch
from support.comparing import far_apart
from support.ragged_levels import needs_bfloat16
from support.scenes import some_rays

from nerf_lightning.nerf.encoders.hash_grid import HashGridEncoder
from nerf_lightning.nerf.encoders.spherical_harmonics import SphericalHarmonicsEncoder
from nerf_lightning.nerf.fields.ngp_field import NGPField
from nerf_lightning.nerf.kernels import backends
from nerf_lightning.nerf.kernels.backends import without
from nerf_lightning.nerf.matmul_precision import set_precision
from nerf_lightning.nerf.models import dense_level
from nerf_lightning.nerf.models.dense_level import DenseLevel
from nerf_lightning.nerf.models.proposal_level import ProposalLevel
from nerf_lightning.nerf.part import StepContext
from nerf_lightning.nerf.randomness import batch_random
from nerf_lightning.nerf.samplers.stratified import StratifiedSampler

PLAIN = ("render.dense", "mlp.cpu", "hash_grid.cpu")


def a_level(kind=DenseLevel, samples=10, features=4, bias=-1.0, spread=0.5, scaling=0.0, degree=4, **field):
    torch.manual_seed(1)
    encoder = HashGridEncoder(4, features, log2_table_size=8, min_resolution=2, max_resolution=16)
    ngp = NGPField(encoder, SphericalHarmonicsEncoder(degree), width=32, density_bias=bias, **field)
    with torch.no_grad():
        encoder.table.uniform_(-spread, spread)
        for weight in (*ngp.density_mlp, *ngp.color_mlp):
            weight.mul_(2.0)
    return kind(StratifiedSampler(samples), ngp, gradient_scaling_distance=scaling)


@pytest.fixture(autouse=True)
def _to_the_end(monkeypatch):
    """Rays do not end early, as in plain torch."""
    monkeypatch.setattr(dense_level, "OPAQUE_BELOW", 0.0)


def learnt(level, rays, random, grads, background):
    """Return what is seen, and the gradients of all that learns, rays included."""
    level.zero_grad(set_to_none=True)
    leaves = [each.clone().requires_grad_() for each in (rays.origins, rays.directions)]
    rays = replace(rays, origins=leaves[0], directions=leaves[1])
    seen = level(rays, background, [], random)
    shown = torch.cat([seen.weights, seen.rgb, seen.opacity[:, None], seen.depth[:, None]], dim=1)
    (shown * grads).sum().backward()
    gradients = {name: each.grad for name, each in level.named_parameters() if each.grad is not None}
    return shown.detach(), gradients | {"origins": leaves[0].grad, "directions": leaves[1].grad}


def compare(level, rays, most, random=None, background=None):
    grads = torch.randn(len(rays.near), level.sampler.num_samples + 5)
    seen, gradients = learnt(level, rays, random, grads, background)
    with without(*PLAIN):
        expected, of_plain = learnt(level, rays, random, grads, background)
    assert far_apart(seen, expected) < most
    assert gradients.keys() == of_plain.keys()
    for name, gradient in gradients.items():
        assert far_apart(gradient, of_plain[name]) < 5 * most, name
    return expected


@pytest.mark.parametrize("contraction", [False, True])
@pytest.mark.parametrize("kind", [DenseLevel, ProposalLevel])
@pytest.mark.parametrize("closed", [False, True])
@pytest.mark.parametrize(
    ("matmul_precision", "most"), [("float32", 1e-4), pytest.param("bfloat16", 0.03, marks=needs_bfloat16)]
)
@pytest.mark.parametrize(("features", "color_layers"), [(2, 1), (4, 2)])
def test_it_sees_and_learns_what_torch_does(contraction, kind, closed, matmul_precision, most, features, color_layers):
    level = a_level(kind, features=features, color_layers=color_layers, contraction=contraction, scaling=1.5)
    set_precision(level.field, matmul_precision)
    background = None if closed else torch.rand(300, 3)
    expected = compare(level, some_rays(300), most, batch_random(3, 300), background)
    assert closed or 0.05 < float(expected[:, -2].mean()) < 0.95


@pytest.mark.parametrize("bias", [-30.0, 12.0, 40.0])
@pytest.mark.parametrize("contraction", [False, True])
def test_nothing_at_all_and_walls_are_seen_and_learnt_as_well(bias, contraction):
    level = a_level(bias=bias, contraction=contraction)
    compare(level, some_rays(40), 1e-4, None, torch.rand(40, 3))


@pytest.mark.parametrize(("rays", "samples"), [(1, 1), (1, 3), (3, 128), (129, 1), (2, 129)])
def test_few_rays_and_odd_numbers_of_samples(rays, samples):
    compare(a_level(samples=samples, contraction=True), some_rays(rays), 1e-4, batch_random(1, rays), None)


@pytest.mark.parametrize("count", [1, 63, 65, 300])
@pytest.mark.parametrize("closed", [False, True])
def test_pictures_whose_rays_go_in_groups_show_the_same(count, closed):
    level, rays = a_level(samples=7, contraction=True), some_rays(count)
    background = None if closed else torch.rand(count, 3)
    learnt = level(rays, background, [], None)
    with torch.no_grad():
        shown = level(rays, background, [], None)
    assert learnt.rgb.requires_grad
    assert torch.equal(shown.weights, learnt.weights)
    assert torch.equal(shown.rgb, learnt.rgb)


@pytest.mark.parametrize("closed", [False, True])
@pytest.mark.parametrize("kind", [DenseLevel, ProposalLevel])
def test_rays_of_pictures_end_where_they_are_opaque(closed, kind, monkeypatch):
    level, rays = a_level(kind, samples=40, bias=2.0, contraction=True), some_rays(500)
    background = None if closed else torch.rand(500, 3)
    with torch.no_grad():
        whole = level(rays, background, [], None)
        monkeypatch.setattr(dense_level, "OPAQUE_BELOW", 1e-3)
        ended = level(rays, background, [], None)
        monkeypatch.setattr(dense_level, "OPAQUE_BELOW", 0.0)
        with without(*PLAIN):
            torch.testing.assert_close(whole.rgb, level(rays, background, [], None).rgb, rtol=1e-4, atol=1e-5)
    light = 1 - whole.weights.cumsum(dim=1)
    assert 0.2 < float((light < 1e-3).float().mean()) < 0.9
    behind = torch.cat([torch.zeros(500, 1, dtype=torch.bool), light[:, :-1] < 0.9e-3], dim=1)
    assert float(ended.weights[behind].max()) == 0.0
    before = light > 1.1e-3
    assert torch.equal(ended.weights[before], whole.weights[before])
    torch.testing.assert_close(ended.opacity, whole.opacity, rtol=0, atol=1.1e-3)
    torch.testing.assert_close(ended.rgb, whole.rgb, rtol=0, atol=5e-3)


@pytest.mark.parametrize("closed", [False, True])
@pytest.mark.parametrize("kind", [DenseLevel, ProposalLevel])
def test_rays_that_learn_end_as_well_and_learn_nearly_the_same(closed, kind, monkeypatch):
    level, rays, random = a_level(kind, samples=40, bias=2.0, contraction=True), some_rays(500), batch_random(5, 500)
    background, grads = None if closed else torch.rand(500, 3), torch.randn(500, 45)
    whole, of_whole = learnt(level, rays, random, grads, background)
    monkeypatch.setattr(dense_level, "OPAQUE_BELOW", 1e-3)
    ended, of_ended = learnt(level, rays, random, grads, background)
    assert 0.2 < float((ended[:, :40] == 0.0).float().mean()) < 0.9
    torch.testing.assert_close(ended, whole, rtol=0, atol=5e-3)
    for name, gradient in of_ended.items():
        assert 0.0 < far_apart(gradient, of_whole[name]) < 0.02, name
    with torch.no_grad():
        shown = level(rays, background, [], random)
    assert torch.equal(shown.weights, ended[:, :40])


def test_codes_of_photographs_learn_and_without_a_photograph_their_mean_is_seen():
    level = a_level(appearance=3)
    level.field.codes = torch.nn.Parameter(torch.randn(5, 3))
    level.field.trained = torch.tensor([0, 2, 4])
    rays = some_rays(60)
    compare(level, rays, 1e-4, batch_random(1, 60), torch.rand(60, 3))
    compare(level, replace(rays, photograph=torch.randint(5, (60,))), 1e-4, batch_random(1, 60), torch.rand(60, 3))
    assert int((level.field.codes.grad.abs().sum(dim=1) > 0).sum()) == 5


def test_colours_have_a_way_back_from_black():
    level = a_level(bias=2.0)
    level.field.least_slope = 0.1
    with torch.no_grad():
        level.field.color_mlp[-1].mul_(1000.0)
    compare(level, some_rays(200), 1e-3, None, torch.rand(200, 3))


def test_what_is_not_a_number_is_not_hidden():
    level = a_level()
    with torch.no_grad():
        level.field.density_mlp[-1][0, 0] = torch.nan
    assert level(some_rays(20), None, [], None).weights.isnan().any()


@pytest.mark.parametrize("kind", [DenseLevel, ProposalLevel])
def test_threads_share_rays_out_and_each_number_of_them_has_its_bits(kind, set_threads):
    level, rays, grads = a_level(kind, contraction=True), some_rays(600), torch.randn(600, 15)
    found = []
    for threads in (1, 2, 2):
        set_threads(threads)
        found.append(learnt(level, rays, None, grads, torch.zeros(600, 3)))
    (one, of_one), (two, of_two), (again, of_again) = found
    assert torch.equal(one, two)
    assert torch.equal(two, again)
    for name, gradient in of_two.items():
        assert torch.equal(gradient, of_again[name])
        assert far_apart(gradient, of_one[name]) < 1e-5


def test_a_ray_does_not_depend_on_the_others_and_a_picture_is_what_training_saw():
    level, rays, order = a_level(), some_rays(300), torch.randperm(300)
    with torch.no_grad():
        together, mixed, few = (level(each, None, [], None) for each in (rays, rays[order], rays[7:9]))
    assert torch.equal(together.rgb[order], mixed.rgb)
    assert torch.equal(together.rgb[7:9], few.rgb)
    assert torch.equal(together.rgb, level(rays, None, [], None).rgb)


def test_fields_that_the_kernel_does_not_know_take_the_plain_way():
    cpu, rays = torch.device("cpu"), some_rays(30)
    assert a_level().takes_whole_rays(cpu, training=True, learns_cameras=True)
    assert not a_level().takes_whole_rays(torch.device("meta"), training=True, learns_cameras=False)
    narrow = a_level()
    narrow.field.density_mlp[1] = torch.nn.Parameter(torch.ones(16, 20))
    narrow.field.density_mlp[0] = torch.nn.Parameter(torch.ones(20, 16))
    assert not narrow.takes_whole_rays(cpu, training=True, learns_cameras=False)
    assert narrow(rays, None, [], None).rgb.isfinite().all()
    blends = a_level()
    blends.field.position_encoder = HashGridEncoder(4, 4, 8, 2, 16, blend_in=0.5)
    blends.field.position_encoder.on_step(StepContext(0.1, 0, 0))
    assert not blends.takes_whole_rays(cpu, training=True, learns_cameras=False)
    hooked = a_level()
    hooked.field.register_forward_pre_hook(lambda *given: None)
    assert not hooked.takes_whole_rays(cpu, training=True)
    other = a_level(type("Other", (DenseLevel,), {"field_output": lambda self, points: self.field(points)}))
    assert not other.takes_whole_rays(cpu, training=True, learns_cameras=False)


@pytest.mark.parametrize("mode", [torch.no_grad, torch.inference_mode])
def test_the_first_rays_may_be_those_of_a_picture(mode, monkeypatch):
    monkeypatch.setattr(backends, "backend", backends.backend.__wrapped__)
    with mode():
        assert a_level().takes_whole_rays(torch.device("cpu"), training=False)


def test_rays_of_any_shape_are_rendered():
    level, rays = a_level(contraction=True), some_rays(12)
    grid, flat = rays.map(lambda each: each.view(3, 4, *each.shape[1:])), level(rays, None, [], None)
    torch.testing.assert_close(level(grid, None, [], None).rgb.view(12, 3), flat.rgb, atol=1e-5, rtol=1e-4)
    assert level(rays.map(lambda each: each[0]), None, [], None).rgb.shape == (3,)


def test_learnt_rays_that_are_no_numbers_read_nothing_beyond_the_table():
    level, rays = a_level(contraction=True), some_rays(20)
    broken = replace(rays, directions=torch.full_like(rays.directions, torch.nan).requires_grad_())
    level(broken, None, [], None).weights.nan_to_num().sum().backward()

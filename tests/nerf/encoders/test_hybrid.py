"""The hybrid encoder: what it is made of, its factor against a slow reference, and that nothing is computed twice."""

from dataclasses import replace

import pytest
import torch
from support.scenes import ball_scene, some_rays
from torch import nn

from nerf_lightning.nerf.encoders.frequency import FrequencyEncoder
from nerf_lightning.nerf.encoders.hash_grid import HashGridEncoder
from nerf_lightning.nerf.encoders.hybrid import CONE_OCTAVES, HybridEncoder
from nerf_lightning.nerf.encoders.spherical_harmonics import SphericalHarmonicsEncoder
from nerf_lightning.nerf.fields.hash_field import HashField
from nerf_lightning.nerf.geometry.cones import to_matrix
from nerf_lightning.nerf.models.dense_level import DenseLevel
from nerf_lightning.nerf.models.masked_level import MaskedLevel
from nerf_lightning.nerf.models.packed_level import PackedLevel
from nerf_lightning.nerf.part import StepContext
from nerf_lightning.nerf.randomness import batch_random
from nerf_lightning.nerf.samplers.occupancy import OccupancySampler
from nerf_lightning.nerf.samplers.stratified import StratifiedSampler
from nerf_lightning.nerf.types.points import Points

CONE = torch.tensor([3.0, 2.0, 1.0, 0.5, -0.4, 0.3]) * 1e-3


def a_grid(**settings):
    grid = HashGridEncoder(num_levels=2, features_per_level=3, log2_table_size=9, max_resolution=40, **settings)
    nn.init.normal_(grid.table)
    return grid


def an_encoder(**settings):
    torch.manual_seed(4)
    encoder = HybridEncoder(FrequencyEncoder(3, include_input=False), a_grid(), **({"width": 8} | settings))
    nn.init.normal_(encoder.fine.table)
    return encoder


def a_field(**settings):
    return HashField(an_encoder(**settings), SphericalHarmonicsEncoder(2), width=16, density_bias=0.0)


def a_level(kind, field):
    if kind is DenseLevel:
        return DenseLevel(StratifiedSampler(12), field)
    level = kind(OccupancySampler(resolution=8, num_steps=64, opaque_below=0.0), field)
    level.fit_to(ball_scene(num_views=12))
    level.sampler.grid.occupy(torch.ones_like(level.sampler.grid.possible))
    return level


def pixels(count=40):
    return replace(some_rays(count), pixel_side=torch.tensor([0.0, 0.02]).expand(count, 2))


def test_with_a_factor_of_one_and_no_levels_it_is_the_frequency_encoder():
    coarse, points = FrequencyEncoder(5), torch.rand(4, 7, 3)
    encoder = HybridEncoder(coarse, None, factor="one")
    assert torch.equal(encoder(points), coarse(points))
    assert torch.equal(encoder.attach_gradients(points, encoder(points)), coarse(points))
    assert encoder.tables() == [] == list(encoder.parameters())


def test_with_a_factor_of_one_the_two_stand_side_by_side():
    encoder, points = an_encoder(factor="one"), torch.rand(9, 3)
    assert torch.equal(encoder(points), torch.cat([encoder.coarse(points), encoder.fine(points)], dim=-1))


@pytest.mark.parametrize("cones", [False, True])
def test_the_factor_is_what_one_point_after_the_other_gives(cones):
    encoder, points = an_encoder(cones=cones).double(), torch.rand(5, 3).double()
    covariance = CONE.double() * torch.rand(5, 6).double()
    found = encoder(points, covariance) if cones else encoder(points)
    for number, point in enumerate(points):
        fine = encoder.fine(point)
        seen = fine.tolist()
        for three in (covariance[number, :3], covariance[number, 3:]) if cones else ():
            cells = [float(entry) * 40.0**2 for entry in three]
            cells = torch.tensor([entry / (1.0 + abs(entry)) for entry in cells]).double()
            for octave in range(CONE_OCTAVES):
                seen += [*(2**octave * cells).sin().tolist(), *(2**octave * cells).cos().tolist()]
        first, second, last = encoder.factor_mlp
        hidden = (second @ (first @ torch.tensor(seen).double()).clamp(min=0)).clamp(min=0)
        expected = torch.cat([torch.tanh(last @ hidden) * encoder.coarse(point), fine])
        torch.testing.assert_close(found[number], expected)


def test_ever_thinner_cones_come_near_the_point():
    encoder, points = an_encoder(cones=True), torch.rand(30, 3)
    own = encoder(points)
    cones = [scale * CONE.expand(30, 6) for scale in (1, 1e-2, 1e-4)]
    away = [float((encoder(points, cone) - own).detach().abs().max()) for cone in cones]
    assert away[0] > 0.1
    assert away[0] > 10 * away[1] > 100 * away[2]
    assert torch.equal(encoder(points, torch.zeros(30, 6)), own)


@pytest.mark.parametrize("cones", [False, True])
def test_gradients_are_those_of_differences(cones):
    encoder = an_encoder(cones=cones, width=4).double()
    points = torch.rand(6, 3, dtype=torch.float64, requires_grad=True)
    given = (CONE.double().expand(6, 6),) if cones else ()
    weights = [encoder.fine.table, *encoder.factor_mlp]
    assert torch.autograd.gradcheck(lambda points, *_: encoder(points, *given), (points, *weights), fast_mode=True)


@pytest.mark.parametrize("settings", [{}, {"cones": True}, {"factor": "one"}])
@pytest.mark.parametrize("blend_in", [0.0, 0.5])
def test_known_features_have_the_gradients_of_computed_ones(settings, blend_in):
    encoder = HybridEncoder(FrequencyEncoder(2), a_grid(blend_in=blend_in), width=8, **settings)
    encoder.fine.on_step(StepContext(0.2, 0, 0))
    points, grad = torch.rand(50, 3), torch.randn(50, encoder.out_dim)
    given = (CONE.expand(50, 6),) if encoder.sees_cones else ()
    with torch.no_grad():
        known = encoder(points, *given)
    results = []
    for features in (encoder(points, *given), encoder.attach_gradients(points, known, *given)):
        encoder.zero_grad()
        features.backward(grad)
        results.append([features.detach(), *(weight.grad.clone() for weight in encoder.parameters())])
    for found, expected in zip(*results, strict=True):
        assert torch.equal(found, expected)


def counted(monkeypatch, *parts):
    """Return how many points went through the forward pass of each part."""
    points = dict.fromkeys(parts, 0)
    for part in parts:

        def forward(positions, *others, part=part, former=part.forward):
            points[part] += positions.shape[:-1].numel()
            return former(positions, *others)

        monkeypatch.setattr(part, "forward", forward)
    return points


@pytest.mark.parametrize("cones", [False, True])
def test_colour_is_made_of_what_was_computed_for_density(monkeypatch, cones):
    field = a_field(cones=cones)
    level, encoder, rays = a_level(PackedLevel, field), field.position_encoder, pixels()
    asked = counted(monkeypatch, encoder, encoder.coarse, encoder.fine)
    with torch.no_grad():
        level(rays, torch.ones(40, 3), [], None)
    assert asked[encoder] > 40
    assert asked[encoder.coarse] == asked[encoder.fine] == asked[encoder]
    level.sampler.opaque_below = 1e-4
    before = asked[encoder]
    found = int(level.sampler(rays, random := batch_random(1, 40)).found)
    level(rays, torch.ones(40, 3), [], random)
    assert asked[encoder] - before == found  # of all samples once; nothing is looked up again for gradients
    assert asked[encoder.fine] == asked[encoder]


@pytest.mark.parametrize("kind", [PackedLevel, MaskedLevel, DenseLevel])
@pytest.mark.parametrize("training", [False, True])
def test_every_level_tells_the_factor_of_the_cones(kind, training):
    level, rays = a_level(kind, a_field(cones=True)), pixels()
    random = batch_random(3, 40) if training else None

    def seen(rays):
        with torch.set_grad_enabled(training):
            return level(rays, torch.ones(40, 3), [], random).rgb.detach()

    thin = replace(rays, pixel_side=0.1 * rays.pixel_side)
    assert float((seen(rays) - seen(thin)).abs().max()) > 5e-5
    level.field = a_field()
    assert torch.equal(seen(rays), seen(thin))


def test_packed_and_masked_samples_have_the_same_cones():
    field, rays, behind = a_field(cones=True), pixels(), torch.rand(40, 3)
    packed, masked = (a_level(kind, field)(rays, behind, [], None).rgb for kind in (PackedLevel, MaskedLevel))
    torch.testing.assert_close(packed, masked, rtol=1e-4, atol=2e-5)


@pytest.mark.parametrize("contraction", [False, True])
def test_cones_follow_points_into_the_unit_cube_by_the_jacobian(monkeypatch, contraction):
    field = HashField(an_encoder(cones=True), SphericalHarmonicsEncoder(2), width=16, contraction=contraction)
    field.aabb.copy_(torch.tensor([[-1.0, 0.0, -3.0], [1.0, 0.5, 4.0]]))
    given, forward = {}, field.position_encoder.forward

    def noted(points, covariance=None):
        given["unit"], given["covariance"] = points, covariance
        return forward(points, covariance)

    def unit(position):
        field.density(Points(position[None]))
        return given["unit"][0]

    monkeypatch.setattr(field.position_encoder, "forward", noted)
    points = torch.tensor([[0.1, 0.2, -0.3], [-0.6, 0.4, 2.0], [-4.0, 0.7, 3.0]])
    jacobian = torch.stack([torch.autograd.functional.jacobian(unit, point) for point in points])
    field.density(Points(points, covariance=CONE.expand(3, 6)))
    torch.testing.assert_close(to_matrix(given["covariance"]), jacobian @ to_matrix(CONE) @ jacobian.mT)


def test_the_factors_products_have_the_precision_of_the_fields():
    field, points = a_field(), Points(torch.rand(20, 3))
    exact = field.density(points)[1]
    field.multiply_in("bfloat16")
    rounded = field.density(points)[1]
    coarse = field.position_encoder.coarse.out_dim
    assert not torch.equal(rounded[:, :coarse], exact[:, :coarse])
    torch.testing.assert_close(rounded, exact, atol=0.05, rtol=0)
    assert torch.equal(rounded[:, coarse:], exact[:, coarse:])


@pytest.mark.parametrize(
    ("settings", "words"),
    [
        ({"fine": None}, "give a hash grid, or factor=one"),
        ({"fine": None, "factor": "one", "cones": True}, "leave one of them out"),
        ({"factor": "one", "cones": True}, "leave one of them out"),
        ({"width": 0}, "width=0: give 1 to"),
    ],
)
def test_what_cannot_be_is_refused_in_words(settings, words):
    with pytest.raises(ValueError, match=words):
        HybridEncoder(FrequencyEncoder(2), **({"fine": a_grid()} | settings))

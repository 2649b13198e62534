from dataclasses import replace

import pytest
import torch
from support.scenes import ball_scene, tiny_field
from torch import nn

from nerf_lightning.nerf.encoders.frequency import FrequencyEncoder
from nerf_lightning.nerf.fields.nerf_mlp import NerfMLP
from nerf_lightning.nerf.randomness import batch_random
from nerf_lightning.nerf.types.rays import Points


def paper_field(**changes):
    return NerfMLP(FrequencyEncoder(10), FrequencyEncoder(4), **changes)


def test_the_shapes_are_the_papers():
    """Figure 7: 63 in, 256 wide, the encoded position again at layer 5, 27 more into the color head, 128 wide."""
    field = paper_field()
    shapes = [tuple(layer[0].weight.shape) for layer in field.trunk]
    assert shapes == [(256, 63)] + [(256, 256)] * 4 + [(256, 256 + 63)] + [(256, 256)] * 2
    assert tuple(field.color_hidden[0].weight.shape) == (128, 256 + 27)
    assert sum(p.numel() for p in field.parameters()) == 595_844


def test_a_slow_walk_through_the_figure_gives_the_same():
    torch.manual_seed(0)
    field = paper_field().double()
    positions = torch.rand(3, 2, 3, dtype=torch.float64)
    directions = nn.functional.normalize(torch.randn(3, 1, 3, dtype=torch.float64), dim=-1)
    x, d = field.position_encoder(positions), field.direction_encoder(directions.expand(3, 2, 3))
    hidden = x
    for index, layer in enumerate(field.trunk):
        if index == 5:
            hidden = torch.cat([hidden, x], dim=-1)
        hidden = torch.relu(hidden @ layer[0].weight.T + layer[0].bias)
    density = torch.relu(field.density_head(hidden)[..., 0])
    colour = torch.relu(field.color_hidden[0](torch.cat([field.feature(hidden), d], dim=-1)))
    colour = torch.sigmoid(field.color_head(colour))
    output = field(Points(positions, directions))
    torch.testing.assert_close(output.density.double(), density, rtol=1e-5, atol=1e-6)
    torch.testing.assert_close(output.rgb.double(), colour, rtol=1e-5, atol=1e-6)


def test_a_xavier_start_has_zero_biases_and_glorots_bound():
    field = paper_field(xavier=True)
    weight = field.trunk[1][0].weight
    assert float(weight.detach().abs().max()) <= (6 / 512) ** 0.5
    assert all(float(p.detach().abs().sum()) == 0 for name, p in field.named_parameters() if name.endswith("bias"))
    assert float(paper_field(xavier=False).trunk[1][0].bias.detach().abs().sum()) > 0


def test_softplus_and_bias_start_from_thin_air():
    thin = paper_field(density_activation="softplus", density_bias=-5.0)
    density = thin.density(Points(torch.rand(100, 3)))[0].detach()
    assert 0 < float(density.min()) <= float(density.max()) < 0.2


def test_density_noise_is_there_in_training_only_and_is_keyed():
    field = paper_field(density_noise=1.0, density_bias=3.0)
    positions, directions = torch.rand(6, 5, 3), nn.functional.normalize(torch.rand(6, 1, 3), dim=-1)
    quiet = field(Points(positions, directions)).density
    points = Points(positions, directions, random=batch_random(1, 6).along(5))
    noisy = field(points).density
    assert not torch.allclose(quiet, noisy)
    assert torch.equal(noisy, field(points).density)


def test_a_skip_that_names_no_layer_is_refused():
    for skip in (0, 8, 20):
        with pytest.raises(ValueError, match=f"skip={skip} names no layer between 1 and 7"):
            paper_field(skip=skip)


def test_contracted_space_brings_far_points_within_reach_of_the_encoding():
    scene = replace(ball_scene(), space="contracted", aabb=torch.tensor([[-1.0] * 3, [1.0] * 3]) * 3**-0.5)
    torch.manual_seed(0)
    field, plain = tiny_field(density_activation="softplus"), tiny_field(density_activation="softplus")
    plain.load_state_dict(field.state_dict())
    field.fit_to(scene)
    inside, outside = 0.5 * torch.rand(20, 3), torch.tensor([[4.0, 0.0, 0.0], [0.0, 0.0, -10.0]])
    torch.testing.assert_close(field.density(Points(inside))[0], plain.density(Points(inside))[0])
    contracted = torch.tensor([[1.75, 0.0, 0.0], [0.0, 0.0, -1.9]])
    torch.testing.assert_close(field.density(Points(outside))[0], plain.density(Points(contracted))[0])

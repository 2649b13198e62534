"""What every field of conf/field must do."""

import pytest
import torch
from support.configs import composed, options

from nerf_lightning.config.instantiate import build
from nerf_lightning.nerf.fields.base import Field
from nerf_lightning.nerf.types.rays import Points


@pytest.fixture(params=options("field"))
def field(request):
    model = "nerf" if request.param.startswith("nerf_mlp") else "fast"
    return build(composed("train", f"model={model}", f"field={request.param}").field)


def points_and_directions(rays=5, samples=4):
    directions = torch.nn.functional.normalize(torch.randn(rays, 1, 3), dim=-1)
    return torch.rand(rays, samples, 3), directions


def test_density_and_colour_are_in_range(field):
    assert isinstance(field, Field)
    output = field(Points(*points_and_directions()))
    assert output.density.shape == (5, 4)
    assert output.rgb.shape == (5, 4, 3)
    assert bool((output.density >= 0).all())
    assert bool(((output.rgb >= 0) & (output.rgb <= 1)).all())


def test_density_alone_is_the_density_of_the_whole(field):
    positions, directions = points_and_directions()
    torch.testing.assert_close(field.density(Points(positions))[0], field(Points(positions, directions)).density)


def test_density_does_not_depend_on_the_direction_but_colour_does_where_it_is_given(field):
    positions, directions = points_and_directions()
    there, back = field(Points(positions, directions)), field(Points(positions, -directions))
    assert torch.equal(there.density, back.density)
    # A constant is all that a single harmonic says of a direction.
    assert torch.equal(there.rgb, back.rgb) == (field.direction_encoder.out_dim == 1)


def test_drawing_anew_is_a_function_of_the_generator(field):
    weights = []
    for seed in (3, 3, 4):
        torch.manual_seed(seed)
        field.reset_parameters()
        weights.append(torch.cat([p.detach().flatten() for p in field.parameters()]))
    assert torch.equal(weights[0], weights[1])
    assert not torch.equal(weights[0], weights[2])

"""What every encoder of conf/encoder must do; a new yaml is tested by being there."""

import pytest
import torch
from omegaconf import DictConfig
from support.configs import composed, options

from nerf_lightning.config.instantiate import build
from nerf_lightning.nerf.encoders.base import Encoder
from nerf_lightning.nerf.types.rays import Points

CONSTANT = "spherical_harmonics_1"
"""Says nothing of what it is given, on purpose."""


@pytest.fixture(params=[option for option in options("encoder") if option != CONSTANT])
def encoder(request):
    config = composed("train", f"encoder={request.param}").encoder
    for part in (config, *(each for each in config.values() if isinstance(each, DictConfig))):
        if "log2_table_size" in part:
            part.log2_table_size = 12  # large tables take long to fill with numbers
    return build(config)


def test_it_is_an_encoder_with_the_promised_width(encoder):
    assert isinstance(encoder, Encoder)
    for shape in [(3,), (5, 3), (2, 4, 3), (0, 3)]:
        assert encoder(torch.rand(shape)).shape == (*shape[:-1], encoder.out_dim)


def test_dtype_is_kept(encoder):
    assert encoder(torch.rand(4, 3)).dtype == torch.float32
    assert encoder.double()(torch.rand(4, 3, dtype=torch.float64)).dtype == torch.float64


def test_features_and_gradients_are_finite_far_and_near(encoder):
    points = torch.tensor([[0.0, 0.0, 0.0], [1e-8, -1e-8, 1.0], [-50.0, 3.0, 50.0]], requires_grad=True)
    features = encoder(points)
    features.square().sum().backward()
    assert bool(features.isfinite().all())
    assert points.grad is not None
    assert bool(points.grad.isfinite().all())


def test_points_are_encoded_one_by_one(encoder):
    points = torch.rand(6, 3)
    torch.testing.assert_close(encoder(points)[2], encoder(points[2]))


def test_distinct_points_have_distinct_features(encoder):
    assert encoder(torch.rand(200, 3)).unique(dim=0).shape[0] == 200


def test_it_can_be_drawn_anew_and_told_apart_only_by_its_parameters(encoder):
    torch.manual_seed(5)
    encoder.reset_parameters()
    first = encoder(torch.ones(2, 3))
    torch.manual_seed(5)
    encoder.reset_parameters()
    assert torch.equal(encoder(torch.ones(2, 3)), first)


def test_a_model_learns_with_it(encoder):
    """One step with this encoder in the field changes the loss's gradient for every parameter."""
    from nerf_lightning.nerf.encoders.frequency import FrequencyEncoder
    from nerf_lightning.nerf.fields.nerf_mlp import NerfMLP
    from nerf_lightning.nerf.fields.ngp_field import NGPField

    if encoder.needs_unit_cube:
        field = NGPField(encoder, FrequencyEncoder(2), width=8)
    else:
        field = NerfMLP(encoder, encoder, depth=2, width=8, skip=None, density_activation="softplus")
    directions = torch.nn.functional.normalize(torch.rand(5, 1, 3), dim=-1)
    output = field(Points(torch.rand(5, 4, 3), directions))
    (output.rgb.sum() + output.density.sum()).backward()
    grads = [parameter.grad for parameter in field.parameters()]
    assert all(grad is not None and bool(grad.isfinite().all()) for grad in grads)


def test_the_constant_is_one():
    points = torch.rand(4, 3)
    features = build(composed("train", f"encoder={CONSTANT}").encoder)(points)
    assert features.shape == (4, 1)
    assert features.unique().numel() == 1

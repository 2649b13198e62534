import math

import pytest
import torch

from nerf_lightning.messages.errors import InputError
from nerf_lightning.nerf.encoders.frequency import FrequencyEncoder
from nerf_lightning.nerf.encoders.hash_grid import HashGridEncoder
from nerf_lightning.nerf.encoders.spherical_harmonics import SphericalHarmonicsEncoder
from nerf_lightning.nerf.part import StepContext


def test_it_is_the_articles_encoding_written_as_a_loop():
    points = torch.rand(4, 3, dtype=torch.float64)
    expected = [points]
    for number in range(5):
        expected += [torch.sin(2.0**number * points), torch.cos(2.0**number * points)]
    torch.testing.assert_close(FrequencyEncoder(5).double()(points), torch.cat(expected, dim=-1))


def test_with_pi_the_lowest_frequency_has_period_two():
    encoder = FrequencyEncoder(3, include_input=False, with_pi=True).double()
    points = torch.rand(5, 3, dtype=torch.float64)
    # The frequencies themselves are kept in float32.
    close = {"rtol": 1e-4, "atol": 1e-5}
    torch.testing.assert_close(encoder(points + 2.0), encoder(points), **close)
    without = FrequencyEncoder(3, include_input=False).double()
    torch.testing.assert_close(without(points + 2 * math.pi), without(points), **close)
    torch.testing.assert_close(encoder(points), without(math.pi * points), **close)


def sphere(rows=64):
    """Directions and weights that integrate polynomials of low degree over the sphere exactly."""
    import numpy as np

    z, weight = (torch.from_numpy(x) for x in np.polynomial.legendre.leggauss(rows))
    angle = 2 * math.pi * torch.arange(2 * rows, dtype=torch.float64) / (2 * rows)
    radius = (1 - z**2).sqrt()[:, None]
    points = torch.stack([radius * angle.cos(), radius * angle.sin(), z[:, None].expand(-1, 2 * rows)], dim=-1)
    return points.reshape(-1, 3), (weight[:, None].expand(-1, 2 * rows) * math.pi / rows).reshape(-1)


@pytest.mark.parametrize("degree", [1, 2, 3, 4])
def test_the_functions_are_orthonormal_on_the_sphere(degree):
    points, weights = sphere()
    values = SphericalHarmonicsEncoder(degree)(points)
    gram = values.T @ (weights[:, None] * values)
    torch.testing.assert_close(gram, torch.eye(degree**2, dtype=torch.float64))


def test_each_degree_has_its_parity():
    """Y_lm(-d) = (-1)^l Y_lm(d)."""
    directions = torch.nn.functional.normalize(torch.randn(20, 3), dim=-1)
    encode = SphericalHarmonicsEncoder(4)
    sign = torch.tensor([1.0] + [-1.0] * 3 + [1.0] * 5 + [-1.0] * 7)
    torch.testing.assert_close(encode(-directions), sign * encode(directions))


def test_only_degrees_1_to_4_exist():
    with pytest.raises(ValueError, match="degree=5"):
        SphericalHarmonicsEncoder(5)


def test_tables_that_cannot_fit_are_refused_before_they_are_allocated():
    with pytest.raises(InputError, match=r"[0-9,]+ parameters.*GiB.*encoder\.log2_table_size \(one less halves it\)"):
        HashGridEncoder(num_levels=16, log2_table_size=29, max_resolution=100_000)


@pytest.mark.parametrize(("blend_in", "levels_on"), [(0.0, 3), (0.5, 2)])
def test_known_features_have_the_gradients_of_computed_ones(blend_in, levels_on):
    encoder = HashGridEncoder(num_levels=3, log2_table_size=9, max_resolution=40, blend_in=blend_in)
    encoder.on_step(StepContext(0.2, 0, 0))
    points, grad = torch.rand(50, 3), torch.randn(50, 12)
    with torch.no_grad():
        known = encoder(points)
    results = []
    for features in (encoder(points), encoder.attach_gradients(points, known)):
        encoder.table.grad = None
        features.backward(grad)
        results.append((features.detach(), encoder.table.grad.clone()))
    assert torch.equal(results[0][0], results[1][0])
    assert torch.equal(results[0][1], results[1][1])
    assert not results[0][1][encoder.layout.offsets[levels_on] :].any()


def test_an_mlp_that_knows_no_box_refuses_it():
    from nerf_lightning.nerf.fields.nerf_mlp import NerfMLP

    with pytest.raises(ValueError, match="field=ngp"):
        NerfMLP(HashGridEncoder(num_levels=1, log2_table_size=6), FrequencyEncoder(2))


def test_levels_are_blended_in_from_coarse_to_fine():
    encoder = HashGridEncoder(num_levels=3, features_per_level=2, log2_table_size=9, max_resolution=40, blend_in=0.5)
    torch.nn.init.normal_(encoder.table)
    points = torch.rand(50, 3)
    whole = encoder(points)
    for share, weights in {0.0: (1, 0, 0), 0.25: (1, 1, 0), 0.375: (1, 1, 0.5), 0.5: (1, 1, 1), 1.0: (1, 1, 1)}.items():
        encoder.on_step(StepContext(share, 0, 0))
        torch.testing.assert_close(encoder(points), whole * torch.tensor(weights).repeat_interleave(2))
        assert encoder.level_weights.tolist() == list(weights)

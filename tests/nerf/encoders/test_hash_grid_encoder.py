import pytest
import torch

from nerf_lightning.errors import InputError
from nerf_lightning.nerf.encoders.frequency import FrequencyEncoder
from nerf_lightning.nerf.encoders.hash_grid import HashGridEncoder


def test_tables_that_cannot_fit_are_refused_before_they_are_allocated():
    with pytest.raises(InputError, match=r"[0-9,]+ parameters.*GiB.*encoder\.log2_table_size \(one less halves it\)"):
        HashGridEncoder(num_levels=16, log2_table_size=29, max_resolution=100_000)


def test_it_starts_near_zero():
    table = HashGridEncoder(num_levels=2, log2_table_size=8).table
    assert 0 < float(table.detach().abs().max()) <= 1e-4


def test_known_features_have_the_gradients_of_computed_ones():
    encoder = HashGridEncoder(num_levels=3, log2_table_size=9, max_resolution=40)
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


def test_an_mlp_that_knows_no_box_refuses_it():
    from nerf_lightning.nerf.fields.nerf_mlp import NerfMLP

    with pytest.raises(ValueError, match="field=hash"):
        NerfMLP(HashGridEncoder(num_levels=1, log2_table_size=6), FrequencyEncoder(2))

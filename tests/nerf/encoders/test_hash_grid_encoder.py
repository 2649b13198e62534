import pytest
import torch

from nerf_lightning.messages.errors import InputError
from nerf_lightning.nerf.encoders.frequency import FrequencyEncoder
from nerf_lightning.nerf.encoders.hash_grid import HashGridEncoder
from nerf_lightning.nerf.part import StepContext


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

"""What photographs become before the image network: NeuRN's properties, and the network's frame."""

import pytest
import torch

from nerf_lightning.nerf.models.view_transformer.image_network import ImageNetwork
from nerf_lightning.nerf.models.view_transformer.image_norm import local_deviation, normalized


def pictures(seed=0):
    return torch.rand(2, 3, 11, 14, generator=torch.Generator().manual_seed(seed))


def test_the_local_deviation_is_that_of_each_patch():
    picture = pictures()[:1, :1]
    deviation = picture[0, 0].unfold(0, 3, 1).unfold(1, 3, 1).flatten(2).std(dim=-1, correction=0)
    found = local_deviation(picture)[0, 0]
    inner = found[1:-1, 1:-1]
    torch.testing.assert_close(inner / inner.max(), deviation / deviation.max())


@pytest.mark.parametrize(("gain", "offset"), [(0.5, 0.0), (1.0, 0.3), (0.02, 0.9), (-1.0, 1.0)])
def test_gain_and_offset_change_nothing(gain, offset):
    found = pictures()
    of_channel = torch.tensor([1.0, 0.5, 2.0]).view(3, 1, 1)
    torch.testing.assert_close(
        local_deviation(gain * of_channel * found + offset), local_deviation(found), atol=2e-5, rtol=0
    )


def test_it_lies_between_0_and_1_and_reaches_1():
    found = local_deviation(pictures())
    assert float(found.min()) >= 0.0
    assert float(found.max()) <= 1.0
    assert torch.equal(found.amax(dim=(-2, -1)), torch.ones(2, 3))


def test_constants_become_0():
    shades = torch.linspace(0, 1, 24).view(8, 3, 1, 1).expand(8, 3, 9, 9)
    assert torch.equal(local_deviation(shades), torch.zeros(8, 3, 9, 9))


def test_instances_have_mean_0_and_deviation_1():
    found = normalized(pictures(), "instance")
    torch.testing.assert_close(found.mean(dim=(-2, -1)), torch.zeros(2, 3), atol=1e-5, rtol=0)
    torch.testing.assert_close(found.std(dim=(-2, -1), correction=0), torch.ones(2, 3), atol=1e-3, rtol=0)


@pytest.mark.parametrize("scale", [2, 4, 8])
def test_the_image_network_has_a_feature_per_scale_pixels_of_any_size(scale):
    torch.manual_seed(0)
    network = ImageNetwork(5, scale, 4, 1, "none")
    assert network(pictures()).shape == (2, 5, -(-11 // scale), -(-14 // scale))


def test_features_stand_where_what_they_show_stands():
    """A mirrored network shows the mirrored picture's features mirrored: they are centred between pixels."""
    torch.manual_seed(0)
    network, picture = ImageNetwork(4, 2, 8, 1, "none"), torch.rand(1, 3, 16, 16)
    plain = network(picture)
    with torch.no_grad():
        for part in network.modules():
            if isinstance(part, torch.nn.Conv2d):
                part.weight.copy_(part.weight.flip(-1))
    torch.testing.assert_close(network(picture.flip(-1)).flip(-1), plain, atol=1e-4, rtol=1e-4)

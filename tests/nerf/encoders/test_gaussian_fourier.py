import torch

from nerf_lightning.nerf.encoders.gaussian_fourier import GaussianFourierEncoder


def test_the_kernel_depends_on_the_difference_alone_and_is_the_gaussian():
    """gamma(x) . gamma(y) / rows = mean of cos(2 pi B (x - y)), whose expectation is exp(-2 (pi scale |x - y|)^2)."""
    torch.manual_seed(0)
    encoder = GaussianFourierEncoder(num_frequencies=200_000, scale=0.5)
    x, y, shift = torch.rand(3), torch.rand(3), torch.rand(3)
    kernel = float((encoder(x) * encoder(y)).sum()) / 200_000
    shifted = float((encoder(x + shift) * encoder(y + shift)).sum()) / 200_000
    expected = float(torch.exp(-2 * (torch.pi * 0.5) ** 2 * (x - y).square().sum()))
    assert abs(kernel - shifted) < 1e-4
    assert abs(kernel - expected) < 0.01


def test_its_frequencies_travel_in_the_state_dict():
    first, second = GaussianFourierEncoder(), GaussianFourierEncoder()
    second.load_state_dict(first.state_dict())
    assert torch.equal(first(torch.ones(3)), second(torch.ones(3)))

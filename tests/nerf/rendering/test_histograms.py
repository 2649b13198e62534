import numpy as np
import pytest
import torch

from nerf_lightning.nerf.rendering.histograms import sample_histogram


def test_inverse_sampling_equals_numpy_interpolation(generator):
    edges = torch.rand(6, 21, generator=generator, dtype=torch.float64).cumsum(-1)
    weights = torch.rand(6, 20, generator=generator, dtype=torch.float64) + 0.01
    u = torch.rand(6, 50, generator=generator, dtype=torch.float64)
    ours = sample_histogram(edges, weights, u, floor=0.0)
    for row in range(6):
        cdf = np.concatenate([[0], np.cumsum(weights[row].numpy()) / weights[row].sum().item()])
        np.testing.assert_allclose(ours[row].numpy(), np.interp(u[row].numpy(), cdf, edges[row].numpy()), atol=1e-12)


def test_samples_follow_the_weights():
    weights = torch.tensor([0.1, 0.0, 0.6, 0.3])
    u = (torch.arange(100_000) + 0.5) / 100_000
    samples = sample_histogram(torch.tensor([0.0, 1.0, 2.0, 3.0, 4.0]), weights, u, floor=0.0)
    counts = torch.histc(samples, 4, 0.0, 4.0) / 100_000
    torch.testing.assert_close(counts, weights, atol=1e-4, rtol=0)


def test_samples_lie_in_the_bin_that_has_the_weight():
    """The fault: weights and bins shifted by one. All mass in bin 5 of unequal bins: every sample lies in it."""
    edges = torch.tensor([0.0, 0.1, 0.3, 0.7, 1.5, 3.1, 3.2, 5.0, 5.5])
    for index in range(8):
        weights = torch.zeros(8)
        weights[index] = 1.0
        samples = sample_histogram(edges, weights, torch.linspace(0, 0.999, 50), floor=0.0)
        assert bool((samples >= edges[index]).all())
        assert bool((samples <= edges[index + 1]).all())


def test_a_wrong_number_of_weights_is_refused():
    with pytest.raises(ValueError, match="9 weights need 10 edges, not 9"):
        sample_histogram(torch.arange(9.0), torch.ones(9), torch.rand(4))


def test_an_empty_ray_is_sampled_evenly():
    samples = sample_histogram(torch.linspace(2, 6, 65), torch.zeros(64), (torch.arange(64) + 0.5) / 64)
    torch.testing.assert_close(samples, 2 + 4 * (torch.arange(64) + 0.5) / 64, atol=1e-4, rtol=0)


def test_samples_of_sorted_numbers_are_sorted(generator):
    weights = torch.rand(9, 30, generator=generator) ** 8
    u = torch.rand(9, 200, generator=generator).sort(-1).values
    samples = sample_histogram(torch.linspace(0, 1, 31).expand(9, -1), weights, u)
    assert bool((samples.diff(dim=-1) >= 0).all())

"""Rendering of ragged samples: the twins, and the dense quadrature."""

import pytest
import torch

from nerf_lightning.nerf.kernels.ragged.op import integrate, num_visible
from nerf_lightning.nerf.kernels.ragged.reference import integrate_torch, transmittance_torch
from nerf_lightning.nerf.rendering.quadrature import weights_from_density
from nerf_lightning.nerf.types.rays import RaggedSamples


def packed(counts, dtype=torch.float32):
    counts = torch.tensor(counts)
    total = int(counts.sum())
    index = torch.repeat_interleave(torch.arange(counts.numel()), counts)
    bounds = torch.cat([torch.zeros(1, dtype=torch.long), counts.cumsum(0)])
    starts = 2.0 + 0.05 * (torch.arange(total) - bounds[index]).to(dtype)
    samples = RaggedSamples(index, starts, starts + 0.05, bounds, bounds[-1])
    return (5 * torch.rand(total, dtype=dtype)).exp() - 1, torch.rand(total, 3, dtype=dtype), samples


COUNTS = [[3, 0, 5, 1, 40, 0], [0, 0], [1], list(range(60))]


@pytest.mark.parametrize("counts", COUNTS)
def test_the_numba_twin_equals_the_reference_in_value_and_gradient(counts):
    density, rgb, samples = packed(counts)
    results = []
    for fn, dtype in ((integrate, torch.float32), (integrate_torch, torch.float64)):
        leaves = [x.to(dtype, copy=True).requires_grad_() for x in (density, rgb)]
        placed = RaggedSamples(
            samples.ray_index, samples.starts.to(dtype), samples.ends.to(dtype), samples.bounds, samples.found
        )
        out = fn(*leaves, placed)
        torch.manual_seed(3)
        loss = sum((part * torch.randn(part.shape, dtype=torch.float64).to(dtype)).sum() for part in out)
        loss.backward()
        results.append([*(part.detach() for part in out), *(leaf.grad for leaf in leaves)])
    for found, expected in zip(*results, strict=True):
        torch.testing.assert_close(found.double(), expected, rtol=2e-4, atol=2e-5)


@pytest.mark.parametrize("longest", [None, 64])
def test_light_is_exact_in_float32_whatever_other_rays_stop(longest):
    density, _, samples = packed([40, 0, 7] * 200)
    padding = torch.zeros(1000)
    samples = RaggedSamples(
        torch.cat([samples.ray_index, torch.arange(1000) % 600]), torch.cat([samples.starts, padding]),
        torch.cat([samples.ends, padding]), samples.bounds, samples.found, longest,
    )  # fmt: skip
    # Every other ray meets something so opaque that a sum over all of them would keep nothing of the rest.
    density = torch.cat([torch.where(samples.ray_index[:-1000] % 2 == 0, 1e9 * density, density), padding])
    leaf = density.clone().requires_grad_()
    light = transmittance_torch(leaf, samples)
    light.sum().backward()
    expected = density.double()
    for start, end in zip(samples.bounds[:-1].tolist(), samples.bounds[1:].tolist(), strict=True):
        optical = expected[start:end] * samples.deltas[start:end].double()
        exact = torch.exp(-(optical.cumsum(0) - optical))
        torch.testing.assert_close(light[start:end].double(), exact, rtol=1e-4, atol=1e-7)
        behind = exact.flip(0).cumsum(0).flip(0) - exact
        torch.testing.assert_close(
            leaf.grad[start:end].double(), -behind * samples.deltas[start:end].double(), rtol=1e-4, atol=1e-7
        )
    assert bool((light[samples.bounds[-1] :] == 1.0).all())


def test_it_is_the_dense_quadrature_in_another_layout():
    density, _, samples = packed([7] * 5, torch.float64)
    dense = weights_from_density(density.view(5, 7), samples.deltas.view(5, 7))
    _, opacity, depth, weights = integrate(density, torch.rand(35, 3, dtype=torch.float64), samples)
    torch.testing.assert_close(weights.view(5, 7), dense)
    torch.testing.assert_close(opacity, dense.sum(-1))
    torch.testing.assert_close(depth, (dense * samples.midpoints.view(5, 7)).sum(-1))


def test_gradients_stay_finite_at_extreme_densities():
    density, rgb, samples = packed([6, 9])
    density = torch.tensor([0.0, 1e-30, 1e13, 1e30, 1.0] * 3).requires_grad_()
    foreground, opacity, depth, weights = integrate(density, rgb.requires_grad_(), samples)
    (foreground.sum() + opacity.sum() + depth.sum() + weights.sum()).backward()
    assert bool(density.grad.isfinite().all())
    assert bool(rgb.grad.isfinite().all())
    assert bool((opacity <= 1 + 1e-5).all())


@pytest.mark.parametrize("counts", COUNTS)
def test_a_ray_is_visible_up_to_where_it_is_opaque(counts):
    density, _, samples = packed(counts)
    counted = num_visible(density, samples, 0.1)
    light = transmittance_torch(density.double(), samples)
    for ray, (start, end) in enumerate(zip(samples.bounds[:-1].tolist(), samples.bounds[1:].tolist(), strict=True)):
        assert int(counted[ray]) == int((light[start:end] > 0.1).sum())

"""The smaller triton kernels against their references, on a GPU or through triton's interpreter."""

import importlib
from contextlib import contextmanager
from dataclasses import replace
from unittest.mock import patch

import torch
from support.pixel_batches import check_pixels  # noqa: F401 -- check_all finds it by name
from support.triton_rays import check_rays  # noqa: F401

from nerf_lightning.nerf.encoders.hash_grid import HashGridEncoder
from nerf_lightning.nerf.encoders.spherical_harmonics import SphericalHarmonicsEncoder
from nerf_lightning.nerf.fields.ngp_field import NGPField
from nerf_lightning.nerf.geometry.boxes import distances_in_box
from nerf_lightning.nerf.kernels import backends
from nerf_lightning.nerf.kernels.march.grid import MarchState, OccupancyCells, blocks_of, leaps_over
from nerf_lightning.nerf.kernels.march.reference import march_torch
from nerf_lightning.nerf.kernels.ragged.reference import first_of_each_ray_torch, integrate_torch, transmittance_torch
from nerf_lightning.nerf.kernels.table_adam.op import adam_step_torch
from nerf_lightning.nerf.losses.proposal import distortion_loss, interlevel_loss
from nerf_lightning.nerf.randomness import batch_random, purpose_word
from nerf_lightning.nerf.rendering.histograms import sample_histogram
from nerf_lightning.nerf.rendering.near_gradients import soften_near_gradients
from nerf_lightning.nerf.rendering.quadrature import closed_weights, weights_from_density
from nerf_lightning.nerf.rendering.sample_points import points_along, ragged_points
from nerf_lightning.nerf.samplers.stratified import stratified_edges
from nerf_lightning.nerf.types.rays import RaggedSamples, RayBundle, RaySamples
from nerf_lightning.nerf.types.renderings import DenseRendering

SMALL = [name for name in backends.CUDA_BACKENDS if name not in ("hash_grid.cuda", "mlp.cuda")]


def check_all(device, generator, rays=70, names=SMALL):
    for name in names:
        kernels = importlib.import_module(f"{backends.KERNELS}.{name}")
        with forced():
            kernels.trial(device)
        globals()[f"check_{name.partition('.')[0]}"](kernels, device, generator, rays)


def check_random(kernels, device, generator, rays):
    """Bit for bit."""
    random = batch_random(0xFEDCBA98, rays, device, first=0xFFFFFF00)
    for count in (1, 3, 65):
        expected = random.along(count).uniform("strata")
        assert torch.equal(kernels.uniform(random.key, random.slots, purpose_word("strata"), count), expected)


def check_table_adam(kernels, device, generator, rays):
    """Of several parameters at once; where the gradient is zero nothing changes; NaN counts as touched."""
    found = []
    for count in (1300, 1, 0, 1024):
        rows = torch.randn(4, count, generator=generator).to(device)
        rows[1][::3], rows[3] = 0.0, rows[3].square()
        found.append(rows)
    found[0][1, 4] = torch.nan
    given = [rows.clone() for rows in found]
    numbers = 1e-2, 1.3, 0.9, 0.99, 1e-15
    table, of_all = kernels.address_table([rows.unbind() for rows in found]), torch.tensor([numbers] * len(found))
    for _ in range(2):
        kernels.adam_steps(*table, of_all.to(device))
        assert not any(rows[1].any() for rows in found)
        for rows, before in zip(found, given, strict=True):
            expected = before.double()
            adam_step_torch(*expected, *numbers)
            torch.testing.assert_close(rows.double(), expected, rtol=1e-5, atol=1e-6, equal_nan=True)
            assert torch.equal(rows[:, ::3][[0, 2, 3]], before[:, ::3][[0, 2, 3]])
            rows.copy_(before)


def check_spherical_harmonics(kernels, device, generator, rays):
    directions = torch.nn.functional.normalize(torch.randn(rays, 3, generator=generator), dim=-1)
    for degree in range(1, 5):
        found = kernels.spherical_harmonics(directions.to(device), degree)
        torch.testing.assert_close(found.cpu(), SphericalHarmonicsEncoder(degree)(directions), rtol=1e-5, atol=1e-6)
        assert kernels.spherical_harmonics(directions[:0].to(device), degree).shape == (0, degree**2)


SOLID = -1.0


def a_march(device, generator, count, share, resolution=16, step=0.05):
    aabb = torch.tensor([[-1.0, -1.2, -0.9], [1.0, 1.2, 0.9]])
    origins = 4.0 * torch.nn.functional.normalize(torch.randn(count, 3, generator=generator), dim=-1)
    aim = 0.8 * torch.randn(count, 3, generator=generator)
    directions = torch.nn.functional.normalize(aim - origins, dim=-1)
    rays = RayBundle(origins, directions, torch.full((count,), 2.0), torch.full((count,), 6.0), directions)
    cells = torch.rand(resolution, resolution, resolution, generator=generator) < share
    if share == SOLID:  # a ball with nothing around it, which leaps lead up to
        axis = torch.linspace(-1.0, 1.0, resolution)
        cells = torch.cartesian_prod(axis, axis, axis).norm(dim=-1).view(cells.shape) < 0.7
    cells = cells.to(torch.uint8)
    jitter = torch.rand(count, generator=generator)
    state = MarchState(*distances_in_box(rays, aabb), jitter, torch.zeros(count, dtype=torch.long))
    lattice = 1.9 + step * torch.arange(round(4.3 / step))
    return *(each.to(device) for each in (rays, state, lattice)), OccupancyCells(
        aabb.to(device), cells.to(device), leaps_over(blocks_of(cells)).to(device)
    )


def check_march(kernels, device, generator, rays):
    cases = [(share, limit, capacity) for share in (0.0, 0.03, 1.0) for limit, capacity in ((None, 4000), (5, None))]
    for share, limit, capacity in [*cases, (0.5, None, 100), (0.5, None, None), (SOLID, None, None)]:
        fine = {"resolution": 64, "step": 0.01} if share == SOLID else {}  # four times as many steps
        given = a_march(device, generator, rays // 4 if fine else rays, share, **fine)
        for one, other in zip(
            kernels.distances_in_box(given[0], given[3].aabb), (given[1].enter, given[1].leave), strict=True
        ):
            torch.testing.assert_close(one, other)
        found, following = kernels.march(*given, limit, capacity)
        expected, expected_following = march_torch(*given, limit, capacity)
        assert found.longest == expected.longest
        counts = [samples.bounds.diff() for samples in (found, expected)]
        # A midpoint on a cell's face, to the last bit, may fall to either side.
        other = int((counts[0] != counts[1]).sum()), abs(int(found.found) - int(expected.found))
        if any(other):
            assert max(other) <= 1 + rays // 1000
            continue
        assert torch.equal(following, expected_following)
        assert torch.equal(found.ray_index, expected.ray_index)
        torch.testing.assert_close(found.starts, expected.starts)
        torch.testing.assert_close(found.ends, expected.ends)


def some_ragged_samples(device, generator, rays, padding):
    counts = torch.randint(0, 90, (rays,), generator=generator)
    counts[-3:] = torch.tensor([0, 1, 32])[3 - min(rays, 3) :]
    bounds = torch.nn.functional.pad(counts.cumsum(0), (1, 0))
    total = int(bounds[-1])
    index = torch.cat([torch.arange(rays).repeat_interleave(counts), torch.arange(padding) % rays])
    length = torch.cat([0.1 * torch.rand(total, generator=generator), torch.zeros(padding)])
    starts = 2.0 + torch.arange(total + padding) % 100 * 0.01
    parts = index, starts, starts + length, bounds, bounds[-1]
    return RaggedSamples(*(each.to(device) for each in parts), longest=90)


def check_ragged(kernels, device, generator, rays):
    samples = some_ragged_samples(device, generator, rays, padding=77)
    capacity, total = samples.starts.shape[0], int(samples.found)
    density = torch.exp(3.0 * torch.randn(capacity, generator=generator))
    density[5], density[20] = 0.0, 1e13  # empty, and so dense that nothing is seen behind it
    density, rgb = density.to(device), torch.rand(capacity, 3, generator=generator).to(device)
    leaves = [each.double().requires_grad_() for each in (density, rgb)]
    double = samples.map(lambda each: each.double() if each.is_floating_point() else each)
    expected = integrate_torch(*leaves, double)
    grads = [torch.randn(each.shape, generator=generator).to(device) for each in expected]
    torch.autograd.backward(expected, [each.double() for each in grads])
    given = density, rgb, samples.starts, samples.ends, samples.bounds
    found = kernels.integrate(*given)
    for one, other in zip(found, expected, strict=True):
        torch.testing.assert_close(one.double(), other.detach(), rtol=1e-5, atol=2e-6)
    of_density, of_rgb = kernels.integrate_gradient(*given, found[3], *grads)
    torch.testing.assert_close(of_density[:total].double(), leaves[0].grad[:total], rtol=2e-4, atol=2e-6)
    torch.testing.assert_close(of_rgb.double(), leaves[1].grad, rtol=1e-5, atol=2e-6)
    assert not of_density[total:].any()
    light = transmittance_torch(leaves[0].detach(), double) > 1e-3
    light[total:] = False
    seen = torch.zeros_like(samples.bounds[1:]).index_add(0, samples.ray_index, light.long())
    assert torch.equal(kernels.num_visible(density, samples, 1e-3), seen)
    check_first_of_each_ray(kernels, samples, seen, rgb)


def check_first_of_each_ray(kernels, samples, seen, features):
    """Bit for bit: with room, full, exceeded by one and by most, and of no rays."""
    visible = int(seen.sum())
    for capacity in (visible + 40, visible, visible - 1, 3, 0):
        for given in (features, None):
            found = kernels.first_of_each_ray(samples, seen, given, capacity)
            assert_same_samples(found, first_of_each_ray_torch(samples, seen, given, capacity))
    none = RaggedSamples(seen[:0], features[:0, 0], features[:0, 0], 0 * samples.bounds[:1], samples.found, 90)
    found = kernels.first_of_each_ray(none, seen[:0], features[:0], 0)
    assert_same_samples(found, first_of_each_ray_torch(none, seen[:0], features[:0], 0))


def assert_same_samples(found, expected):
    for one, other in zip(found[0].tensors(), expected[0].tensors(), strict=True):
        assert torch.equal(one, other)
    assert found[0].longest == expected[0].longest
    assert (found[1] is None) == (expected[1] is None)
    assert found[1] is None or torch.equal(found[1], expected[1])


def check_histograms(kernels, device, generator, rays):
    for bins, count, contracted in ((5, 3, False), (64, 48, True), (63, 128, False)):
        edges = (0.2 + torch.rand(rays, bins + 1, generator=generator).cumsum(dim=-1) / 8).to(device)
        weights = torch.rand(rays, bins, generator=generator).square().to(device)
        weights[0] = 0.0
        u = torch.rand(rays, count, generator=generator).sort(dim=-1).values.to(device)
        u[:, -1] = 1.0 - 2.0**-24
        found = kernels.sample_histogram(edges, weights, u, 0.01, contracted)
        expected = sample_histogram(edges.double(), weights.double(), u.double(), 0.01, contracted)
        torch.testing.assert_close(found.double(), expected, rtol=1e-4, atol=1e-5)
        found[:, 1] = edges[:, 1]  # edges that are equal
        _check_losses(kernels, edges, weights, found.sort(dim=-1).values, contracted, generator)
        jitter = torch.rand(rays, count - 2, generator=generator).sub(0.5).div(count).to(device)
        ends = torch.rand(2, rays, generator=generator).sort(dim=0).values.mul(0.999999).to(device)
        for moved in (None, jitter):
            given = torch.linspace(0, 1, count, device=device), moved, *ends
            expected = stratified_edges(*(None if each is None else each.double() for each in given), contracted)
            torch.testing.assert_close(
                kernels.stratified_edges(*given, contracted).double(), expected, rtol=1e-4, atol=1e-6
            )


def _check_losses(kernels, outer, v, inner, contracted, generator):
    w = torch.rand(*inner.diff(dim=-1).shape, generator=generator).to(outer.device) / 4
    for loss, leaf, found in (
        (lambda v: interlevel_loss(rendering(inner, w), rendering(outer, v)), v, lambda v: kernels.interlevel_loss(
            rendering(inner, w), rendering(outer, v))),
        (lambda w: distortion_loss(rendering(inner, w, contracted)), w, lambda w: kernels.distortion_loss(
            rendering(inner, w, contracted))),
    ):  # fmt: skip
        single, double = leaf.clone().requires_grad_(), leaf.double().requires_grad_()
        expected, values = loss(double), found(single)
        grad = torch.rand(values.shape, generator=generator).to(values.device)
        expected.backward(grad.double())
        values.backward(grad)
        torch.testing.assert_close(values.double(), expected, rtol=1e-4, atol=1e-6)
        torch.testing.assert_close(single.grad.double(), double.grad, rtol=1e-4, atol=1e-4)


def rendering(edges, weights, contracted=False):
    """A rendering of which only samples and weights are looked at, in the precision of the weights."""
    edges, nothing = edges.to(weights.dtype), weights.new_zeros(len(weights))
    light = nothing[:, None].expand(-1, 3)
    return DenseRendering(light, light, nothing, nothing, weights=weights, samples=RaySamples(edges, contracted))


def check_render(kernels, device, generator, rays):
    """From rays to pixels, with gradients, against the levels' way in plain torch and float64."""
    for samples_of in (some_dense_samples, some_ragged_samples):
        for contracted, colored, whole_from in ((False, True, 0.0), (True, True, 3.0), (True, False, 0.0)):
            samples = samples_of(device, generator, rays, padding=9)
            field = NGPField(
                HashGridEncoder(4, 2, 8, 4, 32), SphericalHarmonicsEncoder(), width=16, contraction=contracted
            )
            for parameter in field.parameters():
                parameter.data.uniform_(-0.5, 0.5, generator=generator)
            field.aabb.copy_(1.5 * torch.tensor([[-1.0] * 3, [1.0] * 3]))
            field.color_mlp[-1].data *= 30.0  # some colors are nearly black, or full
            field.least_slope = 0.003
            field.to(device)
            bundle = some_rays(generator, rays).to(device)
            parts = field.parts()
            parts = parts if colored else replace(parts, color_weights=[])
            with forced():
                features = None
                if isinstance(samples, RaggedSamples):
                    density, features = kernels.density(bundle, samples, parts, "float32")
                    used = int(samples.found)
                    exact = field.density(ragged_points(bundle, samples, None))[0]
                    torch.testing.assert_close(density[:used], exact[:used].detach(), rtol=1e-4, atol=1e-5)
                found = kernels.render(bundle, samples, parts, "float32", True, whole_from, features)
            grads = [torch.randn(each.shape, generator=generator).to(device) for each in found]
            torch.autograd.backward(found, grads)
            gradients = [parameter.grad.clone() for parameter in field.parameters() if parameter.grad is not None]
            expected = in_double(field.double(), bundle, samples, colored, whole_from)
            field.zero_grad()
            torch.autograd.backward(expected, [each.double() for each in grads])
            for one, other in zip(found, expected, strict=True):
                torch.testing.assert_close(one.double(), other, rtol=1e-4, atol=1e-5)
            others = [parameter.grad for parameter in field.parameters() if parameter.grad is not None]
            for one, other in zip(gradients, others, strict=True):
                assert float((one - other).norm()) <= 1e-4 * float(other.norm()), (one.shape, contracted, colored)


def check_field(kernels, device, generator, rays):
    """Both MLPs in one pass against each by itself, which rounds the same numbers to bfloat16, but for gradients."""
    few = max(1, rays // 5)
    for samples_of, count, color_layers, contracted, whole_from, slope in (
        (some_dense_samples, few, 1, True, 3.0, 0.003),
        (some_ragged_samples, few, 1, False, 0.0, 0.0),
        (some_dense_samples, few, 2, False, 0.0, 0.0),
        (some_ragged_samples, few, 2, True, 3.0, 0.003),
        (some_ragged_samples, 1, 0, False, 0.0, 0.0),
        (some_ragged_samples, 0, 1, False, 0.0, 0.0),
        (some_ragged_samples, 0, 2, False, 0.0, 0.0),
    ):
        samples = samples_of(device, generator, count, padding=300 if count else 0)
        field = NGPField(
            HashGridEncoder(4, 4, 8, 4, 32), SphericalHarmonicsEncoder(), width=32, feature_dim=12,
            color_layers=max(1, color_layers), contraction=contracted,
        )  # fmt: skip
        for parameter in field.parameters():
            parameter.data.uniform_(-0.5, 0.5, generator=generator)
        field.aabb.copy_(1.5 * torch.tensor([[-1.0] * 3, [1.0] * 3]))
        field.least_slope = slope
        field.to(device)
        bundle = some_rays(generator, count).to(device)
        parts = field.parts() if color_layers else replace(field.parts(), color_weights=[])
        (found, gradients), (expected, others) = (
            rendered_with(fused, field, parts, bundle, samples, whole_from) for fused in (kernels, None)
        )
        assert len(gradients) == len(others)
        for one, other in zip(found, expected, strict=True):
            torch.testing.assert_close(one, other, rtol=2e-3, atol=2e-4)
        for one, other in zip(gradients, others, strict=True):
            assert float((one - other).norm()) <= 1e-2 * float(other.norm()), (one.shape, color_layers)  # 2^-8
    assert not kernels.takes((32, 64, 16), (32, 64, 64, 64, 3), torch.device(device))
    assert not kernels.takes((32, 128, 16), (32, 64, 3), torch.device(device))


def rendered_with(fused, field, parts, rays, samples, whole_from):
    """Return integrals, and gradients of the field's weights; None: with a kernel for each MLP."""
    from nerf_lightning.nerf.kernels.mlp import cuda as mlps
    from nerf_lightning.nerf.kernels.mlp.op import _TiledMLP
    from nerf_lightning.nerf.kernels.render import cuda as render

    def single(points, weights, *_):
        return _TiledMLP.apply(points, mlps, torch.float32, (), *weights)

    field.zero_grad()
    with forced(), patch.object(render, "cuda_backend", lambda *given: fused), patch.object(render, "mlp", single):
        assert render._fused(parts, rays, "bfloat16") is fused
        found = render.render(rays, samples, parts, "bfloat16", True, whole_from, None)
    torch.autograd.backward(found, [torch.arange(each.numel()).sin().to(each).view(each.shape) for each in found])
    return found, [each.grad.clone() for each in field.parameters() if each.grad is not None]


def some_rays(generator, count):
    origins = torch.tensor([0.0, 0.0, -2.0]) + 0.5 * torch.randn(count, 3, generator=generator)
    directions = torch.nn.functional.normalize(0.3 * torch.randn(count, 3, generator=generator) - origins, dim=-1)
    return RayBundle(origins, directions, origins[:, 0], origins[:, 0], directions)


def some_dense_samples(device, generator, rays, padding):
    edges = 0.5 + torch.rand(rays, 38, generator=generator).cumsum(dim=-1) / 6
    return RaySamples(edges.to(device), contracted_spacing=True)


def in_double(field, rays, samples, colored, whole_from):
    """Foreground, opacity, depth and weights in plain torch."""
    double = [each.map(lambda part: part.double() if part.is_floating_point() else part) for each in (rays, samples)]
    dense = isinstance(samples, RaySamples)
    output = field((points_along if dense else ragged_points)(*double, None))
    output = output if colored else replace(output, rgb=torch.zeros_like(output.rgb))
    if whole_from:
        output = soften_near_gradients(output, double[1].midpoints, whole_from)
    if not dense:
        return integrate_torch(output.density, output.rgb, double[1])
    weights = closed_weights(weights_from_density(output.density, double[1].deltas))
    depth = (weights * double[1].midpoints).sum(dim=-1)
    return (weights[..., None] * output.rgb).sum(dim=-2), weights.sum(dim=-1), depth, weights


@contextmanager
def forced():
    """Let the quadrature be the one for CUDA, on whatever device."""
    from nerf_lightning.nerf.kernels.ragged import cuda, op

    with (
        patch.object(op, "backend_for", lambda *given: cuda),
        patch.object(op, "cuda_backend", lambda *given: cuda),
    ):
        yield

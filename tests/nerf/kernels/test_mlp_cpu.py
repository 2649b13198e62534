"""The perceptron that stays in the cache, in float32 and bfloat16, against the same roundings in plain torch."""

from itertools import pairwise

import numpy as np
import pytest
import torch
from support.comparing import far_apart
from support.ragged_levels import needs_bfloat16

from nerf_lightning.nerf.kernels import backends
from nerf_lightning.nerf.kernels.mlp import amx
from nerf_lightning.nerf.kernels.mlp.op import mlp, mlp_torch
from nerf_lightning.nerf.matmul_precision import TILE_ROWS

SIZES = [(32, 64, 16), (32, 64, 64, 3), (16, 16, 5), (48, 80, 128, 7), (16, 1)]
ROWS = [0, 1, 127, 129, TILE_ROWS + 17]


@pytest.fixture
def kernels():
    return backends.backend("nerf_lightning.nerf.kernels.mlp.cpu")


@pytest.fixture(params=["float32", pytest.param("bfloat16", marks=needs_bfloat16), "bfloat16 by tiles"])
def dtype(request, kernels, monkeypatch):
    name, *tiled = request.param.split(" by ")
    if tiled and not isinstance(kernels.KINDS[torch.bfloat16], type(amx.KIND)):  # zeros of two types are equal
        pytest.skip("this CPU has no AMX, or this process may not use it")
    if name == "bfloat16":
        monkeypatch.setitem(kernels.KINDS, torch.bfloat16, amx.KIND if tiled else np.int32(0))
    return getattr(torch, name)


def given(sizes, rows, dtype):
    return torch.randn(rows, sizes[0]), [(torch.randn(b, a) / a**0.5).to(dtype) for a, b in pairwise(sizes)]


def reference(points, weights, grad):
    """Outputs and gradients in float64, of numbers rounded where the kernels round them."""

    def rounded(x):
        return x.to(weights[0].dtype).double()

    inputs, exact = [rounded(points)], [weight.double() for weight in weights]
    for weight in exact[:-1]:
        inputs.append(rounded((inputs[-1] @ weight.t()).clamp(min=0.0)))
    out, flowing, grads = inputs[-1] @ exact[-1].t(), rounded(grad), []
    for number in reversed(range(len(weights))):
        grads.insert(0, flowing.t() @ inputs[number])
        flowing = flowing @ exact[number]
        if number:
            flowing = rounded(flowing * (inputs[number] > 0))
    return [out, flowing, *grads]


@pytest.mark.parametrize("rows", ROWS)
@pytest.mark.parametrize("sizes", SIZES)
def test_it_is_what_the_same_roundings_give(kernels, sizes, rows, dtype):
    points, weights = given(sizes, rows, dtype)
    grad = torch.randn(rows, sizes[-1])
    out, kept = kernels.forward(points, weights, keep=True)
    of_points, of_weights = kernels.backward(grad, weights, kept, wants_points=True)
    assert of_points.shape == points.shape
    for found, expected in zip([out, of_points, *of_weights], reference(points, weights, grad), strict=True):
        # A sum in float32 may round to the other neighbor than the exact one does: a unit here and there.
        assert far_apart(found, expected) < 2e-3


@pytest.mark.parametrize("sizes", SIZES)
def test_a_row_does_not_depend_on_its_neighbours_nor_on_what_is_kept(kernels, sizes, dtype):
    points, weights = given(sizes, 300, dtype)
    out, _ = kernels.forward(points, weights, keep=False)
    assert torch.equal(kernels.forward(points, weights, keep=True)[0], out)
    for part in (slice(7, 8), slice(100, 229)):
        assert torch.equal(kernels.forward(points[part], weights, keep=False)[0], out[part])


def test_gradients_of_weights_do_not_see_what_memory_held_before(kernels, dtype):
    points, weights = given((32, 64, 3), 130, dtype)
    grad, results = torch.randn(130, 3), []
    for dirt in (0.0, torch.nan, 3.0):
        _ = [torch.full((256, size), dirt) for size in (48, 64, 32, 3)]  # what the next ones are likely to be given
        _, kept = kernels.forward(points, weights, keep=True)
        results.append(torch.cat([each.flatten() for each in kernels.backward(grad, weights, kept, False)[1]]))
    assert torch.equal(results[0], results[1])
    assert torch.equal(results[0], results[2])


def test_the_result_does_not_depend_on_the_threads(dtype, set_threads):
    points, weights = given((32, 64, 3), 3 * TILE_ROWS, dtype)
    results = []
    for threads in (1, 2):
        set_threads(threads)
        leaves = [weight.float().clone().requires_grad_() for weight in weights]
        mlp(points, leaves, "bfloat16" if dtype == torch.bfloat16 else "float32").square().sum().backward()
        results.append(torch.cat([leaf.grad.flatten() for leaf in leaves]))
    assert torch.equal(*results)


@pytest.mark.parametrize("value", [torch.nan, torch.inf])
def test_what_is_no_number_stays_that(kernels, value, dtype):
    points, weights = given((16, 32, 2), 10, dtype)
    points[3, 5] = value
    out, _ = kernels.forward(points, weights, keep=False)
    assert not out[3].isfinite().all()
    assert out[torch.arange(10) != 3].isfinite().all()


def test_gradients_of_the_points_are_left_out_where_nobody_asks(kernels, dtype):
    points, weights = given((32, 64, 3), 200, dtype)
    out, kept = kernels.forward(points, weights, keep=True)
    assert kernels.backward(out, weights, kept, wants_points=False)[0] is None


def test_other_widths_take_the_other_way(monkeypatch, kernels, dtype):
    points, weights = given((27, 64, 3), 500, torch.float32)
    monkeypatch.setattr(kernels, "_forward", lambda *arguments: pytest.fail("not this way"))
    matmul_precision = "bfloat16" if dtype == torch.bfloat16 else "float32"
    assert far_apart(mlp(points, weights, matmul_precision), mlp_torch(points, weights).double()) < 2e-2


def test_a_compiler_that_does_not_know_the_instructions_is_not_asked(monkeypatch, kernels):
    """LLVM would end the program."""
    monkeypatch.setattr(kernels, "CPU", {"avx512f": True})
    assert kernels.dtypes() == [torch.float32]
    assert not kernels.takes([torch.ones(16, 16)], torch.bfloat16)


def weights(*sizes):
    return [torch.randn(b, a) / a**0.5 for a, b in pairwise(sizes)]


@pytest.mark.parametrize("rows", [0, 1, TILE_ROWS, 2 * TILE_ROWS + 17])
@pytest.mark.parametrize("sizes", [(32, 64, 16), (32, 64, 64, 3), (5, 2)])
def test_tiles_equal_the_reference_in_value_and_gradient(rows, sizes):
    # In float64: in float32 a unit within rounding of zero is on in one and off in the other.
    points, used = torch.randn(rows, sizes[0], dtype=torch.float64), [w.double() for w in weights(*sizes)]
    results = []
    for fn in (mlp, mlp_torch):
        leaves = [x.detach().clone().requires_grad_() for x in (points, *used)]
        out = fn(leaves[0], leaves[1:])
        out.square().sum().backward()
        results.append([out.detach(), *(leaf.grad for leaf in leaves)])
    for found, expected in zip(*results, strict=True):
        assert float((found - expected).norm()) <= 1e-12 * float(expected.norm())


@pytest.mark.parametrize("rows", [100, TILE_ROWS + 700])
def test_it_multiplies_bfloat16_where_it_is_told_to_and_adds_up_gradients_in_float32(rows):
    points, used = torch.randn(rows, 32), weights(32, 64, 3)
    exact = mlp(points, used)
    half = mlp(points, [weight.requires_grad_() for weight in used], "bfloat16")
    half.sum().backward()
    error = float((half.detach() - exact).norm() / exact.norm())
    assert 1e-4 < error < 2e-2
    assert half.dtype == torch.float32
    assert all(weight.grad.dtype == torch.float32 for weight in used)
    leaves = [weight.detach().requires_grad_() for weight in used]
    mlp(points, leaves).sum().backward()
    # Beside the rounding itself, units near zero are on in one precision and off in the other.
    for found, expected in zip(used, leaves, strict=True):
        assert float((found.grad - expected.grad).norm()) < 6e-2 * float(expected.grad.norm())

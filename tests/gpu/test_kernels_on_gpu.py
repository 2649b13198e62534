"""Kernels on the GPU: the checks of the self-test, and triton's hash grid on as many points as a step has."""

import pytest
import torch
from support.triton_perceptron import check_perceptron
from support.triton_twin import check_against_the_reference

from nerf_lightning.nerf.kernels import backends
from nerf_lightning.nerf.kernels.hash_grid.layout import hash_grid_layout
from nerf_lightning.nerf.kernels.hash_grid.op import interpolate

kernels = pytest.importorskip("nerf_lightning.extensions.selftest.kernels")
check = pytest.importorskip("nerf_lightning.extensions.selftest.check")
pytestmark = pytest.mark.gpu
PRODUCTS = ("float32", "tf32", "bfloat16")


def checks(device):
    matmul_precision = PRODUCTS if device == "cuda" else ("float32", "bfloat16")
    return {each.name: each for each in kernels.checks(torch.device(device), matmul_precision)}


@pytest.mark.parametrize("name", checks("cuda"))
def test_a_kernel_agrees_with_its_reference(name, device):
    found = checks(device.type)
    if name not in found:
        pytest.skip("this is of GPUs alone")
    row = check.carried_out(found[name])
    assert row.outcome == "ok", f"{row.difference} exceeds {row.bound}: {row.note}"


def test_triton_agrees_on_many_points_and_in_half_precision(cuda):
    check_against_the_reference("cuda", 30_000)


def test_tritons_perceptron_agrees_on_whole_numbers(cuda):
    check_perceptron("cuda", [0, 1, 127, 128, 129, 70_000])


@pytest.mark.parametrize("count", [0, 1, 127, 128, 129, 1 << 20])
def test_triton_takes_any_number_of_points(count, cuda, generator):
    kernels = "nerf_lightning.nerf.kernels.hash_grid.cuda"
    assert backends.backend(kernels) is not None, backends.why_not(kernels)
    layout = hash_grid_layout(16, 19, 16, 2048)  # model=fast_large: the last entry's place takes 24 bits
    table = torch.randn(layout.offsets[-1], 2, generator=generator)
    points = torch.randint(0, 4096, (count, 3), generator=generator) / 4096.0
    few = slice(None, None, max(1, count // 2000))
    leaf = table.to(cuda).requires_grad_()
    found = interpolate(leaf, points.to(cuda), layout)
    expected = interpolate(table.double(), points[few].double(), layout)
    torch.testing.assert_close(found.detach().cpu()[few].double(), expected, rtol=0, atol=16 * 2.0**-24 * 6)
    found.sum().backward()
    # Each point gives each feature of each level weights that add up to 1.
    expected_sum = torch.tensor(16.0 * count, dtype=torch.float64)
    torch.testing.assert_close(leaf.grad[:, 0].double().sum().cpu(), expected_sum, rtol=1e-5, atol=0)


def test_where_triton_does_not_compile_plain_torch_does_its_work(device, generator, monkeypatch):
    layout = hash_grid_layout(4, 10, 4, 32)
    table = torch.randn(layout.offsets[-1], 2, generator=generator)
    points = torch.rand(500, 3, generator=generator)
    expected = interpolate(table.double(), points.double(), layout)
    monkeypatch.setattr("nerf_lightning.nerf.kernels.hash_grid.op.cuda_backend", lambda *given: None)
    found = interpolate(table.to(device), points.to(device), layout)
    torch.testing.assert_close(found.cpu().double(), expected, rtol=0, atol=1e-4)

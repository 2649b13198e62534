"""The CUDA twin of the hash grid: on a GPU where there is one, else through triton's interpreter."""

import os
import subprocess
import sys

import pytest
import torch

from nerf_lightning.kernels.hash_grid import hash_grid_layout
from nerf_lightning.kernels.hash_grid_torch import interpolate_torch

CHECK = """
import sys
import torch
sys.path.insert(0, "tests/kernels")
from test_hash_grid_triton import check_against_the_reference
check_against_the_reference("cpu", 300)
"""


def check_against_the_reference(device, count):
    from nerf_lightning.kernels import hash_grid_triton as twin

    for features, levels, size in ((2, 3, 10), (4, 5, 12)):
        layout = hash_grid_layout(levels, size, 4, 64)
        table = torch.randn(layout.offsets[-1], features, device=device)
        points = 1.2 * torch.rand(count, 3, device=device) - 0.1
        grad = torch.randn(count, levels * features, device=device)
        leaf = table.clone().requires_grad_()
        expected = interpolate_torch(leaf, points, layout)
        expected.backward(grad)
        found, gradient = twin.forward(table, points, layout), torch.zeros_like(table)
        twin.add_table_gradient(gradient, points, grad, layout)
        assert float((found - expected.detach()).norm() / expected.detach().norm()) < 1e-5
        assert float((gradient - leaf.grad).norm() / leaf.grad.norm()) < 1e-5
        half = twin.forward(table.half(), points, layout)
        assert 1e-6 < float((half - expected.detach()).norm() / expected.detach().norm()) < 2e-3


@pytest.mark.gpu
@pytest.mark.skipif(not torch.cuda.is_available(), reason="needs a CUDA device")
def test_on_a_gpu():
    check_against_the_reference("cuda", 30_000)


def test_through_the_interpreter():
    pytest.importorskip("triton", reason="triton is not installed (Linux only)")
    # The interpreter is chosen when the kernels are defined: a process of its own.
    environment = os.environ | {"TRITON_INTERPRET": "1"}
    result = subprocess.run([sys.executable, "-c", CHECK], env=environment, capture_output=True, text=True)
    assert result.returncode == 0, result.stderr

"""The CUDA twin of the perceptron through triton's interpreter; tests/gpu has it on a GPU."""

import os
import subprocess
import sys

import pytest

CHECK = """
import sys
sys.path.insert(0, "tests")
from nerf_lightning.nerf.kernels.mlp import cuda
from support.triton_perceptron import check_perceptron
cuda.PROGRAMS = 2  # so that one takes several blocks
check_perceptron("cpu", [0, 1, 640])
"""


def test_through_the_interpreter():
    pytest.importorskip("triton", reason="triton is not installed (Linux only)")
    # The interpreter is chosen when the kernels are defined: a process of its own.
    environment = os.environ | {"TRITON_INTERPRET": "1"}
    result = subprocess.run([sys.executable, "-c", CHECK], env=environment, capture_output=True, text=True)
    assert result.returncode == 0, result.stderr

"""The CUDA twins through triton's interpreter; tests/gpu has them on a GPU."""

import os
import subprocess
import sys

import pytest

CHECKS = {
    "hash_grid": """
from support.triton_twin import check_against_the_reference
check_against_the_reference("cpu", 140)
""",
    "mlp": """
from nerf_lightning.nerf.kernels.mlp import cuda
from support.triton_perceptron import check_perceptron
cuda.PROGRAMS = 2  # so that one takes several blocks
check_perceptron("cpu", [0, 1, 640])
""",
}


@pytest.mark.parametrize("kernel", CHECKS)
def test_through_the_interpreter(kernel):
    pytest.importorskip("triton", reason="triton is not installed (Linux only)")
    # The interpreter is chosen when the kernels are defined: a process of its own.
    code = f"import sys\nsys.path.insert(0, 'tests')\n{CHECKS[kernel]}"
    environment = os.environ | {"TRITON_INTERPRET": "1"}
    result = subprocess.run([sys.executable, "-c", code], env=environment, capture_output=True, text=True)
    assert result.returncode == 0, result.stderr

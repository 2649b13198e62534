"""The CUDA twin of the hash grid through triton's interpreter; tests/gpu has it on a GPU."""

import os
import subprocess
import sys

import pytest

CHECK = """
import sys
sys.path.insert(0, "tests")
from support.triton_twin import check_against_the_reference
check_against_the_reference("cpu", 140)
"""


def test_through_the_interpreter():
    pytest.importorskip("triton", reason="triton is not installed (Linux only)")
    # The interpreter is chosen when the kernels are defined: a process of its own.
    environment = os.environ | {"TRITON_INTERPRET": "1"}
    result = subprocess.run([sys.executable, "-c", CHECK], env=environment, capture_output=True, text=True)
    assert result.returncode == 0, result.stderr

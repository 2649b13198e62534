"""What a step asks of a GPU is counted on a stand-in, and may only become less; what the kernels compute is torch's.

Three steps of each model, every kernel of triton's in its place, through triton's interpreter.
"""

import json
import os
import subprocess
import sys

import pytest

pytest.importorskip("triton", reason="triton is not installed (Linux only)")

BUDGETS = {
    # On the device (operations and kernels): a step, one that is replayed beside its replay, a rendered tile. On the
    # host: a step; two of these pin the numbers of its batch and those of Adam.
    "fast,bf16-mixed": (80, 3, 33, 4),
    "fast_large,bf16-mixed": (81, 3, 33, 4),
    "fast_proposal,bf16-mixed": (116, 3, 26, 4),
    "nerf_tiny,bf16-mixed": (246, 4, 110, 5),
    "fast,32-true": (97, 3, 40, 4),
}
# How far losses may be apart after up to two steps: bfloat16 has 8 bits, and Adam's first steps follow signs.
TOLERANCE = {"bf16-mixed": 1e-2, "32-true": 1e-4}


def measured(case):
    """In a process of its own: the interpreter is chosen when the kernels are defined."""
    environment = os.environ | {"TRITON_INTERPRET": "1", "PYTHONPATH": os.pathsep.join(["tests", *sys.path])}
    command = [sys.executable, "-m", "support.launches", case]
    result = subprocess.run(command, env=environment, capture_output=True, text=True)
    assert result.returncode == 0, result.stderr
    return json.loads(result.stdout)[case]


@pytest.mark.minutes
@pytest.mark.parametrize("case", BUDGETS)
def test_kernels_learn_what_torch_does_with_no_more_launches_than_before(case):
    found, precision = measured(case), case.split(",")[1]
    assert found["step"]["kernels"] > 0
    assert found["forgotten"] == []  # what a recording (CUDA graph) reads is written to, and never replaced
    assert found["losses"] == pytest.approx(found["without"], rel=TOLERANCE[precision])
    counted = (
        *(found[each].get("operations", 0) + found[each].get("kernels", 0) for each in ("step", "replay", "tile")),
        found["step"]["host"],
    )
    print(f'    "{case}": {counted},')  # pytest -rP shows the table anew
    assert all(asked <= budget for asked, budget in zip(counted, BUDGETS[case], strict=True)), (counted, BUDGETS[case])

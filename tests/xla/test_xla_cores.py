"""Several cores, as two CPU devices of XLA, in a process of their own: how many there are is a process's choice."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

pytestmark = [pytest.mark.xla, pytest.mark.slow]
TESTS = Path(__file__).parents[1]

PROGRAM = """
import os
import sys
from pathlib import Path
import torch
from support.xla_host import XLAHostAccelerator, train
from nerf_lightning.compute import xla_device

xla_device.ACCELERATOR = XLAHostAccelerator
folder = Path(sys.argv[1])
there = train(folder / "xla", "nerf", "tpu", steps=8, devices="auto")
here = train(folder / "cpu", "nerf", "cpu", steps=8)
torch.testing.assert_close(there.losses, here.losses, rtol=1e-5, atol=0)
there.counters.require_quiet_after(2)
import torch_xla
spread = [torch_xla._XLAC._get_xla_sharding_spec(there.counters.weight)]
print("equal on", spread)
"""


def test_two_cores_share_a_batch_and_learn_what_one_learns(tmp_path):
    environment = {"PJRT_DEVICE": "CPU", "CPU_NUM_DEVICES": "2", "PYTHONPATH": f"{TESTS}{os.pathsep}{TESTS.parent}"}
    done = subprocess.run(
        [sys.executable, "-c", PROGRAM, str(tmp_path)], env=os.environ | environment, capture_output=True, text=True
    )
    assert done.returncode == 0, done.stderr[-3000:]
    assert "equal on ['{devices=[2]" in done.stdout

"""The command on XLA, from the photographs to the film, and again from its checkpoint."""

import importlib.util
import os
import subprocess
import sys
from pathlib import Path

import pytest
from support.running import FAST

pytestmark = [
    pytest.mark.xla,
    pytest.mark.slow,
    pytest.mark.skipif(
        importlib.util.find_spec("torch_xla") is None, reason="torch_xla is not installed: make test-xla"
    ),
]
TESTS = Path(__file__).parents[1]

PROGRAM = """
from support.xla_host import XLAHostAccelerator
from nerf_lightning.compute import xla_device
xla_device.ACCELERATOR = XLAHostAccelerator
from nerf_lightning.cli import main as cli
cli.main()
"""


def test_it_trains_films_and_goes_on(tmp_path, capture):
    environment = {"PJRT_DEVICE": "CPU", "PYTHONPATH": f"{TESTS}{os.pathsep}{TESTS.parent}"}
    common = ["train", "scene=npz", f"scene.path={capture}", *FAST, "trainer=tpu", "trainer.precision=32-true"]

    def nerf(*arguments):
        return subprocess.run(
            [sys.executable, "-c", PROGRAM, *common, *arguments],
            env=os.environ | environment,
            capture_output=True,
            text=True,
        )

    run = tmp_path / "run"
    first = nerf(f"paths.output_dir={run}", "trainer.max_steps=4")
    assert first.returncode == 0, first.stderr[-3000:]
    assert "xla (CPU" in first.stderr
    assert (run / "video.mp4").stat().st_size > 0
    second = nerf(f"resume={run}", "trainer.max_steps=6", "final.video=false")
    assert second.returncode == 0, second.stderr[-3000:]
    assert "resuming from step 4" in second.stderr
